"""Record positions of robots while steps run, with the offsets of their clocks and the source of each position."""

import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from typing import Final

from fieldkit.backends.protocols import Testbed
from fieldkit.core.columns import Measured, columns
from fieldkit.core.errors import EvidenceError, FieldkitError
from fieldkit.core.model import Role
from fieldkit.core.threads import run_parallel
from fieldkit.measure.positions import position_sources, recorded_positions
from fieldkit.measure.positions.position_sources import PositionSource, PositionSources
from fieldkit.measure.positions.samples import PLACED
from fieldkit.measure.robot_clock import Exchange, Offset, offset
from fieldkit.remote import jobs
from fieldkit.steps import clocks
from fieldkit.steps.capabilities import Moves
from fieldkit.steps.nest import Nest, steps_inside
from fieldkit.steps.scene import Announce, Planned, Scene
from fieldkit.steps.surroundings import EarlierStep, EnclosingStep
from fieldkit.steps.view import View

LIMIT_S: Final = 900.0
"""Time limit of a recording in addition to the limits of the steps inside."""
CLOSE_S: Final = 10.0
"""Time that a stopped recorder has to close its file."""
_QUERY_TIMEOUT_S: Final = 15.0
"""Timeout of a query of a robot's clock."""
_ROUNDING_M: Final = 1e-3
"""Maximum difference between the recorded and the planned position that rounding causes."""

COLUMNS: Final = columns(
    100,
    (
        "positions_from",
        "text",
        "Source of each robot's positions: a topic, a message type of a telemetry log, a file, or a fixed place.",
    ),
    ("positions_clock_error_s", "s", "Maximum error of the time between two robots' clocks."),
)
"""Columns of trials with a step that records positions."""

MakeSources = Callable[[int, Mapping[Role, Offset]], PositionSources]
"""Returns the sources of positions. The arguments are the start of the steps inside, in nanoseconds since 1970 UTC by
the laptop's clock, and the offsets of the robots' clocks from this clock.
"""


def run_while_recording(
    nest: Nest,
    scene: Scene,
    testbed: Testbed,
    announce: Announce,
    recordings: Sequence[Planned],
    *,
    make_sources: MakeSources | None,
    extra_s: Callable[[Planned], int],
) -> Sequence[tuple[Planned, int]]:
    """Run the steps inside `nest` while recordings run; return each recording with its exit code.

    Args:
        nest: The step.
        scene: The attempt.
        testbed: The robots.
        announce: Called when a phase of the step starts; see `Step.run`.
        recordings: Jobs that record until they are stopped.
        make_sources: Returns the sources of positions; None if the recordings contain no positions.
        extra_s: Returns the whole seconds for which a recording continues after the last step, so that a position at
            the end of the step can be interpolated between two messages.

    Raises:
        FieldkitError: A step inside failed, or a robot did not answer.
    """
    exchanges: dict[Role, list[Exchange]] = {role: [] for role in nest.roles()} if make_sources else {}

    def query_clock(role: Role) -> None:
        exchanges[role] += clocks.exchanges(testbed.shells[role], _QUERY_TIMEOUT_S)

    def wait(recording: Planned) -> None:
        seconds = extra_s(recording)
        jobs.begin_wait(testbed.shells[recording.role], recording.job, seconds).end(seconds + jobs.REPLY_S)

    try:
        run_parallel(lambda planned: jobs.start(testbed.shells[planned.role], planned.job), recordings)
        run_parallel(query_clock, list(exchanges))
        start_utc_ns = time.time_ns()
        for entry in nest.during:
            entry.step.run(scene, testbed, announce)
        run_parallel(query_clock, list(exchanges))
        run_parallel(wait, recordings)
    except FieldkitError:
        # The recordings are kept with the failed attempt. The first error is the cause of the failure.
        with suppress(FieldkitError):
            _stop(testbed, recordings)
        raise
    codes = _stop(testbed, recordings)
    if scene.laptop_folder is not None and make_sources is not None:
        offsets = {role: offset(results) for role, results in exchanges.items() if results}
        path = scene.laptop_folder / position_sources.FILE
        # Steps inside may have written the sources for other robots.
        inner_sources = position_sources.read(path) if path.exists() else PositionSources()
        sources = position_sources.merge(inner_sources, make_sources(start_utc_ns, offsets))
        path.write_text(position_sources.text(sources), encoding="utf-8")
    return list(zip(recordings, codes, strict=True))


