"""Arming checks with messages of pymavlink, and of the emulated autopilots."""

import json
import threading
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import pytest
from pymavlink.dialects.v20 import ardupilotmega as d

from fieldkit.agent.autopilots.autopilot import AutopilotState
from fieldkit.agent.flying import arming
from fieldkit.agent.flying.arming import ArmingCheck, ArmingFault
from fieldkit.agent.flying.flight_plan import FlightNeeds
from sim_backends.emulated.autopilot.arducopter import ARDUCOPTER
from sim_backends.emulated.autopilot.firmware import Firmware
from sim_backends.emulated.autopilot.px4 import PX4
from tests.agent.test_agent_flight import MemoryLink
from tests.helpers import drones
from tests.helpers.sshd import free_port

NEEDS = FlightNeeds(highest_m=3.0, farthest_m=20.0, ceiling_m=10.0, least_charge=0.2, returns=True)
ALL_SENSORS = d.MAV_SYS_STATUS_SENSOR_GPS | d.MAV_SYS_STATUS_PREARM_CHECK
READY_EKF_FLAGS = 831
"""Flags of EKF_STATUS_REPORT of a ready ArduCopter, from its logs."""


def heartbeat(autopilot: int, mode: int = 0, base: int = 0) -> Any:  # noqa: ANN401 (a type of pymavlink)
    return d.MAVLink_heartbeat_message(d.MAV_TYPE_QUADROTOR, autopilot, base, mode, d.MAV_STATE_STANDBY, 3)


def status(healthy: int = ALL_SENSORS, charge: int = 90) -> Any:  # noqa: ANN401
    return d.MAVLink_sys_status_message(ALL_SENSORS, ALL_SENSORS, healthy, 0, 12_000, 0, charge, 0, 0, 0, 0, 0, 0)


def parameter(name: str, value: float) -> Any:  # noqa: ANN401
    return d.MAVLink_param_value_message(name.encode(), value, d.MAV_PARAM_TYPE_REAL32, 1, 0)


READY_MESSAGES: Mapping[str, Any] = {
    "position": d.MAVLink_local_position_ned_message(1, 0, 0, 0, 0, 0, 0),
    "estimate": d.MAVLink_ekf_status_report_message(READY_EKF_FLAGS, 0.1, 0.1, 0.1, 0.1, 0.1),
    "status": status(),
    "home": d.MAVLink_home_position_message(0, 0, 0, 0, 0, 0, [1, 0, 0, 0], 0, 0, 0),
    "return_height": parameter("RTL_ALT", 900),
    "fence": parameter("FENCE_ENABLE", 1),
    "fence_type": parameter("FENCE_TYPE", 3),
    "fence_height": parameter("FENCE_ALT_MAX", 9),
    "radius": parameter("FENCE_RADIUS", 50),
}


def reported_faults(
    needs: FlightNeeds = NEEDS,
    first_heartbeat: Any = None,  # noqa: ANN401
    **replacements: Any,  # noqa: ANN401
) -> list[ArmingFault]:
    """Return the faults if an autopilot sends the messages of a ready autopilot with replacements."""
    link, writer = MemoryLink(), d.MAVLink(None, srcSystem=7, srcComponent=1)
    autopilot = AutopilotState(link)
    link.incoming_frames = [(first_heartbeat or heartbeat(d.MAV_AUTOPILOT_ARDUPILOTMEGA)).pack(writer)]
    autopilot.receive()
    check = ArmingCheck(autopilot, needs)
    messages = [item for item in {**READY_MESSAGES, **replacements}.values() if item is not None]
    link.incoming_frames = [item.pack(writer) for item in messages]
    autopilot.receive()
    reported = list(check.faults())
    assert all(item.remedy for item in reported)
    return reported


def faults(needs: FlightNeeds = NEEDS, first_heartbeat: Any = None, **replacements: Any) -> list[str]:  # noqa: ANN401
    """Return the texts of `reported_faults`."""
    return [fault.what for fault in reported_faults(needs, first_heartbeat, **replacements)]


def test_no_faults_for_a_ready_autopilot() -> None:
    assert faults() == []
    assert faults(status=status(charge=-1)) == [], "the charge is unknown"
    assert faults(replace(NEEDS, returns=False), home=None, return_height=None) == []


