"""Each check of the conformance suite fails for a federate that is broken in what it checks."""

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
from sim_backends.federates.conformance.suite import CheckResult, checks, run_check
from sim_backends.federates.frames import NETWORK, PHYSICS, MessageKind
from sim_backends.network.disc import Disc
from sim_backends.network.packets import Arrival, Drop, Packet
from sim_backends.physics.body import Twist, Velocity
from sim_backends.world.motion import DeadReckoned, State
from tests.helpers.federate_examples import carts
from tests.helpers.federate_pairs import HELLO, Alter, Pair

Carts: Final = carts()
MS = 1_000_000
States = Mapping[str, State]


class Wrapped:
    """Moves agents as the example does; subclasses break it."""

    def __init__(self, hello: Any) -> None:  # noqa: ANN401
        self.carts = Carts(hello)
        self.step_ns = self.carts.step_ns
        self.limits_m_s2 = self.carts.limits_m_s2
        self.calls = 0

    def advance(self, to_ns: int, commands: Mapping[str, Any]) -> States:
        self.calls += 1
        return self.broken(self.carts.advance(to_ns, commands), to_ns)

    def broken(self, states: States, to_ns: int) -> States:
        return states


def shifted(state: State, east_m: float) -> State:
    east, north, up = state.position_m
    return state._replace(position_m=(east + east_m, north, up))


class StartsElsewhere(Wrapped):
    def broken(self, states: States, to_ns: int) -> States:
        return {name: shifted(state, 1.0) for name, state in states.items()}


class Drifts(Wrapped):
    def broken(self, states: States, to_ns: int) -> States:
        return {name: shifted(state, 1e-6 * self.calls) for name, state in states.items()}


class Jumps(Wrapped):
    def broken(self, states: States, to_ns: int) -> States:
        return {name: shifted(state, 3.0 * (to_ns > 50 * MS)) for name, state in states.items()}


class IgnoresCommands(Wrapped):
    def advance(self, to_ns: int, commands: Mapping[str, Any]) -> States:
        return super().advance(to_ns, {})


class HasWrongLimits(Wrapped):
    def __init__(self, hello: Any) -> None:  # noqa: ANN401
        super().__init__(hello)
        self.limits_m_s2 = dict.fromkeys(self.limits_m_s2, 0.1)


class Trembles(Wrapped):
    def broken(self, states: States, to_ns: int) -> States:
        return {name: shifted(state, random.random() * 1e-9) for name, state in states.items()}


class IsShared(Wrapped):
    def __deepcopy__(self, memo: dict[int, Any]) -> "IsShared":
        return self


class LosesAnAgent(Wrapped):
    def broken(self, states: States, to_ns: int) -> States:
        return {name: state for name, state in states.items() if name != "bob" or to_ns < 20 * MS}


class LeavesOnTime(Wrapped):
    """Has no state of an agent outside of its lifetime, which may be shifted, or at another place."""

    late_ns = 0
    east_m = 0.0

    def __init__(self, hello: Any) -> None:  # noqa: ANN401
        super().__init__(hello)
        self.lifetimes = hello.lifetimes

    def broken(self, states: States, to_ns: int) -> States:
        return {
            name: shifted(state, self.east_m)
            for name, state in states.items()
            if name not in self.lifetimes or self.lifetimes[name].contains(to_ns - self.late_ns)
        }


class LeavesLate(LeavesOnTime):
    late_ns = 1


class LosesAnotherAgent(LeavesOnTime):
    def broken(self, states: States, to_ns: int) -> States:
        return {name: state for name, state in super().broken(states, to_ns).items() if name != "bob"}


class AppearsElsewhere(LeavesOnTime):
    east_m = 2.0


class AddsAnAgent(Wrapped):
    def broken(self, states: States, to_ns: int) -> States:
        return {**states, **({"dan": states["bob"]} if to_ns > 20 * MS else {})}


