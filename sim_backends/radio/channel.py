"""Protocol of a channel: how strong stations hear each other, as Wi-Fi needs to know it."""

from collections.abc import Sequence
from typing import Protocol

from sim_backends.radio.rate_control import RateControl


class RadioChannel(Protocol):
    """How strong each station is heard by each other.

    Attributes:
        names: The stations; everything else counts them by index.
        noise_mw: Noise at each, in mW.
        sensitivity_mw: Weakest frame that each detects, in mW; what it detects keeps it from sending.
    """

    names: Sequence[str]
    noise_mw: Sequence[float]
    sensitivity_mw: Sequence[float]

    def powers_mw(self, transmitter: int, now_ns: int) -> list[float]:
        """Return how strong `transmitter` arrives at each station at `now_ns`, 0 at itself.

        A list once returned never changes; the same one says that nothing has.
        """
        ...

    def linked(self, transmitter: int, receiver: int) -> bool:
        """Return whether the two are near enough to be associated; no frame is sent to who is not."""
        ...

    def delay_ns(self, transmitter: int, receiver: int) -> int:
        """Return how long a wave takes."""
        ...

    def rate_control(self, transmitter: int, receiver: int) -> RateControl:
        """Return what chooses modes on a link; called once per link."""
        ...