@pytest.mark.parametrize(
    ("replacements", "fault"),
    [
        (
            {"first_heartbeat": heartbeat(d.MAV_AUTOPILOT_GENERIC)},
            "its autopilot is neither PX4 nor ArduCopter (MAV_AUTOPILOT 0, MAV_TYPE 2)",
        ),
        (
            {"first_heartbeat": heartbeat(d.MAV_AUTOPILOT_PX4, base=d.MAV_MODE_FLAG_SAFETY_ARMED)},
            "its motors are running",
        ),
        ({"position": None}, "it does not report its position"),
        (
            {"estimate": d.MAVLink_ekf_status_report_message(0xA7, 1, 1, 1, 1, 1)},
            "its position estimate is not valid",
        ),
        ({"estimate": d.MAVLink_estimator_status_message(1, 0x400, *(1,) * 8)}, "flags 0x400"),
        ({"status": None}, "it does not report its status"),
        ({"status": status(charge=19)}, "its battery charge is 19%, but the minimum is 20%"),
        ({"status": status(healthy=0)}, "ArduCopter refuses to arm: GPS"),
        ({"text": d.MAVLink_statustext_message(2, b"PreArm: Gyros inconsistent")}, "arm: Gyros inconsistent"),
        ({"home": None}, "it has no home position"),
        (
            {"fence_height": parameter("FENCE_ALT_MAX", 2.5)},
            "the fence of its autopilot ends 2.5 m above home, but the flight needs 3 m",
        ),
        (
            {"radius": parameter("FENCE_RADIUS", 15)},
            "the fence of its autopilot ends 15 m from home, but the flight needs 20 m",
        ),
        ({"return_height": parameter("RTL_ALT", 1500)}, "it returns at a height of 15 m, but only 10 m are allowed"),
    ],
)
def test_each_fault_is_reported(replacements: dict[str, Any], fault: str) -> None:
    assert any(fault in item for item in faults(**replacements)), faults(**replacements)


def test_the_remedy_for_a_small_fence_names_only_parameters_of_the_fence() -> None:
    (fault,) = reported_faults(fence_height=parameter("FENCE_ALT_MAX", 2.5))
    names = "FENCE_ENABLE, FENCE_TYPE, FENCE_ALT_MAX, FENCE_RADIUS"
    assert fault.remedy == f"shorten the flight in the procedure, or enlarge the fence: {names}"


def test_text_in_pieces_is_joined() -> None:
    long_text = b"PreArm: Battery 1 below minimum arming voltage, which is set by BATT_ARM_VOLT"
    pieces = {f"text{n}": d.MAVLink_statustext_message(2, long_text[50 * n :][:50], 5, n) for n in range(2)}
    (fault,) = faults(**pieces)
    assert fault.endswith("to arm: Battery 1 below minimum arming voltage, which is set by BATT_ARM_VOLT")


@pytest.mark.parametrize("firmware", [PX4, ARDUCOPTER])
def test_emulated_autopilots(firmware: Firmware, capsys: pytest.CaptureFixture[str]) -> None:
    arming_errors: list[str] = []
    with drones.at_udp(firmware=replace(firmware, arming_errors=lambda _parameters, _battery: arming_errors)) as port:
        for reasons in ([], ["Gyros inconsistent"]):
            arming_errors[:] = reasons
            assert (
                arming.check_arming(f"udpout:127.0.0.1:{port}", replace(NEEDS, ceiling_m=30.0), threading.Event())
                == 0
            )
            *reported, summary = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
            assert summary["charge"] == 1.0
            assert [item["what"].rpartition(": ")[2] for item in reported] == arming_errors
            # PX4 checks its present mode, not the mode of the flight, so its errors do not prevent the flight.
            assert [item["grave"] for item in reported] == [summary["autopilot"] == "ArduCopter"] * len(arming_errors)


def test_missing_heartbeat_is_reported(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(arming, "_HEARTBEAT_TIMEOUT_S", 0.3)
    assert arming.check_arming(f"udpin:127.0.0.1:{free_port()}", NEEDS, threading.Event()) == 1
    assert "no heartbeat" in capsys.readouterr().err
