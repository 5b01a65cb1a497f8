"""Each check of the conformance suite fails for a federate that violates the checked rule."""

import math
import random
import struct
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import pytest

from sim_backends.federates.answering import FederateService, _FederateCopy, _Run
from sim_backends.federates.conformance import probe
from sim_backends.federates.conformance.probe import Target
from sim_backends.federates.conformance.suite import ConformanceResult, checks, run_check
from sim_backends.federates.frames import NETWORK, PHYSICS, MessageKind
from sim_backends.network.disc import Disc
from sim_backends.network.packets import Arrival, Drop, Packet
from sim_backends.physics.body import Twist, Velocity
from sim_backends.world.dead_reckoning import DeadReckoned
from sim_backends.world.motion import State
from tests.helpers.federate_examples import carts
from tests.helpers.federate_pairs import HELLO, Alter, Pair

Carts: Final = carts()
MS = 1_000_000
States = Mapping[str, State]


class WrappedPhysics:
    """Physics that moves agents as the example does; subclasses alter its answers."""

    def __init__(self, hello: Any) -> None:  # noqa: ANN401
        self.carts = Carts(hello)
        self.step_ns = self.carts.step_ns
        self.limits_m_s2 = self.carts.limits_m_s2
        self.calls = 0

    def advance(self, to_ns: int, commands: Mapping[str, Any]) -> States:
        self.calls += 1
        return self.alter_answer(self.carts.advance(to_ns, commands), to_ns)

    def alter_answer(self, states: States, to_ns: int) -> States:
        return states


def shifted(state: State, east_m: float) -> State:
    east, north, up = state.position_m
    return state._replace(position_m=(east + east_m, north, up))


class StartsElsewhere(WrappedPhysics):
    def alter_answer(self, states: States, to_ns: int) -> States:
        return {name: shifted(state, 1.0) for name, state in states.items()}


class DriftingPhysics(WrappedPhysics):
    def alter_answer(self, states: States, to_ns: int) -> States:
        return {name: shifted(state, 1e-6 * self.calls) for name, state in states.items()}


class JumpingPhysics(WrappedPhysics):
    def alter_answer(self, states: States, to_ns: int) -> States:
        return {name: shifted(state, 3.0 * (to_ns > 50 * MS)) for name, state in states.items()}


class IgnoresCommands(WrappedPhysics):
    def advance(self, to_ns: int, commands: Mapping[str, Any]) -> States:
        return super().advance(to_ns, {})


class ReportsSmallLimits(WrappedPhysics):
    def __init__(self, hello: Any) -> None:  # noqa: ANN401
        super().__init__(hello)
        self.limits_m_s2 = dict.fromkeys(self.limits_m_s2, 0.1)


class NoisyPhysics(WrappedPhysics):
    def alter_answer(self, states: States, to_ns: int) -> States:
        return {name: shifted(state, random.random() * 1e-9) for name, state in states.items()}


class CopiesArePhysicsItself(WrappedPhysics):
    def __deepcopy__(self, memo: dict[int, Any]) -> "CopiesArePhysicsItself":
        return self


class LosesAnAgent(WrappedPhysics):
    def alter_answer(self, states: States, to_ns: int) -> States:
        return {name: state for name, state in states.items() if name != "bob" or to_ns < 20 * MS}


class LeavesOnTime(WrappedPhysics):
    """Has no state of an agent outside of its lifetime; subclasses shift the lifetime or the position."""

    late_ns = 0
    east_m = 0.0

    def __init__(self, hello: Any) -> None:  # noqa: ANN401
        super().__init__(hello)
        self.lifetimes = hello.lifetimes

    def alter_answer(self, states: States, to_ns: int) -> States:
        return {
            name: shifted(state, self.east_m)
            for name, state in states.items()
            if name not in self.lifetimes or self.lifetimes[name].contains(to_ns - self.late_ns)
        }


class LeavesLate(LeavesOnTime):
    late_ns = 1


class LosesAnotherAgent(LeavesOnTime):
    def alter_answer(self, states: States, to_ns: int) -> States:
        return {name: state for name, state in super().alter_answer(states, to_ns).items() if name != "bob"}


class AppearsElsewhere(LeavesOnTime):
    east_m = 2.0


class AddsAnAgent(WrappedPhysics):
    def alter_answer(self, states: States, to_ns: int) -> States:
        return {**states, **({"dan": states["bob"]} if to_ns > 20 * MS else {})}


