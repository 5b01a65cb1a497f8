"""End times of jobs by the robot's clock, from the time since boot that the robot recorded."""

from fieldkit.core.model import Role
from fieldkit.measure.attempt import AttemptEvidence
from fieldkit.measure.evidence import clock, host


def ended_ns(evidence: AttemptEvidence, role: Role, job: str) -> int | None:
    """Return the time at which a job ended, in nanoseconds since 1970 UTC by the robot's clock, to about 20 ms.

    None if the robot did not record it, rebooted, or had its clock set during the attempt.

    Args:
        evidence: The attempt.
        role: Role of the robot that ran the job.
        job: The job's name.
    """
    before, after = (evidence.read_or_none(host.state, file(role)) for file in (host.before, host.after))
    if before is None or after is None or before.boot != after.boot:
        return None
    if before.clock is None or after.clock is None or clock.step_description(before.clock, after.clock):
        return None
    ending = (after.endings or {}).get(job)
    if ending is None or ending.ended_s is None:
        return None
    return round(1e9 * ending.ended_s) + (after.clock.lowest_ns + after.clock.highest_ns) // 2
