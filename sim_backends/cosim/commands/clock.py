"""Progress of runs, and the estimated time left."""

import time
from collections.abc import Callable

from fieldkit.core.events import Progress, Sink


def progress_reporter(sink: Sink, unit: str = "runs") -> Callable[[str, float, float], None]:
    """Return a function that reports progress to a sink; its arguments are the activity, the total and the part done.

    The time left is estimated from the time since the first call for the same activity.

    Args:
        sink: Receives the events.
        unit: Unit of total and part.
    """
    started_s: dict[str, float] = {}

    def report(activity: str, total: float, done: float) -> None:
        now_s = time.monotonic()
        spent_s = now_s - started_s.setdefault(activity, now_s)
        left_s = spent_s * (total / done - 1) if done and spent_s else None
        sink(Progress(activity, done, total, unit, left_s))

    return report
