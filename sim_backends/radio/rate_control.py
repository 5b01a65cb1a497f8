"""Rate control: the mode of a station's next frame, fixed or adapted to acknowledgements."""

from typing import Protocol

from sim_backends.radio.modes import WifiMode
from sim_backends.radio.random_streams import PacketIdentity


class RateControl(Protocol):
    """Selects the mode of each attempt on one directed link."""

    def choose(self, now_ns: int, packet: PacketIdentity, attempt: int) -> WifiMode:
        """Return the mode of an attempt that starts at `now_ns`.

        Args:
            now_ns: Start time.
            packet: Identity of the packet.
            attempt: Number of the attempt for this packet, from 1.
        """
        ...

    def report(self, mode: WifiMode, *, acknowledged: bool) -> None:
        """Record the result of an attempt."""
        ...


class FixedRate:
    """Always uses one mode.

    Args:
        mode: The mode.
    """

    def __init__(self, mode: WifiMode) -> None:
        self._mode = mode

    def choose(self, now_ns: int, packet: PacketIdentity, attempt: int) -> WifiMode:  # noqa: ARG002 (see RateControl)
        """Implement `RateControl.choose`."""
        return self._mode

    def report(self, mode: WifiMode, *, acknowledged: bool) -> None:
        """Implement `RateControl.report`."""