class IsNotFinite(WrappedPhysics):
    def alter_answer(self, states: States, to_ns: int) -> States:
        return {name: shifted(state, math.nan * (to_ns > 0)) for name, state in states.items()}


class SwapsAxes(WrappedPhysics):
    def alter_answer(self, states: States, to_ns: int) -> States:
        return {name: state._replace(position_m=swapped(state.position_m)) for name, state in states.items()}


def swapped(position_m: tuple[float, float, float]) -> tuple[float, float, float]:
    east, north, up = position_m
    return north, east, up


class ReportsNoVelocity(WrappedPhysics):
    def alter_answer(self, states: States, to_ns: int) -> States:
        return {name: state._replace(velocity_m_s=(0.0, 0.0, 0.0)) for name, state in states.items()}


class ReportsDegrees(WrappedPhysics):
    def alter_answer(self, states: States, to_ns: int) -> States:
        return {
            name: state._replace(heading_rad=math.degrees(state.heading_rad or 0.0)) for name, state in states.items()
        }


class ReportsOppositeTurns(WrappedPhysics):
    def alter_answer(self, states: States, to_ns: int) -> States:
        return {name: state._replace(heading_rad=-(state.heading_rad or 0.0)) for name, state in states.items()}


class ChangesCommands(WrappedPhysics):
    """Moves as if it had received other commands."""

    def advance(self, to_ns: int, commands: Mapping[str, Any]) -> States:
        return super().advance(to_ns, {name: self.change_command(command) for name, command in commands.items()})

    def change_command(self, command: Any) -> Any:  # noqa: ANN401 (a command)
        return command


class TurnsRight(ChangesCommands):
    def change_command(self, command: Any) -> Any:  # noqa: ANN401 (a command)
        return replace(command, turn_rad_s=-command.turn_rad_s) if isinstance(command, Twist) else command


class ReportsWrongSide(TurnsRight, ReportsOppositeTurns):
    """Turns to the right, and reports a turn to the left."""


class IgnoresYaw(ChangesCommands):
    def change_command(self, command: Any) -> Any:  # noqa: ANN401 (a command)
        return replace(command, yaw_rad=None) if isinstance(command, Velocity) else command


class ZeroesYaw(ChangesCommands):
    def change_command(self, command: Any) -> Any:  # noqa: ANN401 (a command)
        return replace(command, yaw_rad=command.yaw_rad or 0.0) if isinstance(command, Velocity) else command


class FliesForward(ChangesCommands):
    """Flies in the frame of its body, whose heading is pi/2 in the check."""

    def change_command(self, command: Any) -> Any:  # noqa: ANN401 (a command)
        if not isinstance(command, Velocity):
            return command
        forward, left, up = command.velocity_m_s
        return replace(command, velocity_m_s=(-left, forward, up))


class IgnoresFromTime(_Run):
    def _advance_physics(self, federate_copy: _FederateCopy, body: bytes) -> bytes:
        return super()._advance_physics(federate_copy, body[:8] + bytes(8) + body[16:])


Outcome = tuple[list[Arrival], list[Drop]]


class DelayNetwork(Disc):
    """A network that delivers after 2 ms within 100 km; subclasses alter its answers."""

    def __init__(self, hello: Any) -> None:  # noqa: ANN401
        super().__init__(1e5, 2 * MS, extrapolates=True)
        self.last_ns = -1

    def advance(self, to_ns: int, packets: Sequence[Packet], states: States) -> tuple[list[Arrival], list[Drop]]:
        arrivals, drops = super().advance(to_ns, packets, states)
        outcomes = self.alter_answer(arrivals, drops, to_ns)
        self.last_ns = to_ns
        return outcomes

    def alter_answer(
        self, arrivals: list[Arrival], drops: list[Drop], to_ns: int
    ) -> tuple[list[Arrival], list[Drop]]:
        return arrivals, drops


def network_class(
    alter_answer: Callable[[DelayNetwork, list[Arrival], list[Drop], int], Outcome],
) -> type[DelayNetwork]:
    return type("Broken", (DelayNetwork,), {"alter_answer": alter_answer})


class DropsAtBorders(DelayNetwork):
    def advance(self, to_ns: int, packets: Sequence[Packet], states: States) -> Outcome:
        remaining = [packet for packet in packets if packet.enters_ns > self.last_ns]
        return super().advance(to_ns, remaining, states)


class RefusesNegativeTimes(DelayNetwork):
    def advance(self, to_ns: int, packets: Sequence[Packet], states: States) -> Outcome:
        if to_ns < 0:
            raise ValueError("negative")
        return super().advance(to_ns, packets, states)


