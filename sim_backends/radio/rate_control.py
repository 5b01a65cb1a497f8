"""Rate control: the mode of a station's next frame, fixed or chosen by what arrived."""

from typing import Protocol

from sim_backends.radio.modes import WifiMode
from sim_backends.radio.random_streams import PacketIdentity


class RateControl(Protocol):
    """Chooses the mode of each attempt on one directed link."""

    def choose(self, now_ns: int, packet: PacketIdentity, attempt: int) -> WifiMode:
        """Return the mode of an attempt that begins at `now_ns`.

        Args:
            now_ns: When it begins.
            packet: At which packet.
            attempt: 1 for the first at it.
        """
        ...

    def tell(self, mode: WifiMode, *, acknowledged: bool) -> None:
        """Take in what became of an attempt."""
        ...


class FixedRate:
    """Always one mode.

    Args:
        mode: The mode.
    """

    def __init__(self, mode: WifiMode) -> None:
        self._mode = mode

    def choose(self, now_ns: int, packet: PacketIdentity, attempt: int) -> WifiMode:  # noqa: ARG002 (see RateControl)
        """See `RateControl.choose`."""
        return self._mode

    def tell(self, mode: WifiMode, *, acknowledged: bool) -> None:
        """See `RateControl.tell`."""
