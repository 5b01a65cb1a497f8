"""Programs that follow other agents: their commands with and without received states."""

import math

import pytest

from fieldkit.core.errors import ConfigurationError
from fieldkit.core.model import Vector
from sim_backends.cosim.agents import Agents
from sim_backends.cosim.coordinator import Coordinator
from sim_backends.cosim.federates import Program
from sim_backends.cosim.policies.window_policies import EventDriven
from sim_backends.cosim.programs.follow import FollowAtHeadway, HoldStation
from sim_backends.cosim.programs.senders import Periodic
from sim_backends.cosim.programs.way_points import ProfileLeg, VelocityProfile
from sim_backends.cosim.programs.wrappers import CombinedProgram
from sim_backends.network.disc import Disc
from sim_backends.network.packets import ReceivedDatagram
from sim_backends.physics.bodies import Bodies
from sim_backends.physics.body import Twist, Velocity
from sim_backends.physics.differential_drive import DifferentialDrive
from sim_backends.physics.quadrotor import Quadrotor
from sim_backends.physics.robot_limits import HUSKY_A200, IRIS
from sim_backends.world.motion import State

MS = 1_000_000
S = 1000 * MS


def received_state(
    place_m: Vector, velocity_m_s: Vector = (0.0, 0.0, 0.0), *, sent_ns: int = 0, source: str = "a"
) -> ReceivedDatagram:
    return ReceivedDatagram(source, State(place_m, velocity_m_s), sent_ns, sent_ns)


FOLLOWER_STATE = State((0.0, 0.0, 0.0), (0.0, 0.0, 0.0), 0.0)


def test_the_state_of_a_leader_is_extrapolated_from_its_time_stamp() -> None:
    """A leader that was at 5 m with 1 m/s 0.3 s ago is at 5.3 m: 3.3 m more than the desired 2 m at standstill."""
    program = FollowAtHeadway("a", headway_s=0.5, standstill_m=2.0, gain_per_s=0.4)
    program.wake(0, FOLLOWER_STATE, [])
    twist = program.wake(
        350 * MS, FOLLOWER_STATE, [received_state((5.0, 0.0, 0.0), (1.0, 0.0, 0.0), sent_ns=50 * MS)]
    ).command
    acceleration_m_s2 = (1.0 + 0.4 * 3.3) / 0.5
    assert (twist.forward_m_s, twist.turn_rad_s) == pytest.approx((0.05 * acceleration_m_s2, 0.0))


def test_older_states_and_other_datagrams_are_ignored() -> None:
    program = FollowAtHeadway("a")
    latest = received_state((5.0, 0.0, 0.0), sent_ns=40 * MS)
    expected = FollowAtHeadway("a").wake(50 * MS, FOLLOWER_STATE, [latest])
    ignored_datagrams = [
        received_state((9.0, 0.0, 0.0), sent_ns=30 * MS),
        received_state((9.0, 0.0, 0.0), source="b", sent_ns=50 * MS),
        ReceivedDatagram("a", "hello", 50 * MS, 50 * MS),
    ]
    assert program.wake(50 * MS, FOLLOWER_STATE, [latest, *ignored_datagrams]) == expected


@pytest.mark.parametrize(
    ("place_m", "command"), [((-5.0, 0.0, 0.0), Twist(0.0, 2 * math.pi)), ((0.0, 0.0, 0.0), Twist())]
)
def test_a_follower_turns_to_a_leader_behind_it_and_stops_if_they_have_the_same_position(
    place_m: Vector, command: Twist
) -> None:
    actual = FollowAtHeadway("a").wake(0, FOLLOWER_STATE, [received_state(place_m)]).command
    assert (actual.forward_m_s, abs(actual.turn_rad_s)) == pytest.approx((command.forward_m_s, command.turn_rad_s))


