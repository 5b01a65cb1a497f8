"""Runs simulations in real time: each window has an absolute deadline in wall time, and late windows are counted.

Sleeping for the length of each window would add the time of every computation to the duration of the run. With
absolute deadlines, a window that is late is followed by windows without a pause until the run has caught up.
"""

import time
from collections import Counter
from dataclasses import dataclass, field
from typing import Final

from fieldkit.core.errors import EvidenceError
from sim_backends.cosim.federates import seconds_text
from sim_backends.cosim.scenario.build import Simulation
from sim_backends.cosim.wall_time import Progress, rate_limited

LATE_BOUND_S: Final = 0.1
"""Default of the largest permitted lateness; equal to the default of `late_bound` of emulated robots."""


class RealTimeError(EvidenceError):
    """A run was slower than its pace (`--realtime`), so its results are not valid."""


@dataclass
class WindowLateness:
    """Lateness of the windows of a run: wall time from the deadline of a window until its end was computed.

    Attributes:
        windows: Number of windows by the upper limit of their lateness in nanoseconds: 0 for windows in time,
            otherwise 1, 2 or 5 times a power of ten, at least 100,000.
        largest_ns: Largest lateness, in nanoseconds; 0 if no window was late.
    """

    windows: Counter[int] = field(default_factory=Counter)
    largest_ns: int = 0

    def add(self, late_ns: int) -> None:
        """Count a window; a negative lateness is the remaining time until its deadline."""
        self.windows[_limit_ns(late_ns)] += 1
        self.largest_ns = max(self.largest_ns, late_ns)


_SHORTEST_NS: Final = 100_000
"""Smallest limit above 0; the kernel resumes a sleeping process with about this lateness."""


def _limit_ns(late_ns: int) -> int:
    """Return the smallest limit (a key of `WindowLateness.windows`) that is not below a lateness."""
    if late_ns <= 0:
        return 0
    decade_ns = _SHORTEST_NS
    while late_ns > 5 * decade_ns:
        decade_ns *= 10
    return next(factor * decade_ns for factor in (1, 2, 5) if late_ns <= factor * decade_ns)


@dataclass(frozen=True)
class Pace:
    """The pace of a run.

    Attributes:
        factor: Simulated seconds per second of wall time, above 0.
        late_bound_s: Largest permitted lateness, in seconds of wall time; a run with a later window is stopped.
    """

    factor: float
    late_bound_s: float = LATE_BOUND_S

    def run(self, simulation: Simulation, lateness: WindowLateness, progress: Progress | None = None) -> None:
        """Run a simulation until its end.

        A window that ends at the simulated time t has the deadline t / factor after the start of the run.

        Args:
            simulation: The simulation at time 0.
            lateness: The lateness of each window is added to it.
            progress: Reports the progress at most every 0.2 s of wall time, or None.

        Raises:
            RealTimeError: A window was later than the bound.
            FieldkitError: The policy, a federate or a program failed.
        """
        coordinator, end_ns = simulation.coordinator, simulation.scenario.duration_ns
        bound_ns = round(self.late_bound_s * 1e9)
        report = None if progress is None else rate_limited(progress)
        start_ns = time.monotonic_ns()
        while (now_ns := coordinator.situation.now_ns) < end_ns:
            coordinator.advance(end_ns, max_windows=1)
            window_end_ns, wall_ns = coordinator.situation.now_ns, time.monotonic_ns()
            if window_end_ns == now_ns:
                continue  # an empty window has the deadline of the previous window
            late_ns = wall_ns - start_ns - round(window_end_ns / self.factor)
            lateness.add(late_ns)
            if report is not None:
                report(window_end_ns)
            if late_ns > bound_ns:
                raise RealTimeError(
                    f"the run was slower than --realtime {self.factor:g}: the window that ends at "
                    f"{seconds_text(window_end_ns)} was {late_ns / 1e9:.3f} s late, and the bound is "
                    f"{self.late_bound_s:g} s",
                    remedy="use a lower --realtime, a longer window, or a less busy machine",
                )
            if late_ns < 0:
                time.sleep(-late_ns / 1e9)