class IsNotFinite(Wrapped):
    def broken(self, states: States, to_ns: int) -> States:
        return {name: shifted(state, math.nan * (to_ns > 0)) for name, state in states.items()}


class SwapsAxes(Wrapped):
    def broken(self, states: States, to_ns: int) -> States:
        return {name: state._replace(position_m=swapped(state.position_m)) for name, state in states.items()}


def swapped(position_m: tuple[float, float, float]) -> tuple[float, float, float]:
    east, north, up = position_m
    return north, east, up


class StandsStill(Wrapped):
    def broken(self, states: States, to_ns: int) -> States:
        return {name: state._replace(velocity_m_s=(0.0, 0.0, 0.0)) for name, state in states.items()}


class ReportsDegrees(Wrapped):
    def broken(self, states: States, to_ns: int) -> States:
        return {
            name: state._replace(heading_rad=math.degrees(state.heading_rad or 0.0)) for name, state in states.items()
        }


class ReportsOppositeTurns(Wrapped):
    def broken(self, states: States, to_ns: int) -> States:
        return {name: state._replace(heading_rad=-(state.heading_rad or 0.0)) for name, state in states.items()}


class ChangesCommands(Wrapped):
    """Moves as if it had received other commands."""

    def advance(self, to_ns: int, commands: Mapping[str, Any]) -> States:
        return super().advance(to_ns, {name: self.changed(command) for name, command in commands.items()})

    def changed(self, command: Any) -> Any:  # noqa: ANN401 (a command)
        return command


class TurnsRight(ChangesCommands):
    def changed(self, command: Any) -> Any:  # noqa: ANN401 (a command)
        return replace(command, turn_rad_s=-command.turn_rad_s) if isinstance(command, Twist) else command


class ReportsWrongSide(TurnsRight, ReportsOppositeTurns):
    """Turns to the right, and reports a turn to the left."""


class IgnoresYaw(ChangesCommands):
    def changed(self, command: Any) -> Any:  # noqa: ANN401 (a command)
        return replace(command, yaw_rad=None) if isinstance(command, Velocity) else command


class ZeroesYaw(ChangesCommands):
    def changed(self, command: Any) -> Any:  # noqa: ANN401 (a command)
        return replace(command, yaw_rad=command.yaw_rad or 0.0) if isinstance(command, Velocity) else command


class FliesForward(ChangesCommands):
    """Flies in the frame of its body, whose heading is pi/2 in the check."""

    def changed(self, command: Any) -> Any:  # noqa: ANN401 (a command)
        if not isinstance(command, Velocity):
            return command
        forward, left, up = command.velocity_m_s
        return replace(command, velocity_m_s=(-left, forward, up))


class IgnoresFrom(_Run):
    def _advance_physics(self, current: _FederateCopy, body: bytes) -> bytes:
        return super()._advance_physics(current, body[:8] + bytes(8) + body[16:])


Outcome = tuple[list[Arrival], list[Drop]]


class Net(Disc):
    """Delivers after 2 ms within 100 km; subclasses break it."""

    def __init__(self, hello: Any) -> None:  # noqa: ANN401
        super().__init__(1e5, 2 * MS, extrapolates=True)
        self.last_ns = -1

    def advance(self, to_ns: int, packets: Sequence[Packet], states: States) -> tuple[list[Arrival], list[Drop]]:
        arrivals, drops = super().advance(to_ns, packets, states)
        outcomes = self.broken(arrivals, drops, to_ns)
        self.last_ns = to_ns
        return outcomes

    def broken(self, arrivals: list[Arrival], drops: list[Drop], to_ns: int) -> tuple[list[Arrival], list[Drop]]:
        return arrivals, drops


def net(broken: Callable[[Net, list[Arrival], list[Drop], int], Outcome]) -> type[Net]:
    return type("Broken", (Net,), {"broken": broken})