class ReportsNoDrops(DelayNetwork):
    def advance(self, to_ns: int, packets: Sequence[Packet], states: States) -> Outcome:
        return super().advance(to_ns, packets, states)[0], []


class RefusesNewAgents(DelayNetwork):
    def advance(self, to_ns: int, packets: Sequence[Packet], states: States) -> Outcome:
        for packet in packets:
            if packet.destination not in {"ann", "bob", "cy"}:
                raise KeyError(packet.destination)
        return super().advance(to_ns, packets, states)


class DeliversToAll(DelayNetwork):
    def advance(self, to_ns: int, packets: Sequence[Packet], states: States) -> Outcome:
        return super().advance(to_ns, packets, {name: State((0.0, 0.0, 0.0)) for name in ("ann", "bob", "cy")})


class DelaysDeadReckoning(DelayNetwork):
    def advance(self, to_ns: int, packets: Sequence[Packet], states: States) -> Outcome:
        delay_ns = MS if isinstance(states, DeadReckoned) else 0
        return super().advance(
            to_ns, [packet._replace(enters_ns=packet.enters_ns + delay_ns) for packet in packets], states
        )


class CopiesAreNetworkItself(DelayNetwork):
    def __deepcopy__(self, memo: dict[int, Any]) -> "CopiesAreNetworkItself":
        return self


class AnnouncesTooLate(DelayNetwork):
    def next_event_ns(self) -> int | None:
        at_ns = super().next_event_ns()
        return None if at_ns is None else at_ns + 10 * MS


class AnnouncesDropsTooLate(DelayNetwork):
    """Drops packets 2 ms after they entered, and announces 1 ms more."""

    def alter_answer(self, arrivals: list[Arrival], drops: list[Drop], to_ns: int) -> Outcome:
        return [], [Drop(arrival.packet_id, "lost") for arrival in arrivals]

    def next_event_ns(self) -> int | None:
        at_ns = super().next_event_ns()
        return None if at_ns is None else at_ns + MS


class AnnouncesNothing(DelayNetwork):
    """Announces no event, and never decides."""

    def advance(self, to_ns: int, packets: Sequence[Packet], states: States) -> Outcome:
        return [], []

    def next_event_ns(self) -> int | None:
        return None


class LosesByKey(DelayNetwork):
    """Loses half of the packets beyond 30 m; its draws are keyed by seed, flow and number."""

    def __init__(self, hello: Any) -> None:  # noqa: ANN401
        super().__init__(hello)
        self.seed = hello.seed

    def advance(self, to_ns: int, packets: Sequence[Packet], states: States) -> Outcome:
        ends_m = [states[name].position_m for name in ("ann", "bob") if name in states]
        distance_m = math.dist(*ends_m) if len(ends_m) == 2 else 0.0
        lost_packets = [packet for packet in packets if distance_m > 30 and self.draw(packet) < 0.5]
        arrivals, drops = super().advance(to_ns, [packet for packet in packets if packet not in lost_packets], states)
        return arrivals, [*drops, *(Drop(packet.packet_id, "bad luck") for packet in lost_packets)]

    def draw(self, packet: Packet) -> float:
        return random.Random(f"{self.seed} {packet.identity}").random()


class IgnoresSeed(LosesByKey):
    def draw(self, packet: Packet) -> float:
        return random.Random(f"{packet.identity}").random()


class LosesInOrder(LosesByKey):
    def __init__(self, hello: Any) -> None:  # noqa: ANN401
        super().__init__(hello)
        self.draws = random.Random(self.seed)

    def draw(self, packet: Packet) -> float:
        return self.draws.random()


class LosesEverySecond(LosesByKey):
    """Loses packets by a pattern, without draws."""

    def draw(self, packet: Packet) -> float:
        return packet.identity[1] // 2 % 2


class AnnouncesThePast(DelayNetwork):
    def next_event_ns(self) -> int | None:
        return 0


class UnknownTransmitter(DelayNetwork):
    transmitters = ("nobody",)


def lose_at_random(self: DelayNetwork, arrivals: list[Arrival], drops: list[Drop], to_ns: int) -> Outcome:
    lost_arrivals = [arrival for arrival in arrivals if random.random() < 0.5]
    remaining_arrivals = [arrival for arrival in arrivals if arrival not in lost_arrivals]
    return remaining_arrivals, [Drop(arrival.packet_id, "bad luck") for arrival in lost_arrivals]