def _stop(testbed: Testbed, recordings: Sequence[Planned]) -> Sequence[int]:
    """Stop the recordings; return the exit code of each."""

    def stop(recording: Planned) -> int:
        return jobs.stop(testbed.shells[recording.role], recording.job, grace_s=CLOSE_S)

    return run_parallel(stop, recordings)


def stationary_robots(nest: Nest, scene: Scene) -> Mapping[Role, PositionSource]:
    """Return the fixed positions of the robots of a step that do not move while the steps inside run.

    Robots that were not placed are omitted.
    """
    movers = (step for step in steps_inside(nest) if isinstance(step, Nest) and step.has_path)
    moving = frozenset[Role]().union(*(step.moves() for step in movers if isinstance(step, Moves)))
    places_m = {role: place_m for role, place_m in scene.places_m.items() if role not in moving}
    return {role: PositionSource(place=places_m[role]) for role in nest.roles() if role in places_m}


def placement_error(kind: str, earlier: Sequence[EarlierStep], within: Sequence[EnclosingStep]) -> str | None:
    """Return the reason why a step that records positions must not be at its place in a procedure; None if it may.

    Args:
        kind: The kind of the step, for the message.
        earlier: The steps that start before it.
        within: The steps that contain it.
    """
    if any(position_sources.FILE in step.files() for step in earlier):
        return (
            "a repeat can have only one step that records positions (track, or mavlink with positions); add further "
            "positions after the trial: fieldkit positions"
        )
    if any(nest.has_path for nest in within):
        return f"a {kind} must start before robots move: put the move into the {kind}"
    if any(nest.disturbs or nest.parallel for nest in within):
        return f"a {kind} must not be inside a step fault or together: put that step into the {kind}"
    return None


def problems(view: View, roles: Sequence[Role]) -> Iterator[str]:
    """Yield the reasons why the recorded positions of robots cannot be used."""
    try:
        sources = recorded_positions.read_position_sources(view.evidence)
        for role in roles:
            recorded_positions.samples_of(view.evidence, role)
    except EvidenceError as error:
        yield error.what
        return
    if not sources.robots:
        yield f"{position_sources.FILE} is missing"
    yield from _place_problems(view, sources)


def _place_problems(view: View, sources: PositionSources) -> Iterator[str]:
    """Yield a reason for each robot whose fixed position or start differs from its placement.

    Positions in another frame than the placement, and positions from a GPX or CSV file, are not compared.
    """
    for role, position_source in sources.robots.items():
        planned_m = view.scene.places_m.get(role)
        recorded_m = position_source.place if position_source.place is not None else position_source.start
        if (
            planned_m is None
            or position_source.frame != PLACED
            or position_source.offset_s
            or not (position_source.place or position_source.topic)  # a GPX or CSV file
        ):
            continue
        deviation_m = math.dist(planned_m, [metres or 0.0 for metres in recorded_m])
        if deviation_m > _ROUNDING_M:
            yield f"in {position_sources.FILE}, the {role} is {deviation_m:.1f} m away from its placement"


def measure(view: View) -> Measured:
    """Return the values of `COLUMNS`: source of the positions, and error of the clocks."""
    values = {
        "positions_from": recorded_positions.sources_text(view.evidence),
        "positions_clock_error_s": recorded_positions.clock_error_s(view.evidence),
    }
    return Measured.from_optional(values, f"{position_sources.FILE} does not contain it")