class DropsAtBorders(Net):
    def advance(self, to_ns: int, packets: Sequence[Packet], states: States) -> Outcome:
        remaining = [packet for packet in packets if packet.enters_ns > self.last_ns]
        return super().advance(to_ns, remaining, states)


class RefusesNegativeTimes(Net):
    def advance(self, to_ns: int, packets: Sequence[Packet], states: States) -> Outcome:
        if to_ns < 0:
            raise ValueError("negative")
        return super().advance(to_ns, packets, states)


class ForgetsFarAway(Net):
    def advance(self, to_ns: int, packets: Sequence[Packet], states: States) -> Outcome:
        return super().advance(to_ns, packets, states)[0], []


class KnowsNoNewAgents(Net):
    def advance(self, to_ns: int, packets: Sequence[Packet], states: States) -> Outcome:
        for packet in packets:
            if packet.destination not in {"ann", "bob", "cy"}:
                raise KeyError(packet.destination)
        return super().advance(to_ns, packets, states)


class DeliversToAll(Net):
    def advance(self, to_ns: int, packets: Sequence[Packet], states: States) -> Outcome:
        return super().advance(to_ns, packets, {name: State((0.0, 0.0, 0.0)) for name in ("ann", "bob", "cy")})


class Reckons(Net):
    def advance(self, to_ns: int, packets: Sequence[Packet], states: States) -> Outcome:
        later = MS if isinstance(states, DeadReckoned) else 0
        return super().advance(
            to_ns, [packet._replace(enters_ns=packet.enters_ns + later) for packet in packets], states
        )


class SharedNet(Net):
    def __deepcopy__(self, memo: dict[int, Any]) -> "SharedNet":
        return self


class AnnouncesTooLate(Net):
    def next_event_ns(self) -> int | None:
        at_ns = super().next_event_ns()
        return None if at_ns is None else at_ns + 10 * MS


class AnnouncesDropsTooLate(Net):
    """Drops packets 2 ms after they entered, and announces 1 ms more."""

    def broken(self, arrivals: list[Arrival], drops: list[Drop], to_ns: int) -> Outcome:
        return [], [Drop(arrival.packet_id, "lost") for arrival in arrivals]

    def next_event_ns(self) -> int | None:
        at_ns = super().next_event_ns()
        return None if at_ns is None else at_ns + MS


class AnnouncesNothing(Net):
    """Announces no event, and never decides."""

    def advance(self, to_ns: int, packets: Sequence[Packet], states: States) -> Outcome:
        return [], []

    def next_event_ns(self) -> int | None:
        return None


class LosesByKey(Net):
    """Loses half of the packets beyond 30 m; its draws are keyed by seed, flow and number."""

    def __init__(self, hello: Any) -> None:  # noqa: ANN401
        super().__init__(hello)
        self.seed = hello.seed

    def advance(self, to_ns: int, packets: Sequence[Packet], states: States) -> Outcome:
        ends_m = [states[name].position_m for name in ("ann", "bob") if name in states]
        distance_m = math.dist(*ends_m) if len(ends_m) == 2 else 0.0
        lost = [packet for packet in packets if distance_m > 30 and self.draw(packet) < 0.5]
        arrivals, drops = super().advance(to_ns, [packet for packet in packets if packet not in lost], states)
        return arrivals, [*drops, *(Drop(packet.packet_id, "bad luck") for packet in lost)]

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


class AnnouncesThePast(Net):
    def next_event_ns(self) -> int | None:
        return 0


class Transmits(Net):
    transmitters = ("nobody",)


def random_delay(self: Net, arrivals: list[Arrival], drops: list[Drop], to_ns: int) -> Outcome:
    lost = [arrival for arrival in arrivals if random.random() < 0.5]
    remaining = [arrival for arrival in arrivals if arrival not in lost]
    return remaining, [Drop(arrival.packet_id, "bad luck") for arrival in lost]


