"""Orders of the laptop to a program on a robot, each of which holds for a time: its lease.

They come in a file, a line `NUMBER ORDER SECONDS` with a higher number each time, replaced whole.
"""

from __future__ import annotations

import math
from typing import Sequence

from fieldkit.agent.boot_clock import now_s

_LONGEST_S = 86_400.0
_MOST_BYTES = 100


class Orders:
    """What the laptop wants, and until when that holds.

    Args:
        path: The file, which may be missing.
        known: The orders that there are.
        lease_s: For how long the first one may be awaited.

    Attributes:
        order: The last one; the first of those known while none has come.
    """

    def __init__(self, path: str, known: Sequence[str], lease_s: float) -> None:
        self.order = known[0]
        self._path = path
        self._known = known
        self._number = 0
        self._until_s = now_s() + lease_s

    def look(self) -> bool:
        """Take a new order, which may be the last one renewed; return whether there was one."""
        try:
            with open(self._path, encoding="ascii") as file:  # noqa: PTH123 (Python 3.8)
                number, order, lease = file.read(_MOST_BYTES).split()
            count, lease_s = int(number), float(lease)
        except (OSError, ValueError):
            return False
        if count <= self._number or order not in self._known or math.isnan(lease_s):
            return False
        self._number, self.order = count, order
        self._until_s = now_s() + min(max(lease_s, 0.0), _LONGEST_S)
        return True

    @property
    def lapsed(self) -> bool:
        """Whether the last order was not renewed in time; time in which the computer was suspended counts."""
        return now_s() > self._until_s
