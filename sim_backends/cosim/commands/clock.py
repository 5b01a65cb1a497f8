"""How far runs are, and how much time is left."""

import time
from collections.abc import Callable

from fieldkit.core.events import Progress, Sink


def teller(sink: Sink, unit: str = "runs") -> Callable[[str, float, float], None]:
    """Return what tells a sink what is done, of how much in all, and how much of it.

    Time left is told from the first call on for the same work.

    Args:
        sink: Who is told.
        unit: What is counted.
    """
    begun_s: dict[str, float] = {}

    def tell(what: str, total: float, done: float) -> None:
        now_s = time.monotonic()
        spent_s = now_s - begun_s.setdefault(what, now_s)
        sink(Progress(what, done, total, unit, spent_s * (total / done - 1) if done and spent_s else None))

    return tell
