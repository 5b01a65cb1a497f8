"""End of a job by its robot's clock: the robot notes it in seconds since boot, and its clock beside these."""

from fieldkit.core.model import Role
from fieldkit.measure.attempt import AttemptEvidence
from fieldkit.measure.evidence import clock, host


def ended_ns(evidence: AttemptEvidence, role: Role, job: str) -> int | None:
    """Return when a job ended, nanoseconds since 1970 UTC by its robot's clock, known to some 20 ms.

    None if the robot did not note it, booted meanwhile, or had its clock set during the attempt.

    Args:
        evidence: The attempt.
        role: Whose robot ran it.
        job: Its name.
    """
    before, after = (evidence.read_or_none(host.state, file(role)) for file in (host.before, host.after))
    if before is None or after is None or before.boot != after.boot:
        return None
    if before.clock is None or after.clock is None or clock.problem(before.clock, after.clock):
        return None
    ending = (after.endings or {}).get(job)
    if ending is None or ending.ended_s is None:
        return None
    return round(1e9 * ending.ended_s) + (after.clock.lowest_ns + after.clock.highest_ns) // 2
