"""One attempt, as the measures of a step read it."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from fieldkit.core.model import Role
from fieldkit.measure.attempt import AttemptEvidence
from fieldkit.measure.captures.pcap import Capture
from fieldkit.measure.evidence import host, tcpdump_log
from fieldkit.steps.scene import Scene

if TYPE_CHECKING:
    from fieldkit.steps.nest import Nest


@dataclass(frozen=True)
class View:
    """One attempt as its measures see it.

    Attributes:
        scene: The attempt.
        evidence: What it left.
        within: The steps that the one that is measured ran inside, the outermost first.
    """

    scene: Scene
    evidence: AttemptEvidence
    within: Sequence["Nest"] = ()

    def capture(self, role: Role) -> Capture | None:
        """Return what a robot captured while the step ran; None where it did not, or its capture is not complete."""
        name = capture_around(self.within, role)
        return None if name is None or self.dropped(role) else self.evidence.whole_capture(name)

    def dropped(self, role: Role) -> int:
        """Return how many packets a robot's kernel and interface dropped before tcpdump while the step ran.

        It is 0 where no robot captured, or tcpdump gave no counters: such a capture is damaged in another way.
        """
        name = capture_around(self.within, role)
        log = None if name is None else self.evidence.read_or_none(tcpdump_log.read, tcpdump_log.log_of(name))
        return 0 if log is None else (log.dropped_by_kernel or 0) + (log.dropped_by_interface or 0)

    def captured(self, *roles: Role) -> bool:
        """Return whether all of these robots captured while the step ran."""
        return all(capture_around(self.within, role) is not None for role in roles)

    def attempt_window(self, role: Role) -> tuple[int, int] | None:
        """Return a robot's clock before and after the attempt, nanoseconds since 1970; None if it noted no clock."""
        before, after = (self.evidence.read_or_none(host.state, file(role)) for file in (host.before, host.after))
        if before is None or after is None or before.clock is None or after.clock is None:
            return None
        return before.clock.first_ns, after.clock.last_ns


def capture_around(within: Sequence["Nest"], role: Role) -> str | None:
    """Return the file of the innermost capture of a robot around a step; None where it does not capture.

    Args:
        within: The steps that the one that is asked about stands inside, the outermost first.
        role: Whose capture.
    """
    files = (nest.captures().get(role) for nest in reversed(within))
    return next((file for file in files if file is not None), None)