def test_a_follower_stops_without_states_and_continues_when_it_receives_them_again() -> None:
    bodies = Bodies({"a": DifferentialDrive(HUSKY_A200, (4.0, 0.0)), "b": DifferentialDrive(HUSKY_A200, (0.0, 0.0))})
    programs: dict[str, Program] = {
        "a": CombinedProgram(
            [
                VelocityProfile([ProfileLeg(100 * S, Twist(0.5))]),
                Periodic("before", "b", period_ns=100 * MS, stop_ns=5 * S),
                Periodic("after", "b", period_ns=100 * MS, first_ns=12 * S),
            ]
        ),
        "b": FollowAtHeadway("a", timeout_ns=S),
    }
    coordinator = Coordinator(Agents(bodies, programs), Disc(1e6, 3 * MS), EventDriven(), [("a", "b")])

    def speed_m_s(at_ns: int) -> float:
        coordinator.advance(at_ns)
        return math.hypot(*bodies.advance(at_ns, {})["b"].velocity_m_s)

    assert speed_m_s(5900 * MS) == pytest.approx(0.5, abs=0.1)
    # The last state was sent at 4.9 s and arrived 3 ms later. It expires after 1 s; the command at 5.95 s brakes.
    assert speed_m_s(5950 * MS) > 0.3
    assert speed_m_s(6200 * MS) == 0.0
    assert speed_m_s(11_900 * MS) == 0.0
    assert speed_m_s(14_000 * MS) > 0.5


def test_a_drone_that_keeps_station_flies_above_the_centre_of_its_leaders() -> None:
    bodies = Bodies(
        {
            "a": DifferentialDrive(HUSKY_A200, (4.0, 0.0), antenna_m=0.0),
            "b": DifferentialDrive(HUSKY_A200, (0.0, 2.0), antenna_m=0.0),
            "uav": Quadrotor(IRIS, (0.0, 0.0, 5.0)),
        }
    )
    forward = VelocityProfile([ProfileLeg(100 * S, Twist(0.8))])
    programs: dict[str, Program] = {
        "a": CombinedProgram([forward, Periodic("a", "uav", period_ns=50 * MS)]),
        "b": CombinedProgram(
            [VelocityProfile([ProfileLeg(100 * S, Twist(0.8))]), Periodic("b", "uav", period_ns=50 * MS)]
        ),
        "uav": HoldStation(["a", "b"], above_m=8.0),
    }
    coordinator = Coordinator(
        Agents(bodies, programs), Disc(1e6, 20 * MS), EventDriven(), [("a", "uav"), ("b", "uav")]
    )
    coordinator.advance(20 * S)
    states = bodies.advance(20 * S, {})
    middle_m = (states["a"].position_m[0] + states["b"].position_m[0]) / 2
    assert states["uav"].position_m == pytest.approx((middle_m, 1.0, 8.0), abs=0.01)
    assert states["uav"].velocity_m_s == pytest.approx((0.8, 0.0, 0.0), abs=0.01)


def test_a_drone_that_keeps_station_hovers_without_states() -> None:
    program = HoldStation(["a", "b"], above_m=8.0, gain_per_s=1.0, timeout_ns=S)
    assert program.wake(0, FOLLOWER_STATE, []).command == Velocity()
    velocity = program.wake(
        50 * MS, FOLLOWER_STATE, [received_state((2.0, 0.0, -8.0), (0.3, 0.0, 0.0), sent_ns=50 * MS)]
    ).command
    assert velocity.velocity_m_s == pytest.approx((2.3, 0.0, 0.0))
    assert program.wake(2 * S, FOLLOWER_STATE, []).command == Velocity()


@pytest.mark.parametrize(
    "invalid_parameters", [{"headway_s": 0.0}, {"standstill_m": -1.0}, {"period_ns": 0}, {"timeout_ns": 0}]
)
def test_parameters_that_are_not_above_0_are_refused(invalid_parameters: dict[str, float]) -> None:
    with pytest.raises(ConfigurationError, match="above 0"):
        FollowAtHeadway("a", **invalid_parameters)  # type: ignore[arg-type]
    with pytest.raises(ConfigurationError, match="cannot fly"):
        HoldStation(["a"], above_m=0.0)
    with pytest.raises(ConfigurationError, match="no agent to follow"):
        HoldStation([])


def test_a_profile_commands_its_legs_in_order_and_stops() -> None:
    bodies = Bodies({"a": DifferentialDrive(HUSKY_A200, (0.0, 0.0))})
    legs = [ProfileLeg(2 * S, Twist(0.9)), ProfileLeg(S, Twist(0.3, 0.5))]
    agents = Agents(bodies, {"a": VelocityProfile(legs, begin_ns=S)})
    speeds_m_s = []
    for at_s in range(6):
        _, states = agents.advance((at_s - 1) * S, at_s * S - 1, at_s * S)
        speeds_m_s.append(math.hypot(*states["a"].velocity_m_s))
    assert speeds_m_s == pytest.approx([0.0, 0.0, 0.9, 0.9, 0.3, 0.0])
    with pytest.raises(ConfigurationError, match="a leg without a duration"):
        VelocityProfile([])
