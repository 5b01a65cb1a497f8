"""Checks and measurements of the evidence of an attempt. Each evidence file is read once."""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from fieldkit.backends.protocols import CLOCK, INSTRUCTIONS
from fieldkit.config.profiles import TELEMETRY
from fieldkit.core.columns import PHY_RATE, Column, Measured, cell_text, step_prefixed
from fieldkit.core.errors import EvidenceError
from fieldkit.core.model import Lateness, RepeatId, Role, sort_roles
from fieldkit.measure.attempt import AttemptEvidence
from fieldkit.measure.evidence import link, link_samples, oracle_delays, track
from fieldkit.measure.positions import position_columns
from fieldkit.measure.robot_state import attempt_states, state_columns
from fieldkit.steps.capabilities import Roams
from fieldkit.steps.scene import Scene
from fieldkit.steps.view import View
from fieldkit.trial import hosts
from fieldkit.trial.plan import Plan
from fieldkit.trial.procedure import PlacedStep, Procedure
from fieldkit.trial.step_errors import StepErrors

# Units of values that depend on durations.
_TIME_UNITS: Final = frozenset(("s", "bit/s", "m/s", "ppm"))
_NO_TIMES: Final = "the backend's clock counts instructions of a virtual processor, so it measures no real durations"


@dataclass(frozen=True)
class EvidenceVerdict:
    """Result of the checks and measurements of an attempt's evidence.

    Attributes:
        problems: Reasons why the evidence is incomplete or contradictory and the attempt therefore void; one sentence
            each.
        measured: The values that could be measured.
        step_errors: Tracebacks of exceptions that steps and readers of files raised.
        notes: Sentences about values that are missing although the profile of a robot has a source for them.
    """

    problems: tuple[str, ...]
    measured: Measured
    step_errors: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()

    @property
    def has_failed(self) -> bool:
        """True if exceptions of steps are the only problems: another attempt would raise them again."""
        # Each exception is also one of the problems.
        return 0 < len(self.problems) <= len(self.step_errors)


def judge(plan: Plan, repeat: RepeatId, evidence: AttemptEvidence) -> EvidenceVerdict:
    """Measure an attempt and check that its evidence is complete.

    The evidence of steps inside a fault may be incomplete, because the fault disturbs it. Each column that a step
    declares must have a value or a reason why it is missing. If it has neither, a value was lost and the attempt is
    void. The attempt is also void if a step or the reader of a file raises an unexpected exception: whatever the
    files contain, the trial must continue, and it must be possible to resume and rebuild it.

    Raises:
        MemoryError: This machine has too little memory; this is not a problem of the evidence.
    """
    scene = plan.scene(repeat, "")  # no folder on the robots is needed, because no command is run
    step_errors = StepErrors()
    # The robots' states are checked first, because their problems cause many of the other problems.
    problems = list(hosts.problems(plan.procedure, scene, evidence, step_errors))
    # Lateness is the delay of an emulator relative to its radio model; robots with real radios have none.
    lateness = evidence.read_or_none(oracle_delays.read_lateness, oracle_delays.LATENESS_FILE)
    has_no_times = plan.simulators.get(CLOCK) == INSTRUCTIONS
    measured = oracle_delays.measure_lateness(lateness) | oracle_delays.measure_window_lateness(lateness)
    notes: list[str] = []
    for role in link.ROLES:
        link_columns = link.measure(role, evidence.links(role))
        if TELEMETRY in plan.cast[role].profile.sections:
            link_columns = _with_telemetry(plan, role, evidence, link_columns, notes)
        measured |= link_columns
    placement_problem = _placement_problem(scene, evidence)
    for placed in plan.procedure.walk():
        view = View(scene, evidence, placed.within)
        columns: tuple[Column, ...] = ()
        try:
            columns = placed.step.output_columns()
            result = placed.step.measure(view)
            impossible = dict(_impossible_values(placed, columns, result))
            if not placed.disturbed:
                problems += (_step_problem(placed, reason) for reason in placed.step.check(view))
                problems += _unexplained_columns(placed, columns, result)
                problems += impossible.values()
            result = result.without(impossible)
            if placement_problem:
                dependent = {
                    name: placement_problem for name in result.values if position_columns.depends_on_positions(name)
                }
                result = result.without(dependent)
            if has_no_times:
                result = result.without({column.name: _NO_TIMES for column in columns if _depends_on_clock(column)})
        except MemoryError:
            raise
        except Exception as error:  # noqa: BLE001 (see the docstring)
            reason = step_errors.add(f"the evidence of {placed.label} cannot be measured", error)
            problems.append(reason)
            result = Measured.all_missing(columns, reason)
        measured |= result.with_step_name(placed.step.prefix)
    problems += _testbed_problems(evidence)
    names = {role: scene.robot(role).name for role in sort_roles(plan.procedure.roles())}
    roaming = roaming_roles(plan.procedure)
    fixed = {role: name for role, name in names.items() if role not in roaming}
    problems += attempt_states.problems(evidence, fixed, plan.radios)
    measured = attempt_states.measure(evidence, names, measured)
    if has_no_times:
        states = [column for role in names for column in state_columns.declare_columns(role)]
        measured = measured.without({column.name: _NO_TIMES for column in states if _depends_on_clock(column)})
    # If the reader of an optional file raises an exception, the file counts as missing. This reports the exception.
    problems += (
        step_errors.add(f"{name} cannot be read", error) for name, error in tuple(evidence.unexpected_errors)
    )
    return EvidenceVerdict(tuple(problems), measured, tuple(step_errors.tracebacks), tuple(notes))


