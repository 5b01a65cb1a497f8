"""State of the computer of a robot: real outputs of `vcgencmd`, values of /proc and /sys, and invalid outputs."""

from pathlib import Path

import pytest

from fieldkit.core.columns import Measured, cell_text
from fieldkit.core.model import Role
from fieldkit.measure.attempt import AttemptEvidence
from fieldkit.measure.robot_state import attempt_states, health, state_columns
from fieldkit.measure.robot_state.health import Health
from fieldkit.measure.robot_state.snapshots import SourceOutput

# /proc/stat of a Raspberry Pi 4, temperature in millidegrees, charge in per cent, voltage in microvolts, KiB.
BEFORE = "cpu  1000 0 500 8000 500 0 0 0 0 0\ntemperature 48312\ntemperature 51000\nbattery 80 12300000\ndisk 1000000"
AFTER = "cpu  1600 0 700 8150 550 0 0 0 0 0\ntemperature 61200\nbattery 79 11800000\ndisk 999000"


def state(text: str, throttled: str | None = None, code: int = 0) -> Health:
    outputs = {"health": SourceOutput(text, 0)}
    if throttled is not None:
        outputs["vcgencmd"] = SourceOutput(throttled, code)
    return health.parse(outputs)


def test_values_before_and_after_a_repeat_give_columns() -> None:
    measured = health.measure(Role.SENDER, state(BEFORE, "throttled=0x0"), state(AFTER, "throttled=0x0"))
    assert measured.values == {
        "sender_cpu_share": pytest.approx(800 / 1000),
        "sender_temperature_c": 61.2,
        "sender_power_state": "normal",
        "sender_battery_share": 0.79,
        "sender_battery_v": 11.8,
        "sender_disk_free_bytes": 999000 * 1024,
    }


@pytest.mark.parametrize(
    ("before", "after", "flags"),
    [
        ("throttled=0x0", "throttled=0x0", set()),
        ("throttled=0x50000", "throttled=0x50000", set()),  # set before this repeat
        ("throttled=0x50005", "throttled=0x50000", {"under-voltage", "throttled"}),
        ("throttled=0x0", "throttled=0x10000", {"under-voltage"}),  # during the repeat
        ("throttled=0x80000", "throttled=0xE0008", {"frequency capped", "throttled", "soft temperature limit"}),
        ("throttled=0x0", "VCHI initialization failed", None),
        ("throttled=0xZZ", "throttled=0x0", None),
        ('error=1 error_msg="Command not registered"', "throttled=0x0", None),
    ],
)
def test_flags_of_a_raspberry_pi_during_a_repeat(before: str, after: str, flags: set[str] | None) -> None:
    assert health.flags_during(state("", before), state("", after)) == flags


def test_a_kernel_reports_under_voltage_without_vcgencmd() -> None:
    assert health.flags_during(state("undervoltage 0"), state("undervoltage 1")) == frozenset({"under-voltage"})
    assert health.flags_during(state("undervoltage 0"), state("undervoltage 0")) == frozenset[str]()
    assert health.flags_during(state("undervoltage 0"), state("undervoltage 2")) is None


@pytest.mark.parametrize(
    "text",
    [
        "",
        "cpu",
        "cpu  1 2 3",
        "temperature -273000",
        "temperature x",
        "battery 255 -",
        "battery - -",
        "disk -1",
        "disk",
    ],
)
def test_impossible_values_are_missing(text: str) -> None:
    measured = health.measure(Role.SENDER, state(text), state(text))
    assert not measured.values
    assert set(measured.missing.values()) == {"the robot does not report it"}


def test_counters_that_decrease_or_a_source_that_failed_give_no_value() -> None:
    assert "sender_cpu_share" not in health.measure(Role.SENDER, state(AFTER), state(BEFORE)).values
    failed_state = health.parse({"health": SourceOutput(BEFORE, 137), "vcgencmd": SourceOutput("throttled=0x1", 137)})
    assert failed_state == Health()


def test_a_throttled_computer_marks_the_repeat(tmp_path: Path) -> None:
    for snapshot, flags in (("before", "0x0"), ("after", "0x50005")):
        (tmp_path / f"sender-sources-{snapshot}.txt").write_text(
            f"==> vcgencmd <==\n throttled={flags}\n \n code 0\n"
        )
    measured = attempt_states.measure(AttemptEvidence(tmp_path), {Role.SENDER: "rover-1"}, Measured())
    assert measured.values["marks"] == "under-voltage and throttled"
    assert measured.values["marks_reason"] == (
        "rover-1: the supply voltage is too low; rover-1: the processor is throttled (throttled)"
    )
    for column in (*state_columns.MARK_COLUMNS, *state_columns.declare_columns("sender")):
        assert (column.name in measured.values) != (column.name in measured.missing), column.name
        assert column.declaration_error() is None
        assert column.invalid_value_reason(cell_text(measured.values.get(column.name))) is None
