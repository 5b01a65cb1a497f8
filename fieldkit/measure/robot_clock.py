"""The clock of a robot: its offset from the laptop's clock, the maximum error of the offset, end times of jobs."""

from collections.abc import Sequence
from dataclasses import dataclass

from fieldkit.core.model import Role
from fieldkit.measure.attempt import AttemptEvidence
from fieldkit.measure.evidence import clock, host


@dataclass(frozen=True)
class Exchange:
    """One exchange of timestamps as in RFC 5905, section 8, without a processing time on the robot.

    Attributes:
        request_ns: Laptop's clock before the request was sent, nanoseconds since 1970 UTC.
        robot_ns: Robot's clock at a time between request and response.
        response_ns: Laptop's clock after the response arrived.
        resolution_ns: Resolution of `robot_ns`: the exact time is later by at most this value. 0 if it is exact.
    """

    request_ns: int
    robot_ns: int
    response_ns: int
    resolution_ns: int = 0

    @property
    def width_ns(self) -> int:
        """Width of the interval that contains the offset."""
        return self.response_ns - self.request_ns + self.resolution_ns


@dataclass(frozen=True)
class Offset:
    """Offset of a robot's clock from the laptop's clock.

    Attributes:
        offset_s: Estimate in seconds; positive if the robot's clock is ahead.
        error_s: Maximum error of the estimate in seconds, regardless of the delays of request and response.
    """

    offset_s: float
    error_s: float


def offset(exchanges: Sequence[Exchange]) -> Offset:
    """Return the offset, computed from the exchange with the narrowest interval.

    The robot read its clock at a time between request and response, so its offset is between `robot - response` and
    `robot + resolution - request`. The estimate is the midpoint of this interval, and its error is half the width.

    Raises:
        ValueError: There is no exchange.
    """
    narrowest = min(exchanges, key=lambda exchange: exchange.width_ns)
    robot_ns = narrowest.robot_ns + narrowest.resolution_ns / 2
    midpoint_ns = robot_ns - narrowest.request_ns - (narrowest.response_ns - narrowest.request_ns) / 2
    return Offset(offset_s=midpoint_ns / 1e9, error_s=narrowest.width_ns / 2e9)


def parse_date(text: str) -> tuple[int, int] | None:
    """Return the time that `date -u +%s.%N` printed, in nanoseconds since 1970, and its resolution in nanoseconds.

    Return None if the text is invalid. busybox does not support `%N` and prints it literally or omits it; the
    resolution is then one second.
    """
    seconds, _, fraction = text.strip().partition(".")
    if not (seconds.isascii() and seconds.isdigit() and len(seconds) <= 11):
        return None
    if len(fraction) == 9 and fraction.isascii() and fraction.isdigit():
        return int(seconds) * 10**9 + int(fraction), 0
    return int(seconds) * 10**9, 10**9


def job_end_ns(evidence: AttemptEvidence, role: Role, job: str) -> int | None:
    """Return the end time of a job by the robot's clock, in nanoseconds since 1970 UTC.

    It is accurate to about 20 ms, or to 0.5 s if the robot recorded its clock in whole seconds. Return None if the
    robot did not record it, if the robot rebooted, or if its clock was set during the attempt.

    Args:
        evidence: The attempt.
        role: Role of the robot that ran the job.
        job: The job's name.
    """
    before, after = (
        evidence.read_or_none(host.read_state, file(role)) for file in (host.before_file, host.after_file)
    )
    if before is None or after is None or before.boot != after.boot:
        return None
    if before.clock is None or after.clock is None or clock.step_description(before.clock, after.clock):
        return None
    termination = (after.terminations or {}).get(job)
    if termination is None or termination.ended_s is None:
        return None
    return round(1e9 * termination.ended_s) + (after.clock.lowest_ns + after.clock.highest_ns) // 2