def _depends_on_clock(column: Column) -> bool:
    """Return True if a clock that measures no real durations makes a column invalid."""
    return column.unit in _TIME_UNITS and not column.name.endswith(PHY_RATE)


def roaming_roles(procedure: Procedure) -> frozenset[Role]:
    """Return the roles of the robots whose channel may change."""
    steps = (placed.step for placed in procedure.walk())
    return frozenset[Role]().union(*(step.roams() for step in steps if isinstance(step, Roams)))


def _with_telemetry(
    plan: Plan, role: Role, evidence: AttemptEvidence, link_columns: Measured, notes: list[str]
) -> Measured:
    """Return the columns of a robot's link, completed with the values of its telemetry sources.

    A note on each source that failed is added to `notes`.
    """
    from fieldkit.telemetry import telemetry_columns  # noqa: PLC0415 (few profiles have sources)
    from fieldkit.telemetry.telemetry_section import telemetry_of  # noqa: PLC0415

    telemetry = telemetry_of(plan.cast[role].profile)
    if telemetry is None:
        return link_columns
    verdict = telemetry_columns.measure(role, telemetry, evidence, link_columns)
    notes += verdict.notes
    return verdict.measured


def _placement_problem(scene: Scene, evidence: AttemptEvidence) -> str | None:
    """Return the reason why recorded positions contradict the planned placement, or None."""
    if not position_columns.are_recorded(evidence):
        return None
    from fieldkit.trial import placements  # noqa: PLC0415 (few attempts have recorded positions)

    return placements.contradiction(scene, evidence)


def _step_problem(placed: PlacedStep, reason: str) -> str:
    """Return a problem of a step's evidence. If the step has a name, the text starts with it."""
    return f"{placed.step.prefix}: {reason}" if placed.step.prefix else reason


def _unexplained_columns(placed: PlacedStep, columns: Iterable[Column], measured: Measured) -> Iterator[str]:
    for column in columns:
        if column.name not in measured.values and column.name not in measured.missing:
            yield f"{placed.label} gives neither a value nor a reason for {column.name}"


def _impossible_values(
    placed: PlacedStep, columns: Iterable[Column], measured: Measured
) -> Iterator[tuple[str, str]]:
    """Yield the name of each column whose measured value is NaN or outside its declared range, and the reason.

    Such values are removed, because a table that contains them could not be read again.
    """
    for column in columns:
        text = "" if column.type is str else cell_text(measured.values.get(column.name))
        if text and (problem := "not a number" if text == "nan" else column.invalid_value_reason(text)):
            yield (
                column.name,
                f"the evidence gives {step_prefixed(placed.step.prefix, column.name)} as {text}, {problem}",
            )


_TESTBED_FILES: Final[tuple[tuple[Callable[[Path], object], str], ...]] = (
    (oracle_delays.read_lateness, oracle_delays.LATENESS_FILE),
    (track.read, track.FILE),
    (link_samples.read, link_samples.FILE),
)


def _testbed_problems(evidence: AttemptEvidence) -> Iterator[str]:
    """Yield the problems of the files with the data of a modelled radio (`Testbed.oracle`), if there are any."""
    for read, name in _TESTBED_FILES:
        try:
            content = evidence.read(read, name) if evidence.has(name) else None
        except EvidenceError as error:
            yield f"{name}: {error.what}"
            continue
        if isinstance(content, Lateness) and (reason := oracle_delays.lateness_problem(content)):
            yield f"{name}: {reason}"