def as_answer(kind: MessageKind) -> Alter:
    """Return a function that turns an error into an empty answer."""

    def alter(frame: bytes) -> bytes:
        return frame if frame[4] != MessageKind.ERROR else struct.pack("<IHH", 0, kind, 0) + frame[8:16]

    return alter


def later(kind: MessageKind, by: int) -> Alter:
    """Return a function that changes the first integer in the body of messages."""

    def alter(frame: bytes) -> bytes:
        if frame[4] != kind:
            return frame
        return frame[:16] + struct.pack("<q", struct.unpack_from("<q", frame, 16)[0] + by) + frame[24:]

    return alter


def silent(frame: bytes) -> bytes | None:
    return None if frame[4] in {MessageKind.STATES, MessageKind.OUTCOMES} else frame


@dataclass(frozen=True)
class Broken:
    check: str
    pair: Pair
    message: str


def physics(make: Any, **settings: Any) -> Pair:  # noqa: ANN401
    return Pair(FederateService(make, **settings))


PHYSICS_CASES = [
    Broken("handshake", physics(Carts, commands=(1, 2, 9)), "unknown types of commands: [9]"),
    Broken("ping", replace(physics(Carts), alter=later(MessageKind.PONG, 1)), "the ping 0 was answered with 1"),
    Broken(
        "malformed", replace(physics(Carts), alter=as_answer(MessageKind.STATES)), "it must refuse a frame that ends"
    ),
    Broken("counts", replace(physics(Carts), alter=as_answer(MessageKind.STATES)), "it must refuse a count"),
    Broken(
        "fork_absence", replace(physics(Carts, forks=False), alter=as_answer(MessageKind.DONE)), "it must refuse fork"
    ),
    Broken("bye", replace(physics(Carts), stays=True), "it has not closed the connection"),
    Broken("start", physics(StartsElsewhere), "ann starts 1 m away"),
    Broken("remainders", replace(physics(Carts), alter=later(MessageKind.STATES, 1)), "instead of 0 ns"),
    Broken("remainders", physics(LosesAnAgent), "there is no state of bob"),
    Broken("remainders", physics(AddsAnAgent), "an agent appeared, dan"),
    Broken("remainders", replace(physics(Carts), alter=silent, deadline_s=0.2), "has not answered for 0.2 s"),
    Broken("remainders", physics(IsNotFinite), "with a malformed frame: byte 32: the state of agent 0"),
    Broken("drift", physics(Drifts), "windows instead of one: the positions of ann differ"),
    Broken("repeated_time", physics(Drifts), "a second request for 20000000 ns gave other states"),
    Broken("motion", physics(Jumps), "moved by 3 m in a step"),
    Broken("motion", physics(IgnoresCommands), "moved by 0 m in 1000 steps"),
    Broken("limits", physics(HasWrongLimits), "its limit of 0.1 m/s^2 allows"),
    Broken("command_time", replace(physics(Carts), run_class=IgnoresFrom), "a command from 100000000 ns on"),
    Broken(
        "unknown_command", replace(physics(Carts), alter=as_answer(MessageKind.STATES)), "it must refuse a command"
    ),
    Broken("determinism", physics(Trembles), "gave different answers"),
    Broken("lifetimes", physics(LeavesLate, agents_disappear=True), "300000000 ns, has no state at 100000000 ns"),
    Broken("lifetimes", physics(LosesAnotherAgent, agents_disappear=True), "bob, which is always present, has no"),
    Broken("lifetimes", physics(AppearsElsewhere, agents_disappear=True), "ann appears 2 m away from the start"),
    Broken("fork", physics(IsShared), "the original"),
    Broken("drive_axes", physics(SwapsAxes), "0 rad, and moved by (0, 0.6, 0) m instead of 0.6 m east"),
    Broken("drive_axes", physics(ReportsDegrees), "the heading of ann is 90 rad at the start, not 1.57 rad"),
    Broken("turn", physics(TurnsRight), "its heading changed by -0.9 rad"),
    Broken("turn", physics(ReportsDegrees), "its heading changed by 51.6 rad"),
    Broken("turn", physics(ReportsWrongSide), "ann drives forward at a heading of 0.8"),
    Broken("velocity", physics(StandsStill), "its reported velocities give (0, 0, 0) m"),
    Broken("flight_axes", physics(FliesForward), "of 1.57 rad, and moved by (0, 2, 1) m"),
    Broken("flight_axes", physics(ReportsDegrees), "the heading of cy is 90 rad at the start"),
    Broken("yaw", physics(IgnoresYaw), "the heading of cy is 0.5 rad 8 s after a command with this yaw, not 1.5"),
    Broken("yaw", physics(ZeroesYaw), "the heading of cy is 0 rad 2 s after a command without a yaw"),
]
NETWORK_CASES = [
    Broken("handshake", physics(Transmits), "KeyError: 'nobody'"),
    Broken("ping", replace(physics(Net), alter=later(MessageKind.PONG, 1)), "the ping 0 was answered with 1"),
    Broken(
        "malformed", replace(physics(Net), alter=as_answer(MessageKind.OUTCOMES)), "it must refuse a frame that ends"
    ),
    Broken("counts", replace(physics(Net), alter=as_answer(MessageKind.OUTCOMES)), "it must refuse a count"),
    Broken(
        "fork_absence", replace(physics(Net, forks=False), alter=as_answer(MessageKind.DONE)), "it must refuse fork"
    ),
    Broken("bye", replace(physics(Net), stays=True), "it has not closed the connection"),
    Broken("first_request", physics(RefusesNegativeTimes), "ValueError: negative"),
    Broken("exactly_once", replace(physics(Net), alter=later(MessageKind.OUTCOMES, 1)), "it advanced to"),
    Broken("exactly_once", physics(net(lambda _, arrived, drops, to_ns: ([], drops))), "neither arrived nor"),
    Broken(
        "exactly_once",
        physics(net(lambda _, arrived, drops, to_ns: ([*arrived, *arrived[-1:]], drops))),
        "reported twice",
    ),
    Broken(
        "exactly_once",
        physics(net(lambda _, arrived, drops, to_ns: ([], [Drop(arrival.packet_id, "") for arrival in arrived]))),
        "was dropped without a reason",
    ),
    Broken(
        "exactly_once",
        physics(net(lambda _, arrived, drops, to_ns: ([arrival._replace(receiver="cy") for arrival in arrived], []))),
        "for bob arrived at cy",
    ),
    Broken(
        "exactly_once",
        physics(
            net(lambda _, arrived, drops, to_ns: ([arrival._replace(at_ns=to_ns + 1) for arrival in arrived], []))
        ),
        "not between",
    ),
    Broken(
        "exactly_once",
        physics(net(lambda _, arrived, drops, to_ns: ([Arrival(99, "bob", to_ns)], []))),
        "the fate of packet 99 was reported, but it was not sent to the network",
    ),
    Broken("exactly_once", physics(net(lambda _, arrived, drops, to_ns: (arrived[::-1], drops))), "order of time"),
    Broken("exactly_once", physics(AnnouncesTooLate), "before the announced next event"),
    Broken("exactly_once", physics(AnnouncesThePast), "its next event is at 0 ns"),
    Broken("window_borders", physics(DropsAtBorders), "at the border of a window neither arrived"),
    Broken(
        "window_length",
        physics(net(lambda _, arrived, drops, to_ns: ([arrival._replace(at_ns=to_ns) for arrival in arrived], []))),
        "windows of another length changed an arrival",
    ),
    Broken("far_away", physics(ForgetsFarAway), "1,000 km away neither arrived nor"),
    Broken(
        "unknown_transport",
        replace(physics(Net, transports=("udp",)), alter=as_answer(MessageKind.OUTCOMES)),
        "it must refuse a packet of a transport",
    ),
    Broken("determinism", physics(net(random_delay)), "gave different arrivals or drops"),
    Broken("new_agent", physics(KnowsNoNewAgents, agents_appear=True), "KeyError"),
    Broken("absent_agent", physics(DeliversToAll, agents_disappear=True), "a packet arrived at bob, which has"),
    Broken("dead_reckoning", physics(Reckons), "extrapolation at a velocity of 0 changed"),
    Broken("fork", physics(SharedNet), "the copy and the original"),
    Broken("next_event", physics(AnnouncesTooLate), "before the announced next event"),
    Broken("next_event", physics(AnnouncesDropsTooLate), "packet 2 was dropped until 4000000 ns"),
    Broken("next_event", physics(AnnouncesNothing), "it has no next event, and packets [1, 2, 3] neither"),
    Broken("seed", physics(IgnoresSeed), "4 seeds gave the same arrivals and drops"),
]


