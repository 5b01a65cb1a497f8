"""The interface of rate control, which selects the mode of the next frame; and a fixed mode."""

from typing import Protocol

from sim_backends.radio.core.random_streams import PacketIdentity
from sim_backends.radio.phy.modes import WifiMode


class RateControl(Protocol):
    """Selects the mode of each attempt on one directed link.

    Attributes:
        is_probing: True if the most recent new frame must not be aggregated, because it is a sample of another mode.
            Always False for a rate control that aggregates samples.
    """

    is_probing: bool = False

    def choose(self, now_ns: int, packet: PacketIdentity, attempt: int) -> WifiMode:
        """Return the mode of an attempt that starts at `now_ns`.

        Args:
            now_ns: Start time.
            packet: Identity of the packet.
            attempt: Number of the attempt for this packet, from 1.
        """
        ...

    def report(self, mode: WifiMode, *, acknowledged: int, frames: int = 1) -> None:
        """Record the result of an attempt.

        Args:
            mode: Mode of the attempt.
            acknowledged: Number of its frames that were acknowledged.
            frames: Number of its frames, above 1 for an aggregate.
        """
        ...


class FixedRate(RateControl):
    """Rate control that always selects the same mode.

    Args:
        mode: The mode.
    """

    def __init__(self, mode: WifiMode) -> None:
        self._mode = mode

    def choose(self, now_ns: int, packet: PacketIdentity, attempt: int) -> WifiMode:  # noqa: ARG002 (see RateControl)
        """Implement `RateControl.choose`."""
        return self._mode

    def report(self, mode: WifiMode, *, acknowledged: int, frames: int = 1) -> None:
        """Implement `RateControl.report`."""
