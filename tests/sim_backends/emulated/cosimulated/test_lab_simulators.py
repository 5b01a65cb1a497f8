"""Simulators of a lab, as they are started with its robots."""

import pytest

from sim_backends.emulated.cosimulated.simulators import LabSettings, RobotBody, Simulators, start_physics
from sim_backends.emulated.robot.spec import ANTENNA_M
from sim_backends.mujoco_physics.physics import MujocoPhysics
from sim_backends.physics.body import Velocity
from sim_backends.physics.robot_limits import IRIS
from sim_backends.radio.radio_options import RadioOptions
from sim_backends.world.motion import State
from tests.helpers.cosim_benches import BODY


def test_a_drone_that_relays_has_a_body_in_mujoco() -> None:
    bodies = {"a": BODY, "drone": RobotBody.from_json(RobotBody("iris", IRIS).to_json())}
    settings = LabSettings(
        Simulators("mujoco", "builtin"), 1, RadioOptions(), None, antennas={}, bodies=bodies, relay="drone"
    )
    physics = start_physics(settings, {"a": State((1.0, 5.0, ANTENNA_M)), "drone": State((3.0, 5.0, ANTENNA_M))})
    assert physics.advance(0, {})["a"].position_m[:2] == (1.0, 5.0)
    assert isinstance(physics, MujocoPhysics)
    assert physics.flight_status("drone").place_m == pytest.approx((3.0, 5.0, 0.0))
    state = physics.advance(300_000_000, {"drone": Velocity((1.0, -2.0, 1.0))})["drone"]
    status = physics.flight_status("drone")
    assert state.tilt_rad == pytest.approx((status.roll_rad, status.pitch_rad), abs=1e-9)
    assert min(state.tilt_rad) > 0.02, "it accelerates forward and to the right"
