"""Mobility of robots in an emulated lab: where everybody is, as the medium is told, and since when."""

import math
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager, nullcontext
from types import MappingProxyType, TracebackType
from typing import Final, Self

from fieldkit.backends.protocols import Cast
from fieldkit.core import geometry
from fieldkit.core.errors import RobotError
from fieldkit.core.model import Move, Placement, Role, Vector, Whereabouts
from sim_backends.emulated import placement as places
from sim_backends.emulated.medium.client import MediumClient
from sim_backends.emulated.nodes import EmulatedRobot, Laptop
from sim_backends.emulated.provisioning import RobotKey
from sim_backends.emulated.ros.steered import Steered
from sim_backends.world.motion import STILL, Motion, State
from sim_backends.world.world import World

STEP_M: Final = 0.1
"""How far a robot may go until the medium is told again.

Loss grows by 10 n / (ln 10 d) dB per metre, with n = 3 by 1.3 dB/m at 10 m: a step is 0.13 dB there. Fading, which
turns within a wavelength of 0.12 m, goes on between the steps.
"""

_SHORTEST_S: Final = 0.02
_LONGEST_S: Final = 0.1

WATCH_S: Final = 0.05
"""How often robots that may steer themselves are looked at while they stand: 1 cm late at 0.2 m/s."""


class MotionThread:
    """Tells of a motion, step by step; use as a context manager, whose end is the end of the thread.

    Args:
        step: Tells where robots are now; returns after how many seconds to call it again, None when they stand.
        name: Name of the thread.

    Raises:
        FieldkitError: `step` did; raised when the context is left, unless its body raised.
    """

    def __init__(self, step: Callable[[], float | None], name: str = "motion") -> None:
        self._step = step
        self._left = threading.Event()
        self._error: BaseException | None = None
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._left.set()
        self._thread.join()
        if self._error is not None and error is None:
            raise self._error

    def _run(self) -> None:
        try:
            while (wait_s := self._step()) is not None and not self._left.wait(wait_s):
                continue
        except BaseException as error:  # noqa: BLE001 (whoever leaves the context gets it)
            self._error = error


def self_steered(
    robots: Mapping[RobotKey, EmulatedRobot], ways_ns: Mapping[RobotKey, int]
) -> dict[RobotKey, Steered]:
    """Return how robots move now by their own power that have used it since the lab put them where they were.

    Args:
        robots: The robots.
        ways_ns: When each was last told a way; what one says of an older one is over.
    """
    now_ns = time.monotonic_ns()
    said = {key: robot.steered() for key, robot in robots.items()}
    return {
        key: steered.at(now_ns) if steered.moves else steered
        for key, steered in said.items()
        if steered is not None and steered.way_ns == ways_ns.get(key)
    }