def turn_errors_into(kind: MessageKind) -> Alter:
    """Return a function that turns an error into an empty answer."""

    def alter(frame: bytes) -> bytes:
        return frame if frame[4] != MessageKind.ERROR else struct.pack("<IHH", 0, kind, 0) + frame[8:16]

    return alter


def add_to_first_integer(kind: MessageKind, by: int) -> Alter:
    """Return a function that changes the first integer in the body of messages."""

    def alter(frame: bytes) -> bytes:
        if frame[4] != kind:
            return frame
        return frame[:16] + struct.pack("<q", struct.unpack_from("<q", frame, 16)[0] + by) + frame[24:]

    return alter


def drop_answers(frame: bytes) -> bytes | None:
    return None if frame[4] in {MessageKind.STATES, MessageKind.OUTCOMES} else frame


@dataclass(frozen=True)
class BrokenFederate:
    check: str
    pair: Pair
    message: str


def serve(make: Any, **settings: Any) -> Pair:  # noqa: ANN401 (a class of a federate)
    return Pair(FederateService(make, **settings))


PHYSICS_CASES = [
    BrokenFederate("handshake", serve(Carts, commands=(1, 2, 9)), "unknown types of commands: [9]"),
    BrokenFederate(
        "ping",
        replace(serve(Carts), alter=add_to_first_integer(MessageKind.PONG, 1)),
        "the ping 0 was answered with 1",
    ),
    BrokenFederate(
        "malformed",
        replace(serve(Carts), alter=turn_errors_into(MessageKind.STATES)),
        "it must refuse a frame that ends",
    ),
    BrokenFederate(
        "counts", replace(serve(Carts), alter=turn_errors_into(MessageKind.STATES)), "it must refuse a count"
    ),
    BrokenFederate(
        "fork_absence",
        replace(serve(Carts, forks=False), alter=turn_errors_into(MessageKind.DONE)),
        "it must refuse fork",
    ),
    BrokenFederate("bye", replace(serve(Carts), stays_open=True), "it has not closed the connection"),
    BrokenFederate("start", serve(StartsElsewhere), "ann starts 1 m away"),
    BrokenFederate(
        "remainders", replace(serve(Carts), alter=add_to_first_integer(MessageKind.STATES, 1)), "instead of 0 ns"
    ),
    BrokenFederate("remainders", serve(LosesAnAgent), "there is no state of bob"),
    BrokenFederate("remainders", serve(AddsAnAgent), "the agent dan appeared"),
    BrokenFederate(
        "remainders", replace(serve(Carts), alter=drop_answers, deadline_s=0.2), "has not answered for 0.2 s"
    ),
    BrokenFederate("remainders", serve(IsNotFinite), "with a malformed frame: byte 32: the state of agent 0"),
    BrokenFederate("drift", serve(DriftingPhysics), "windows instead of one: the positions of ann differ"),
    BrokenFederate("repeated_time", serve(DriftingPhysics), "a second request for 20000000 ns gave other states"),
    BrokenFederate("motion", serve(JumpingPhysics), "moved by 3 m in a step"),
    BrokenFederate("motion", serve(IgnoresCommands), "moved by 0 m in 1000 steps"),
    BrokenFederate("limits", serve(ReportsSmallLimits), "its limit of 0.1 m/s^2 allows"),
    BrokenFederate(
        "command_time", replace(serve(Carts), run_class=IgnoresFromTime), "a command that applies from 100000000 ns"
    ),
    BrokenFederate(
        "unknown_command",
        replace(serve(Carts), alter=turn_errors_into(MessageKind.STATES)),
        "it must refuse a command",
    ),
    BrokenFederate("determinism", serve(NoisyPhysics), "gave different answers"),
    BrokenFederate(
        "lifetimes", serve(LeavesLate, agents_disappear=True), "300000000 ns, has no state at 100000000 ns"
    ),
    BrokenFederate(
        "lifetimes", serve(LosesAnotherAgent, agents_disappear=True), "bob, which is always present, has no"
    ),
    BrokenFederate(
        "lifetimes", serve(AppearsElsewhere, agents_disappear=True), "ann appears 2 m away from its requested start"
    ),
    BrokenFederate("fork", serve(CopiesArePhysicsItself), "the original"),
    BrokenFederate("drive_axes", serve(SwapsAxes), "0 rad, and moved by (0, 0.6, 0) m instead of 0.6 m east"),
    BrokenFederate("drive_axes", serve(ReportsDegrees), "the heading of ann is 90 rad at the start, not 1.57 rad"),
    BrokenFederate("turn", serve(TurnsRight), "its heading changed by -0.9 rad"),
    BrokenFederate("turn", serve(ReportsDegrees), "its heading changed by 51.6 rad"),
    BrokenFederate("turn", serve(ReportsWrongSide), "ann drives forward at a heading of 0.8"),
    BrokenFederate("velocity", serve(ReportsNoVelocity), "its reported velocities give (0, 0, 0) m"),
    BrokenFederate("flight_axes", serve(FliesForward), "of 1.57 rad, and moved by (0, 2, 1) m"),
    BrokenFederate("flight_axes", serve(ReportsDegrees), "the heading of cy is 90 rad at the start"),
    BrokenFederate(
        "yaw", serve(IgnoresYaw), "the heading of cy is 0.5 rad 8 s after a command with this yaw, not 1.5"
    ),
    BrokenFederate("yaw", serve(ZeroesYaw), "the heading of cy is 0 rad 2 s after a command without a yaw"),
]
NETWORK_CASES = [
    BrokenFederate("handshake", serve(UnknownTransmitter), "KeyError: 'nobody'"),
    BrokenFederate(
        "ping",
        replace(serve(DelayNetwork), alter=add_to_first_integer(MessageKind.PONG, 1)),
        "the ping 0 was answered with 1",
    ),
    BrokenFederate(
        "malformed",
        replace(serve(DelayNetwork), alter=turn_errors_into(MessageKind.OUTCOMES)),
        "it must refuse a frame that ends",
    ),
    BrokenFederate(
        "counts",
        replace(serve(DelayNetwork), alter=turn_errors_into(MessageKind.OUTCOMES)),
        "it must refuse a count",
    ),
    BrokenFederate(
        "fork_absence",
        replace(serve(DelayNetwork, forks=False), alter=turn_errors_into(MessageKind.DONE)),
        "it must refuse fork",
    ),
    BrokenFederate("bye", replace(serve(DelayNetwork), stays_open=True), "it has not closed the connection"),
    BrokenFederate("first_request", serve(RefusesNegativeTimes), "ValueError: negative"),
    BrokenFederate(
        "exactly_once",
        replace(serve(DelayNetwork), alter=add_to_first_integer(MessageKind.OUTCOMES, 1)),
        "but advanced to",
    ),
    BrokenFederate(
        "exactly_once", serve(network_class(lambda _, arrivals, drops, to_ns: ([], drops))), "neither arrived nor"
    ),
    BrokenFederate(
        "exactly_once",
        serve(network_class(lambda _, arrivals, drops, to_ns: ([*arrivals, *arrivals[-1:]], drops))),
        "reported twice",
    ),
    BrokenFederate(
        "exactly_once",
        serve(
            network_class(
                lambda _, arrivals, drops, to_ns: ([], [Drop(arrival.packet_id, "") for arrival in arrivals])
            )
        ),
        "was dropped without a reason",
    ),
    BrokenFederate(
        "exactly_once",
        serve(
            network_class(
                lambda _, arrivals, drops, to_ns: ([arrival._replace(receiver="cy") for arrival in arrivals], [])
            )
        ),
        "for bob arrived at cy",
    ),
    BrokenFederate(
        "exactly_once",
        serve(
            network_class(
                lambda _, arrivals, drops, to_ns: ([arrival._replace(at_ns=to_ns + 1) for arrival in arrivals], [])
            )
        ),
        "not between",
    ),
    BrokenFederate(
        "exactly_once",
        serve(network_class(lambda _, arrivals, drops, to_ns: ([Arrival(99, "bob", to_ns)], []))),
        "the fate of packet 99 was reported, but it was not sent to the network",
    ),
    BrokenFederate(
        "exactly_once",
        serve(network_class(lambda _, arrivals, drops, to_ns: (arrivals[::-1], drops))),
        "order of time",
    ),
    BrokenFederate("exactly_once", serve(AnnouncesTooLate), "before the announced next event"),
    BrokenFederate("exactly_once", serve(AnnouncesThePast), "its next event is at 0 ns"),
    BrokenFederate("window_borders", serve(DropsAtBorders), "at the border of a window neither arrived"),
    BrokenFederate(
        "window_length",
        serve(
            network_class(
                lambda _, arrivals, drops, to_ns: ([arrival._replace(at_ns=to_ns) for arrival in arrivals], [])
            )
        ),
        "windows of another length changed an arrival",
    ),
    BrokenFederate("far_away", serve(ReportsNoDrops), "1,000 km away neither arrived nor"),
    BrokenFederate(
        "unknown_transport",
        replace(serve(DelayNetwork, transports=("udp",)), alter=turn_errors_into(MessageKind.OUTCOMES)),
        "it must refuse a packet of a transport",
    ),
    BrokenFederate("determinism", serve(network_class(lose_at_random)), "gave different arrivals or drops"),
    BrokenFederate("new_agent", serve(RefusesNewAgents, agents_appear=True), "KeyError"),
    BrokenFederate("absent_agent", serve(DeliversToAll, agents_disappear=True), "a packet arrived at bob, which has"),
    BrokenFederate("dead_reckoning", serve(DelaysDeadReckoning), "extrapolation at a velocity of 0 changed"),
    BrokenFederate("fork", serve(CopiesAreNetworkItself), "the copy and the original"),
    BrokenFederate("next_event", serve(AnnouncesTooLate), "before the announced next event"),
    BrokenFederate("next_event", serve(AnnouncesDropsTooLate), "packet 2 was dropped by 4000000 ns"),
    BrokenFederate("next_event", serve(AnnouncesNothing), "it has no next event, but packets [1, 2, 3] neither"),
    BrokenFederate("seed", serve(IgnoresSeed), "4 seeds gave the same arrivals and drops"),
]


