"""Reasons for which packets never arrive, told as it happens."""

from collections.abc import Callable
from typing import Any, Final

LossLog = Callable[[int, Any, str, str], None]
"""Is called with when a packet was lost, in ns, what it carried, who will not get it, and why.

Of each packet that a model was given, each station that it was for is told once: here, or as a delivery.
"""

OUT_OF_RANGE: Final = "out of range"
QUEUE_FULL: Final = "queue full"
RETRIES_EXHAUSTED: Final = "retries exhausted"
NOT_DECODED: Final = "broadcast not decoded"
LOST: Final = "lost on the link"
RADIO_OFF: Final = "radio off"
