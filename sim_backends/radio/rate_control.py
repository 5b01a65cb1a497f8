"""Rate control: the mode of a station's next frame, fixed or chosen by what arrived."""

from collections.abc import Sequence
from typing import Final, Protocol

from sim_backends.radio.modes import DIFS_NS, SIFS_NS, Mode, ack_ns
from sim_backends.radio.packet_error import packet_error
from sim_backends.radio.random_streams import PacketDraws, PacketIdentity


class RateControl(Protocol):
    """Chooses the mode of each attempt on one directed link."""

    def choose(self, now_ns: int, packet: PacketIdentity, attempt: int) -> Mode:
        """Return the mode of an attempt that begins at `now_ns`.

        Args:
            now_ns: When it begins.
            packet: At which packet.
            attempt: 1 for the first at it.
        """
        ...

    def tell(self, mode: Mode, *, acknowledged: bool) -> None:
        """Take in what became of an attempt."""
        ...


class FixedRate:
    """Always one mode.

    Args:
        mode: The mode.
    """

    def __init__(self, mode: Mode) -> None:
        self._mode = mode

    def choose(self, now_ns: int, packet: PacketIdentity, attempt: int) -> Mode:  # noqa: ARG002 (see RateControl)
        """See `RateControl.choose`."""
        return self._mode

    def tell(self, mode: Mode, *, acknowledged: bool) -> None:
        """See `RateControl.tell`."""


class Minstrel:
    """Sends in the mode that has carried most lately, and tries another one now and then, as Linux's minstrel does.

    Per mode an exponentially weighted mean of the share of attempts that were acknowledged (75 % old, renewed every
    100 ms; a tenth of the frames try another mode: kernel documentation of mac80211's minstrel). Unlike the kernel's,
    it begins with what the signal-to-noise ratio promises, as drivers do that start from RSSI, and has no chain of
    slower modes for the last attempts at a frame, so it loses more in a fade.

    Args:
        modes: What it may choose, slowest first.
        snr_db: Mean ratio at the receiver.
        draws: What it draws from.
    """

    _RENEW_NS: Final = 100_000_000
    _KEPT: Final = 0.75
    _TRIES: Final = 0.1
    _REFERENCE_BYTES: Final = 1200

    def __init__(self, modes: Sequence[Mode], snr_db: float, draws: PacketDraws) -> None:
        self._modes = tuple(modes)
        self._draws = draws
        self._time_ns = {mode: _exchange_ns(mode, self._REFERENCE_BYTES) for mode in modes}
        self._share = {mode: 1 - packet_error(mode, snr_db, self._REFERENCE_BYTES) for mode in modes}
        self._attempts = dict.fromkeys(modes, 0)
        self._arrived = dict.fromkeys(modes, 0)
        self._renewed_ns = 0
        self._best = self._fastest()

    def choose(self, now_ns: int, packet: PacketIdentity, attempt: int) -> Mode:
        """See `RateControl.choose`."""
        if now_ns - self._renewed_ns >= self._RENEW_NS:
            self._renew(now_ns)
        draw = self._draws.draw(packet, attempt)
        if draw < self._TRIES:
            return self._modes[int(draw / self._TRIES * len(self._modes))]
        return self._best

    def tell(self, mode: Mode, *, acknowledged: bool) -> None:
        """See `RateControl.tell`."""
        self._attempts[mode] += 1
        self._arrived[mode] += acknowledged

    def _renew(self, now_ns: int) -> None:
        for mode, attempts in self._attempts.items():
            if attempts:
                seen = self._arrived[mode] / attempts
                self._share[mode] = self._KEPT * self._share[mode] + (1 - self._KEPT) * seen
                self._attempts[mode] = self._arrived[mode] = 0
        self._renewed_ns = now_ns
        self._best = self._fastest()

    def _fastest(self) -> Mode:
        # Of modes that carry nothing, the slowest is the one to try.
        return max(self._modes, key=lambda mode: (self._share[mode] / self._time_ns[mode], self._time_ns[mode]))


def _exchange_ns(mode: Mode, size_bytes: int) -> int:
    return DIFS_NS + mode.airtime_ns(size_bytes) + SIFS_NS + ack_ns(mode)
