"""One attempt with its evidence, from which a step computes its checks and measurements."""

from collections.abc import Sequence
from dataclasses import dataclass

from fieldkit.core.model import Role
from fieldkit.measure.attempt import AttemptEvidence
from fieldkit.measure.captures.pcap import Capture
from fieldkit.measure.evidence import host, tcpdump_log
from fieldkit.steps.scene import Scene
from fieldkit.steps.surroundings import EnclosingStep


@dataclass(frozen=True)
class View:
    """One attempt with its evidence, for one step of the attempt.

    Attributes:
        scene: The attempt.
        evidence: The files of the attempt.
        within: The steps that contain the measured step, the outermost first.
    """

    scene: Scene
    evidence: AttemptEvidence
    within: Sequence[EnclosingStep] = ()

    def capture(self, role: Role) -> Capture | None:
        """Return the robot's capture that contains the step; None if there is none, or if it is incomplete."""
        name = capture_around(self.within, role)
        return None if name is None or self.dropped_packets(role) else self.evidence.undamaged_capture(name)

    def dropped_packets(self, role: Role) -> int:
        """Return the number of packets that a robot's kernel and interface dropped before tcpdump.

        The number is 0 if no capture contains the step, and if tcpdump's counters are missing. Another check reports
        missing counters.
        """
        name = capture_around(self.within, role)
        log = (
            None if name is None else self.evidence.read_or_none(tcpdump_log.read, tcpdump_log.capture_log_file(name))
        )
        return 0 if log is None else (log.dropped_by_kernel or 0) + (log.dropped_by_interface or 0)

    def attempt_window(self, role: Role) -> tuple[int, int] | None:
        """Return a robot's clock before and after the attempt, in ns since 1970; None if it was not recorded."""
        before, after = (
            self.evidence.read_or_none(host.read_state, file(role)) for file in (host.before_file, host.after_file)
        )
        if before is None or after is None or before.clock is None or after.clock is None:
            return None
        return before.clock.first_ns, after.clock.last_ns


def capture_around(within: Sequence[EnclosingStep], role: Role) -> str | None:
    """Return the file of the innermost capture around a step on one robot; None if the robot does not capture.

    Args:
        within: The steps that contain the step, the outermost first.
        role: Role of the robot.
    """
    files = (step.captures().get(role) for step in reversed(within))
    return next((file for file in files if file is not None), None)
