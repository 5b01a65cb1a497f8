"""Check each robot's state before and after an attempt: reboots, clock changes, and terminations of jobs."""

from collections.abc import Iterable, Iterator, Sequence
from typing import Final

from fieldkit.core.model import Role
from fieldkit.measure.attempt import AttemptEvidence
from fieldkit.measure.evidence import clock, host, terminations
from fieldkit.measure.evidence.host import HostState
from fieldkit.steps.capabilities import Restarts
from fieldkit.steps.nest import own_jobs
from fieldkit.steps.scene import Planned, Scene
from fieldkit.trial.procedure import Procedure
from fieldkit.trial.step_errors import StepErrors

_LOST_SECTION: Final = "the section {} is missing in its state before or in its state after the attempt"
REBOOTED: Final = "the robot rebooted during the repeat"


def problems(procedure: Procedure, scene: Scene, evidence: AttemptEvidence, step_errors: StepErrors) -> Iterator[str]:
    """Yield the robots' problems that make an attempt void, including missing sections of their state files.

    A section that a robot cannot provide is missing before and after the attempt. A section that is missing only
    once was lost. If a step restarts a robot, the robot's boot ID and clock are not compared, because both change.
    Exceptions of steps are added to `step_errors`.
    """
    planned_jobs: list[Planned] = []
    for placed in procedure.walk():
        try:
            planned_jobs += () if placed.disturbed else own_jobs(placed.step, scene)
        except Exception as error:  # noqa: BLE001 (a step of another package: the trial must continue and be rebuildable)
            yield step_errors.add(f"the commands of {placed.label} cannot be derived", error)
    restarted = restarted_roles(procedure)
    for role in sorted(procedure.roles()):
        name = scene.robot(role).name
        before, after = (
            evidence.read_or_none(host.read_state, file(role)) for file in (host.before_file, host.after_file)
        )
        for file, state in ((host.before_file(role), before), (host.after_file(role), after)):
            if state is None:
                yield f"{name}: {file} is missing, or cannot be read"
        if before is not None and after is not None:
            yield from (
                f"{name}: {_LOST_SECTION.format(section)}" for section in host.incomplete_sections(before, after)
            )
        if before is not None and after is not None and role not in restarted:
            if has_rebooted(before.boot, after.boot):
                yield f"{name}: {REBOOTED}"
                continue  # a reboot also terminates the jobs and restarts the clock
            yield from (f"{name}: {reason}" for reason in _clock_problems(before, after))
        if after is not None and after.terminations is not None:
            yield from (
                f"{name}: {reason}" for reason in _job_problems(procedure, planned_jobs, role, after, evidence)
            )


def restarted_roles(procedure: Procedure) -> frozenset[Role]:
    """Return the roles of the robots that a step restarts."""
    steps = (placed.step for placed in procedure.walk() if isinstance(placed.step, Restarts))
    return frozenset[Role]().union(*(step.restarts() for step in steps))


def drop_effects_of_reboots(reasons: Sequence[str]) -> list[str]:
    """Return the reasons why an attempt is void, without duplicates and without the effects of reboots.

    If a robot rebooted, all other reasons that start with the robot's name are removed.
    """
    # If a link is lost, a step and the fetching of evidence give the same reason.
    reasons = list(dict.fromkeys(reasons))
    rebooted_robots = [reason.removesuffix(REBOOTED) for reason in reasons if reason.endswith(f": {REBOOTED}")]
    return [
        reason for reason in reasons if reason.endswith(REBOOTED) or not reason.startswith(tuple(rebooted_robots))
    ]


def has_rebooted(before: str | None, after: str | None) -> bool:
    """Return True if both boot IDs are known and differ."""
    return before is not None and after is not None and before != after


def _clock_problems(before: HostState, after: HostState) -> Iterator[str]:
    if (
        before.clock is not None
        and after.clock is not None
        and (reason := clock.step_description(before.clock, after.clock))
    ):
        yield reason


def _job_problems(
    procedure: Procedure, planned_jobs: Iterable[Planned], role: Role, after: HostState, evidence: AttemptEvidence
) -> Iterator[str]:
    """Yield a sentence for each job on a robot that did not end as required."""
    for planned in planned_jobs:
        if planned.role is not role:
            continue
        termination = (after.terminations or {}).get(planned.job.name)
        if (
            termination is None
            and role not in restarted_roles(procedure)
            and any(evidence.has(file) for file in (planned.job.log, planned.job.stdout) if file)
        ):
            yield f"its job {planned.job.name} ran, but its exit was not recorded"
        if termination and (
            reason := terminations.termination_error(termination, planned.permitted_causes, planned.min_duration_s)
        ):
            yield f"its job {planned.job.name} {reason}"
