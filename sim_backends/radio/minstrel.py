"""Choice of the mode by what was acknowledged, as Linux's minstrel does it."""

from collections.abc import Sequence
from typing import Final

from sim_backends.radio.modes import CW_MIN, DIFS_NS, SHORT_RETRY_LIMIT, SIFS_NS, SLOT_NS, WifiMode, ack_ns
from sim_backends.radio.packet_error import packet_error
from sim_backends.radio.random_streams import PacketDraws, PacketIdentity

_RENEW_NS: Final = 100_000_000
_KEPT: Final = 0.75
_TRIED: Final = 0.1
_REFERENCE_BYTES: Final = 1200
_STAGE_NS: Final = 6_000_000
_HOPELESS, _SURE = 0.1, 0.95
_SAMPLES: Final = 4
_STALE: Final = 20


class Minstrel:
    """Sends in the mode that has carried most lately, falls back to others, and tries one now and then.

    Per mode an exponentially weighted mean of the share of attempts that were acknowledged: 75 % old, renewed every
    100 ms. A frame is sent in the mode with the highest throughput, if that fails in the second, then in the most
    robust (the fastest that arrives in 95 % of attempts), at last in the slowest; each as often as fits into 6 ms, at
    most twice where it nearly always or hardly ever arrives, and all no more often than the standard lets a frame be
    sent. A tenth of the frames look around: a mode that is faster than the best, or was not used for 20 renewals,
    goes before the best, four times per renewal where it nearly always or hardly ever arrives; if there is none, a
    slower mode takes the place of the second best, where it costs nothing while the best arrives. All this is as in
    Linux's rc80211_minstrel.c (kernels 2.6.28 to 5.11) and in the documentation of mac80211's minstrel.

    Three things differ. It begins with what the signal-to-noise ratio promises, as drivers do that start from RSSI.
    Which frames look around, and at what, is drawn by frame, not counted, so that one frame more shifts no other's.
    And 802.11n's modes are chosen in the same way, for which Linux has minstrel_ht.

    Args:
        modes: What it may choose, two or more, slowest first.
        snr_db: Mean ratio at the receiver.
        draws: What it draws from.
    """

    def __init__(self, modes: Sequence[WifiMode], snr_db: float, draws: PacketDraws) -> None:
        self._modes = tuple(modes)
        self._draws = draws
        self._time_ns = {mode: _exchange_ns(mode) for mode in modes}
        self._fitting = {mode: _attempts_that_fit(time_ns) for mode, time_ns in self._time_ns.items()}
        self._share = {mode: 1 - packet_error(mode, snr_db, _REFERENCE_BYTES) for mode in modes}
        self._attempts = dict.fromkeys(modes, 0)
        self._arrived = dict.fromkeys(modes, 0)
        self._unused = dict.fromkeys(modes, 0)
        self._samples_left = dict.fromkeys(modes, _SAMPLES)
        self._renewed_ns = 0
        self._rank()
        self._chain = self._usual

    def choose(self, now_ns: int, packet: PacketIdentity, attempt: int) -> WifiMode:
        """See `RateControl.choose`."""
        if now_ns - self._renewed_ns >= _RENEW_NS:
            self._renew(now_ns)
        if attempt == 1:
            draw = self._draws.draw(packet)
            self._chain = self._looking_around(draw / _TRIED) if draw < _TRIED else self._usual
        return self._chain[attempt - 1]

    def tell(self, mode: WifiMode, *, acknowledged: bool) -> None:
        """See `RateControl.tell`."""
        self._attempts[mode] += 1
        self._arrived[mode] += acknowledged

    def _renew(self, now_ns: int) -> None:
        for mode, attempts in self._attempts.items():
            self._unused[mode] = 0 if attempts else self._unused[mode] + 1
            if attempts:
                seen = self._arrived[mode] / attempts
                self._share[mode] = _KEPT * self._share[mode] + (1 - _KEPT) * seen
                self._attempts[mode] = self._arrived[mode] = 0
            self._samples_left[mode] = _SAMPLES
        self._renewed_ns = now_ns
        self._rank()

    def _rank(self) -> None:
        carried = {mode: share / self._time_ns[mode] for mode, share in self._share.items()}
        # Of modes that carry nothing, the slowest is the one to try.
        ranked = sorted(
            self._modes,
            key=lambda mode: (carried[mode] if self._share[mode] >= _HOPELESS else 0, self._time_ns[mode]),
            reverse=True,
        )
        self._best, self._second = ranked[:2]
        sure = [mode for mode in self._modes if self._share[mode] >= _SURE]
        self._robust = max(sure, key=carried.__getitem__) if sure else max(self._modes, key=self._share.__getitem__)
        self._usual = self._chain_of(self._best, self._second)

    def _looking_around(self, where: float) -> tuple[WifiMode, ...]:
        """Return the modes of a frame that looks around, by a draw on [0, 1)."""
        direct = [mode for mode in self._modes if self._is_to_be_tried(mode)]
        if not direct:
            others = [mode for mode in self._modes if mode is not self._best]
            return self._chain_of(self._best, others[int(where * len(others))])
        mode = direct[int(where * len(direct))]
        self._samples_left[mode] -= 1
        return self._chain_of(mode, self._best)

    def _is_to_be_tried(self, mode: WifiMode) -> bool:
        if mode is self._best or not (self._samples_left[mode] > 0 or self._is_open(mode)):
            return False
        return self._time_ns[mode] < self._time_ns[self._best] or self._unused[mode] >= _STALE

    def _is_open(self, mode: WifiMode) -> bool:
        """Return whether more attempts would tell more of a mode."""
        return _HOPELESS <= self._share[mode] <= _SURE

    def _chain_of(self, first: WifiMode, second: WifiMode) -> tuple[WifiMode, ...]:
        """Return the mode of each attempt at a frame that begins with these two."""
        chain: list[WifiMode] = []
        for mode in (first, second, self._robust):
            fitting = self._fitting[mode]
            chain += [mode] * (fitting if self._is_open(mode) else min(2, fitting // 2))
        chain += [self._modes[0]] * SHORT_RETRY_LIMIT
        return tuple(chain[:SHORT_RETRY_LIMIT])


def _attempts_that_fit(time_ns: int) -> int:
    """Return how many failed attempts, with mean backoffs between, take no more than 6 ms."""
    attempts, window, passed_ns = 1, CW_MIN, 2 * time_ns + CW_MIN * SLOT_NS // 2
    while passed_ns <= _STAGE_NS:
        attempts, window = attempts + 1, 2 * window + 1
        passed_ns += time_ns + window * SLOT_NS // 2
    return attempts


def _exchange_ns(mode: WifiMode) -> int:
    return DIFS_NS + mode.airtime_ns(_REFERENCE_BYTES) + SIFS_NS + ack_ns(mode)