class Mobility:
    """Puts robots in their places, lets them move, takes one away and brings it back.

    Args:
        cast: Who plays which role.
        medium: Carries their packets.
        world: What they stand in.
        laptop: Stands among them; None where it is not on the air.
        robots: Told how they move, for their sensors; those that steer themselves say where they are.
        show: Takes where each robot is, metres east, north, up, for the lasers of the others.
    """

    def __init__(
        self,
        cast: Cast,
        medium: MediumClient,
        world: World,
        laptop: Laptop | None,
        robots: Mapping[Role, EmulatedRobot] = MappingProxyType({}),
        *,
        show: Callable[[Mapping[str, Vector]], None] = lambda positions_m: None,  # noqa: ARG005
    ) -> None:
        self._show = show
        self._robots = robots
        self._cast = cast
        self._medium = medium
        self._world = world
        self._laptop = laptop
        self._placement: Placement | None = None
        self._away: Role | None = None
        # Each with when it began, by the monotonic clock.
        self._motions: list[tuple[int, Motion]] = []
        # When each robot was last told a way: what it says of an older one is over.
        self._ways_ns: dict[Role, int] = {}
        self._seen: dict[Role, Steered] = {}
        self._track: list[Whereabouts] = []
        # A robot that moves does so in a thread of its own.
        self._turn = threading.RLock()

    def place(self, placement: Placement) -> None:
        """Put everybody in place, at once.

        Raises:
            LinkError: The medium ended or did not answer.
        """
        with self._turn:
            self._placement = placement
            # Robots first: what one says of its own way is over with the new one.
            for role in self._robots:
                self._tell_robot(Move(role, (), speed_m_s=1.0), time.monotonic_ns())
            self._tell()

    def put_back(self, role: Role) -> None:
        """Put one robot back in its place, at once; errors as `put_away`."""
        with self._turn:
            self._tell_robot(Move(role, (), speed_m_s=1.0), time.monotonic_ns())
            self._tell()

    def put_away(self, role: Role | None) -> None:
        """Take one robot out of everybody's range, or bring it back with None.

        Without the relay nobody hears anybody.

        Raises:
            LinkError: The medium ended or did not answer.
            RobotError: Nobody has a place yet.
        """
        with self._turn:
            self._placed()
            self._away = role
            self._tell()

    @contextmanager
    def moving(self, move: Move) -> Iterator[None]:
        """Let a robot move while the body runs; it is back at its place afterwards, at once, whatever ended the body.

        Raises:
            LinkError: The medium ended or did not answer.
            RobotError: Nobody has a place yet.
        """
        motion = places.motion(self._cast, self._placed(), move, self._world)
        entry = time.monotonic_ns(), motion
        with self._turn:
            self._motions.append(entry)
        try:
            self._tell_robot(move, entry[0])
            with MotionThread(self._tell):
                yield
        finally:
            with self._turn:
                self._motions.remove(entry)
                self._tell()
            self._tell_robot(Move(move.role, (), move.speed_m_s), time.monotonic_ns())

    def watching(self) -> AbstractContextManager[object]:
        """Return a context in which the medium is told of robots that steer themselves."""
        if not any(robot.spec.steers for robot in self._robots.values()):
            return nullcontext()
        return MotionThread(self._watch, "watch")

    def _watch(self) -> float:
        """Tell of robots that moved themselves since they were looked at last; return when to look again."""
        with self._turn:
            said = self._steered()
            if said == self._seen and not any(steered.moves for steered in said.values()):
                return WATCH_S
            self._seen = said
            self._tell()
            fastest_m_s = max((math.hypot(*steered.velocity_m_s) for steered in said.values()), default=0.0)
            return min(max(STEP_M / fastest_m_s, _SHORTEST_S), WATCH_S) if fastest_m_s else WATCH_S

    def _steered(self) -> dict[Role, Steered]:
        """Return how robots move by their own power that have used it since they were put in their places."""
        return self_steered(self._robots, self._ways_ns)

    def track(self, since_utc_ns: int) -> tuple[Whereabouts, ...]:
        """Return where each robot was from a moment on; what was before it is forgotten."""
        with self._turn:
            last = {
                whereabouts.role: number
                for number, whereabouts in enumerate(self._track)
                if whereabouts.utc_ns <= since_utc_ns
            }
            self._track = [
                whereabouts
                for number, whereabouts in enumerate(self._track)
                if number >= last.get(whereabouts.role, 0)
            ]
            return tuple(self._track)

    def _tell_robot(self, move: Move, began_ns: int) -> None:
        """Tell a robot how it moves."""
        placement = self._placed()
        if move.role in self._robots and move.role in geometry.positions_m(placement):
            self._ways_ns[move.role] = began_ns
            self._robots[move.role].move(places.own_way(placement, move, self._world, began_ns))

    def _placed(self) -> Placement:
        if self._placement is None:
            raise RobotError("the robots have no places yet", remedy="place them first")
        return self._placement

    def _tell(self) -> float | None:
        """Tell the medium where everybody is now; return when to do it again, in seconds, None while all stand."""
        with self._turn:
            placement, now_ns = self._placed(), time.monotonic_ns()
            positions_m = places.positions_m(self._cast, placement, self._world)
            states = {name: State(place_m) for name, place_m in positions_m.items()}
            for began_ns, motion in self._motions:
                states |= motion.at(now_ns - began_ns)
            states |= {
                self._cast[role].name: self._on_its_own(role, steered) for role, steered in self._steered().items()
            }
            relay = places.relay(self._cast, placement)
            if self._laptop is not None:
                states[self._laptop.name] = State(places.laptop_m(self._cast, placement, self._world))
            gone = None if self._away is None else self._cast[self._away].name
            self._show({name: state.position_m for name, state in states.items() if name != gone})
            if gone is not None:
                states = {} if gone == relay else {name: state for name, state in states.items() if name != gone}
            self._medium.place(
                {name: state.position_m for name, state in states.items()},
                relay=relay if relay in states else None,
                velocities_m_s={name: state.velocity_m_s for name, state in states.items()},
            )
            self._note(states)
            return self._due_s(now_ns, states)

    def _note(self, states: Mapping[str, State]) -> None:
        """Write down who is elsewhere than before, or moves otherwise."""
        utc_ns = time.time_ns()
        last = {whereabouts.role: whereabouts for whereabouts in self._track}
        for role, robot in self._cast.items():
            state = states.get(robot.name)
            now = (None, STILL) if state is None else (state.position_m, state.velocity_m_s)
            before = last.get(role)
            if before is None or (before.position_m, before.velocity_m_s) != now:
                self._track.append(Whereabouts(utc_ns, role, *now))

    def _on_its_own(self, role: Role, said: Steered) -> State:
        """Return the state of a robot that steers itself; one that does not fly is on the ground of the world."""
        state = said.state
        flies = self._cast[role].profile.mavlink is not None
        return state if flies else places.on_ground(state, self._world)

    def _due_s(self, now_ns: int, states: Mapping[str, State]) -> float | None:
        left_ns = [
            math.inf if motion.end_ns is None else began_ns + motion.end_ns - now_ns
            for began_ns, motion in self._motions
        ]
        if all(left <= 0 for left in left_ns):
            return None
        fastest_m_s = max((math.hypot(*state.velocity_m_s) for state in states.values()), default=0.0)
        step_s = STEP_M / fastest_m_s if fastest_m_s else _LONGEST_S
        next_end_s = min(left for left in left_ns if left > 0) / 1e9
        return min(max(step_s, _SHORTEST_S), _LONGEST_S, next_end_s)