def run(role: int, broken: Broken) -> CheckResult:
    target = Target(broken.pair, replace(HELLO, role=role), windows=100)
    return run_check(target, broken.check, checks(is_physics=role == PHYSICS)[broken.check])


@pytest.mark.parametrize(
    ("role", "broken"),
    [*((PHYSICS, case) for case in PHYSICS_CASES), *((NETWORK, case) for case in NETWORK_CASES)],
    ids=lambda value: value.check if isinstance(value, Broken) else str(value),
)
def test_a_broken_federate_fails(role: int, broken: Broken, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(probe, "_CLOSE_S", 0.2)
    result = run(role, broken)
    assert broken.message in result.failure
    assert result.request
    assert result.answer


def test_each_check_has_a_broken_federate() -> None:
    assert {case.check for case in PHYSICS_CASES} == checks(is_physics=True).keys()
    assert {case.check for case in NETWORK_CASES} == checks(is_physics=False).keys() - {"removed_packets"}


@pytest.mark.parametrize(
    ("make", "check", "message"),
    [
        (Net, "seed", "no random losses were seen"),
        (LosesEverySecond, "seed", "no random losses were seen"),
        (LosesInOrder, "removed_packets", "had another fate without other packets"),
    ],
)
def test_draws_that_cannot_be_judged_are_skipped(make: type[Net], check: str, message: str) -> None:
    result = run(NETWORK, Broken(check, physics(make), ""))
    assert not result.failure
    assert message in result.skipped


@pytest.mark.parametrize("role", [PHYSICS, NETWORK])
def test_the_federates_conform_before_they_are_broken(role: int) -> None:
    make = Carts if role == PHYSICS else LosesByKey
    for name in checks(is_physics=role == PHYSICS):
        settings: dict[str, Any] = {"transports": ("udp",)} if role == NETWORK else {}
        used = LeavesOnTime if name == "lifetimes" else make
        pair = physics(used, agents_appear=True, agents_disappear=True, forks=name != "fork_absence", **settings)
        result = run(role, Broken(name, pair, ""))
        assert (result.failure, result.skipped) == ("", ""), result


@pytest.mark.parametrize(
    ("check", "commands", "agents", "message"),
    [
        ("turn", (2,), slice(3), "it does not list the command twist"),
        ("yaw", (1, 2), slice(2), "the scenario has no agent that flies"),
    ],
)
def test_a_check_of_other_commands_does_not_apply(
    check: str, commands: tuple[int, ...], agents: slice, message: str
) -> None:
    hello = replace(HELLO, agents=HELLO.agents[agents])
    target = Target(physics(Carts, commands=commands), hello)
    assert run_check(target, check, checks(is_physics=True)[check]).skipped == message


def test_a_check_of_a_capability_that_is_not_declared_does_not_apply() -> None:
    for name in ("determinism", "fork", "drift", "command_time"):
        result = run(PHYSICS, Broken(name, physics(Trembles, is_deterministic=False, forks=False), ""))
        assert not result.failure
        assert "does not declare" in result.skipped
