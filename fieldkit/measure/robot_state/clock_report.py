"""Report of a program on a robot's clock. The parsers of `chronyc`, `timedatectl` and `pmc` return it."""

from dataclasses import dataclass


@dataclass(frozen=True)
class ClockReport:
    """Report of one program on the clock of its robot.

    Attributes:
        program: Name of the program that sets the clock: `chrony`, `systemd-timesyncd` or `ptp4l`; empty if no
            program sets it.
        reference: Name or address of the time source; empty if there is no time source, or if it is unknown.
        offset_s: Clock minus time source in seconds; None if unknown.
        error_s: Maximum error of `offset_s` in seconds if the time source is correct; None if unknown.
        problem: Reason why the clock is not synchronized, such as `chrony has no source`; empty if it is
            synchronized.
    """

    program: str
    reference: str = ""
    offset_s: float | None = None
    error_s: float | None = None
    problem: str = ""

    @property
    def is_synchronized(self) -> bool:
        """True if the program has a time source and reports an offset from it."""
        return not self.problem and self.offset_s is not None
