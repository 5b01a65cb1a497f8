"""Judge what each robot noted of itself before and after an attempt: its boot, its clock, how its jobs ended."""

from collections.abc import Iterator, Sequence
from typing import Final

from fieldkit.core.model import Role
from fieldkit.measure.attempt import AttemptEvidence
from fieldkit.measure.evidence import clock, endings, host
from fieldkit.measure.evidence.host import HostState
from fieldkit.steps.scene import Scene
from fieldkit.trial.procedure import Procedure

_LOST: Final = "its state before the attempt and that after it do not both have the section {}"
REBOOTED: Final = "the robot rebooted during the repeat"


def problems(procedure: Procedure, scene: Scene, evidence: AttemptEvidence) -> Iterator[str]:
    """Yield what happened to a robot that spoils the attempt, and what is missing of its notes.

    Notes that a robot cannot provide are missing before and after; those of one moment alone were lost. A robot that
    a step restarts is judged by its jobs alone: its clock begins anew.
    """
    on_purpose = restarted(procedure)
    for role in sorted(procedure.roles()):
        name = scene.robot(role).name
        before, after = (evidence.read_or_none(host.state, file(role)) for file in (host.before, host.after))
        for file, state in ((host.before(role), before), (host.after(role), after)):
            if state is None:
                yield f"{name}: {file} is missing, or cannot be read"
        if before is not None and after is not None:
            yield from (f"{name}: {_LOST.format(section)}" for section in host.lacking(before, after))
        if before is not None and after is not None and role not in on_purpose:
            if rebooted(before.boot, after.boot):
                yield f"{name}: {REBOOTED}"
                continue  # so its jobs were cut, and its clock begins anew
            yield from (f"{name}: {why}" for why in _of_the_clock(before, after))
        if after is not None and after.endings is not None:
            yield from (f"{name}: {why}" for why in _of_the_jobs(procedure, scene, role, after, evidence))


def restarted(procedure: Procedure) -> frozenset[Role]:
    """Return whose robots are restarted on purpose."""
    return frozenset[Role]().union(*(placed.step.restarts() for placed in procedure.walk()))


def without_effects(reasons: Sequence[str]) -> list[str]:
    """Return why an attempt is void; of a robot that rebooted, what went wrong with it for that is left out."""
    reasons = list(dict.fromkeys(reasons))  # a link that is away fails the step and the fetching alike
    robots = [reason.removesuffix(REBOOTED) for reason in reasons if reason.endswith(f": {REBOOTED}")]
    return [reason for reason in reasons if reason.endswith(REBOOTED) or not reason.startswith(tuple(robots))]


def rebooted(before: str | None, after: str | None) -> bool:
    """Return whether two identifications of a boot differ."""
    return before is not None and after is not None and before != after


def _of_the_clock(before: HostState, after: HostState) -> Iterator[str]:
    if before.clock is not None and after.clock is not None and (why := clock.problem(before.clock, after.clock)):
        yield why


def _of_the_jobs(
    procedure: Procedure, scene: Scene, role: Role, after: HostState, evidence: AttemptEvidence
) -> Iterator[str]:
    """Yield which jobs of steps that no fault disturbs did not end as they are to."""
    for placed in procedure.walk():
        for planned in () if placed.disturbed else placed.step.own_jobs(scene):
            if planned.role is not role:
                continue
            ending = (after.endings or {}).get(planned.job.name)
            if (
                ending is None
                and role not in restarted(procedure)
                and any(evidence.has(file) for file in (planned.job.log, planned.job.stdout) if file)
            ):
                yield f"its job {planned.job.name} ran, and nothing says how it ended"
            if ending and (why := endings.problem(ending, planned.ends, planned.least_s)):
                yield f"its job {planned.job.name} {why}"
