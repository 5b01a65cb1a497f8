"""Reasons for the loss of packets, which models report when a loss happens."""

from collections.abc import Callable
from typing import Any, Final

LossLog = Callable[[int, Any, str, str], None]
"""Called with the time of the loss in ns, the payload, the station that will not receive it, and the reason.

For each packet passed to a model, each addressed station is reported exactly once: here, or as a delivery.
"""

OUT_OF_RANGE: Final = "out of range"
QUEUE_FULL: Final = "queue full"
RETRIES_EXHAUSTED: Final = "retries exhausted"
NOT_DECODED: Final = "broadcast not decoded"
LOST: Final = "lost on the link"
RADIO_OFF: Final = "radio off"
