"""Simulators of a lab, as they are started with its robots."""

from sim_backends.emulated.cosimulated.simulators import LabSettings, Simulators, start_physics
from sim_backends.emulated.robot.spec import ANTENNA_M
from sim_backends.radio.radio_options import RadioOptions
from sim_backends.world.motion import State
from tests.helpers.cosim_benches import BODY


def test_a_physics_that_is_a_federate_starts_beside_a_relay_without_a_body() -> None:
    """A drone has no body in MuJoCo, and it may be the relay."""
    settings = LabSettings(
        Simulators("mujoco", "builtin"), 1, RadioOptions(), None, antennas={}, bodies={"a": BODY}, relay="drone"
    )
    physics = start_physics(settings, {"a": State((1.0, 5.0, ANTENNA_M))})
    assert physics.advance(0, {})["a"].position_m[:2] == (1.0, 5.0)
