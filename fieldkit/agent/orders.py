"""Orders from the laptop to a program on a robot. Each order is valid for a limited time, its lease.

The laptop replaces a file with one line `NUMBER ORDER SECONDS`; the number increases with each order.
"""

from __future__ import annotations

import math
from typing import Sequence

from fieldkit.agent.boot_clock import now_s

CANCELLED = 7
"""Exit code of a program that a signal stopped while it did not move its robot: before it started to drive or fly, or
after the landing. `fieldkit stop` relies on this (`motion_state` in fieldkit/remote/motion.sh)."""
_MAX_LEASE_S = 86_400.0
_MAX_BYTES = 100


class Orders:
    """The current order of the laptop and its lease.

    Args:
        path: The file, which may be missing.
        valid_orders: The valid orders.
        lease_s: Timeout for the first order.

    Attributes:
        order: The last order; the first of the valid orders until an order arrives.
    """

    def __init__(self, path: str, valid_orders: Sequence[str], lease_s: float) -> None:
        self.order = valid_orders[0]
        self._path = path
        self._valid_orders = valid_orders
        self._number = 0
        self._expiry_s = now_s() + lease_s

    def poll(self) -> bool:
        """Read the file; return True if it contains a new order, which may be a renewal of the last one."""
        try:
            with open(self._path, encoding="ascii") as file:  # noqa: PTH123 (Python 3.8)
                number_text, order, lease_text = file.read(_MAX_BYTES).split()
            number, lease_s = int(number_text), float(lease_text)
        except (OSError, ValueError):
            return False
        if number <= self._number or order not in self._valid_orders or math.isnan(lease_s):
            return False
        self._number, self.order = number, order
        self._expiry_s = now_s() + min(max(lease_s, 0.0), _MAX_LEASE_S)
        return True

    @property
    def expired(self) -> bool:
        """Whether the last order was not renewed in time. Time during which the computer was suspended counts."""
        return now_s() > self._expiry_s
