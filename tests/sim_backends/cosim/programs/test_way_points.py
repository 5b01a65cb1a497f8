"""Programs that steer through waypoints, with the bodies that they steer."""

import math

import pytest

from fieldkit.core.errors import ConfigurationError
from sim_backends.cosim.agents import Agents
from sim_backends.cosim.federates import FederateError
from sim_backends.cosim.programs.way_points import DriveThrough
from sim_backends.physics.bodies import Bodies
from sim_backends.physics.differential_drive import DifferentialDrive
from sim_backends.physics.paths import Paths
from sim_backends.physics.robot_limits import HUSKY_A200
from sim_backends.world.motion import WayPoints

MS = 1_000_000


def test_a_robot_drives_through_all_points_and_stops_at_the_last() -> None:
    points = [(5.0, 0.0), (5.0, 5.0), (-1.0, 5.0)]
    agents = Agents(
        Bodies({"a": DifferentialDrive(HUSKY_A200, (0.0, 0.0), math.pi)}), {"a": DriveThrough(points, 0.8)}
    )
    least_distances_m = dict.fromkeys(points, math.inf)
    for at_ms in range(0, 30_000, 10):
        _, states = agents.advance((at_ms - 10) * MS, at_ms * MS, at_ms * MS)
        state = states["a"]
        assert math.hypot(*state.velocity_m_s) <= 0.8 + 1e-9
        least_distances_m = {
            point: min(earlier_m, math.dist(point, state.position_m[:2]))
            for point, earlier_m in least_distances_m.items()
        }
    assert all(least_m <= 0.1 for least_m in least_distances_m.values())
    assert state.velocity_m_s == (0.0, 0.0, 0.0)
    assert math.dist(state.position_m[:2], points[-1]) <= 0.1
    assert agents.next_wake_ns() is None


def test_a_program_that_steers_requires_states_with_a_heading() -> None:
    agents = Agents(Paths([WayPoints("a", [(0.0, 0.0, 0.0)], 1.0)]), {"a": DriveThrough([(1.0, 1.0)], 1.0)})
    with pytest.raises(FederateError, match="the heading of its robot"):
        agents.advance(0, MS, MS)


@pytest.mark.parametrize(("points", "speed"), [([], 1.0), ([(0.0, 1.0)], 0.0), ([(0.0, 1.0)], math.inf)])
def test_a_path_without_points_or_speed_is_refused(points: list[tuple[float, float]], speed: float) -> None:
    with pytest.raises(ConfigurationError, match="is impossible"):
        DriveThrough(points, speed)