def run(role: int, broken_federate: BrokenFederate) -> ConformanceResult:
    target = Target(broken_federate.pair, replace(HELLO, role=role), windows=100)
    return run_check(target, broken_federate.check, checks(is_physics=role == PHYSICS)[broken_federate.check])


@pytest.mark.parametrize(
    ("role", "broken_federate"),
    [*((PHYSICS, case) for case in PHYSICS_CASES), *((NETWORK, case) for case in NETWORK_CASES)],
    ids=lambda value: value.check if isinstance(value, BrokenFederate) else str(value),
)
def test_a_broken_federate_fails(role: int, broken_federate: BrokenFederate, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(probe, "_CLOSE_S", 0.2)
    result = run(role, broken_federate)
    assert broken_federate.message in result.failure
    assert result.request
    assert result.answer


def test_each_check_has_a_broken_federate() -> None:
    assert {case.check for case in PHYSICS_CASES} == checks(is_physics=True).keys()
    assert {case.check for case in NETWORK_CASES} == checks(is_physics=False).keys() - {"removed_packets"}


@pytest.mark.parametrize(
    ("make", "check", "message"),
    [
        (DelayNetwork, "seed", "no random losses occurred"),
        (LosesEverySecond, "seed", "no random losses occurred"),
        (LosesInOrder, "removed_packets", "had another fate without other packets"),
    ],
)
def test_draws_that_cannot_be_judged_are_skipped(make: type[DelayNetwork], check: str, message: str) -> None:
    result = run(NETWORK, BrokenFederate(check, serve(make), ""))
    assert not result.failure
    assert message in result.skipped


@pytest.mark.parametrize("role", [PHYSICS, NETWORK])
def test_the_federates_conform_before_they_are_broken(role: int) -> None:
    make = Carts if role == PHYSICS else LosesByKey
    for name in checks(is_physics=role == PHYSICS):
        settings: dict[str, Any] = {"transports": ("udp",)} if role == NETWORK else {}
        federate_class = LeavesOnTime if name == "lifetimes" else make
        pair = serve(
            federate_class, agents_appear=True, agents_disappear=True, forks=name != "fork_absence", **settings
        )
        result = run(role, BrokenFederate(name, pair, ""))
        assert (result.failure, result.skipped) == ("", ""), result


@pytest.mark.parametrize(
    ("check", "commands", "agents", "message"),
    [
        ("turn", (2,), slice(3), "it does not list the command twist"),
        ("yaw", (1, 2), slice(2), "the scenario has no agent that flies"),
    ],
)
def test_a_check_does_not_apply_without_the_commands_or_agents_that_it_needs(
    check: str, commands: tuple[int, ...], agents: slice, message: str
) -> None:
    hello = replace(HELLO, agents=HELLO.agents[agents])
    target = Target(serve(Carts, commands=commands), hello)
    assert run_check(target, check, checks(is_physics=True)[check]).skipped == message


def test_a_check_of_a_capability_that_is_not_declared_does_not_apply() -> None:
    for name in ("determinism", "fork", "drift", "command_time"):
        result = run(PHYSICS, BrokenFederate(name, serve(NoisyPhysics, is_deterministic=False, forks=False), ""))
        assert not result.failure
        assert "does not declare" in result.skipped
