"""Minstrel: rate control that adapts to acknowledgements, like Linux's minstrel."""

from collections.abc import Sequence
from typing import Final

from sim_backends.radio.core.random_streams import PacketDraws, PacketIdentity
from sim_backends.radio.phy.error_rates import packet_error
from sim_backends.radio.phy.modes import CW_MIN, SHORT_RETRY_LIMIT, SLOT_NS, WifiMode, ack_ns
from sim_backends.radio.phy.transmissions import decibel
from sim_backends.radio.rate_control.rate_control import RateControl

# Constants of `Minstrel`; its docstring describes them.
_UPDATE_NS: Final = 100_000_000
_OLD_WEIGHT: Final = 0.75
_SAMPLE_SHARE: Final = 0.1
_REFERENCE_BYTES: Final = 1200
_SEGMENT_NS: Final = 6_000_000
"""Time into which all attempts in one mode must fit: `segment_size` of mac80211."""
_LOW_SHARE, _HIGH_SHARE = 0.1, 0.95
_SAMPLES: Final = 4
_STALE_UPDATES: Final = 20
# If frames are aggregated, a failing mode ends the update interval early, as in Linux's minstrel_ht.
_FAILING_ATTEMPTS, _FAILING_SHARE = 30, 0.2


class Minstrel(RateControl):
    """Sends in the mode with the highest throughput, falls back to others, and samples other modes occasionally.

    Each mode has an exponentially weighted mean of the share of acknowledged attempts: weight 75 % for the old value,
    updated every 100 ms. A frame is sent first in the mode with the highest throughput, then in the second best mode,
    then in the most robust mode, and finally in the slowest mode. The most robust mode has the highest throughput
    among the modes with at least 95 % success, or without such modes the highest share. Each mode is tried as often
    as fits into 6 ms, but only half as often and at most twice if its success share is above 95 % or below 10 %. All
    attempts together do not exceed the retry limit of the standard.

    A tenth of the frames are samples. A sample is tried in another mode before the best mode. This mode is faster
    than the best mode, or was not used for 20 updates. If its share is above 95 % or below 10 %, it is sampled at
    most four times per update. If no mode meets these conditions, a random other mode replaces the second best mode,
    and is used only if the best mode fails. This follows Linux's rc80211_minstrel.c (kernels 2.6.28 to 5.11) and the
    documentation of mac80211's minstrel.

    The model differs in three ways. The initial shares are computed from the signal-to-noise ratio, as in drivers
    that start from RSSI. A random draw per frame, and not a counter, selects sampling frames and their modes, so that
    an additional frame does not change the results of others. The same algorithm selects modes of 802.11n and later.
    Linux has minstrel_ht for them, which measures the mean length of aggregates; here the length is an argument.

    Args:
        modes: The available modes, two or more, slowest first.
        snr_db: Mean signal-to-noise ratio at the receiver, with the noise of 20 MHz.
        draws: Random draws for sampling.
        frames_per_exchange: Number of frames that share one preamble, one response and the interframe spaces.
    """

    def __init__(
        self, modes: Sequence[WifiMode], snr_db: float, draws: PacketDraws, *, frames_per_exchange: int = 1
    ) -> None:
        self._modes = tuple(modes)
        self._draws = draws
        self._time_ns = {mode: _time_per_frame_ns(mode, frames_per_exchange) for mode in modes}
        self._frames_per_exchange = frames_per_exchange
        self._max_attempts = {
            mode: _count_fitting_attempts(frames_per_exchange * time_ns) for mode, time_ns in self._time_ns.items()
        }
        self._share = {
            mode: 1 - packet_error(mode, snr_db - decibel(mode.noise_factor), _REFERENCE_BYTES) for mode in modes
        }
        self._attempts = dict.fromkeys(modes, 0)
        self._acknowledged = dict.fromkeys(modes, 0)
        self._unused_updates = dict.fromkeys(modes, 0)
        self._remaining_samples = dict.fromkeys(modes, _SAMPLES)
        self._updated_ns = 0
        self._rank()
        self._rate_chain = self._default_chain

    def choose(self, now_ns: int, packet: PacketIdentity, attempt: int) -> WifiMode:
        """Implement `RateControl.choose`."""
        if now_ns - self._updated_ns >= _UPDATE_NS:
            self._update(now_ns)
        if attempt == 1:
            draw = self._draws.draw(packet)
            self._rate_chain = (
                self._sampling_chain(draw / _SAMPLE_SHARE) if draw < _SAMPLE_SHARE else self._default_chain
            )
        return self._rate_chain[attempt - 1]

    def report(self, mode: WifiMode, *, acknowledged: int, frames: int = 1) -> None:
        """Implement `RateControl.report`."""
        self._attempts[mode] += frames
        self._acknowledged[mode] += acknowledged
        if self._frames_per_exchange > 1 and self._is_failing(mode):
            self._updated_ns = -_UPDATE_NS

    def _is_failing(self, mode: WifiMode) -> bool:
        attempts = self._attempts[mode]
        return attempts > _FAILING_ATTEMPTS and self._acknowledged[mode] < _FAILING_SHARE * attempts

    def _update(self, now_ns: int) -> None:
        for mode, attempts in self._attempts.items():
            self._unused_updates[mode] = 0 if attempts else self._unused_updates[mode] + 1
            if attempts:
                measured_share = self._acknowledged[mode] / attempts
                self._share[mode] = _OLD_WEIGHT * self._share[mode] + (1 - _OLD_WEIGHT) * measured_share
                self._attempts[mode] = self._acknowledged[mode] = 0
            self._remaining_samples[mode] = _SAMPLES
        self._updated_ns = now_ns
        self._rank()

    def _rank(self) -> None:
        """Choose the best, the second best and the most robust mode, and build the default chain."""
        throughput = {mode: share / self._time_ns[mode] for mode, share in self._share.items()}
        # Among modes with almost no success, the slowest is tried first.
        ranked_modes = sorted(
            self._modes,
            key=lambda mode: (throughput[mode] if self._share[mode] >= _LOW_SHARE else 0, self._time_ns[mode]),
            reverse=True,
        )
        self._best, self._second = ranked_modes[:2]
        reliable = [mode for mode in self._modes if self._share[mode] >= _HIGH_SHARE]
        self._robust = (
            max(reliable, key=throughput.__getitem__) if reliable else max(self._modes, key=self._share.__getitem__)
        )
        self._default_chain = self._build_chain(self._best, self._second)

    def _sampling_chain(self, draw: float) -> tuple[WifiMode, ...]:
        """Return the modes of a sampling frame, selected by a draw on [0, 1)."""
        candidates = [mode for mode in self._modes if self._is_sample_candidate(mode)]
        if not candidates:
            others = [mode for mode in self._modes if mode is not self._best]
            return self._build_chain(self._best, others[int(draw * len(others))])
        mode = candidates[int(draw * len(candidates))]
        self._remaining_samples[mode] -= 1
        return self._build_chain(mode, self._best)

    def _is_sample_candidate(self, mode: WifiMode) -> bool:
        if mode is self._best or not (self._remaining_samples[mode] > 0 or self._is_uncertain(mode)):
            return False
        return self._time_ns[mode] < self._time_ns[self._best] or self._unused_updates[mode] >= _STALE_UPDATES

    def _is_uncertain(self, mode: WifiMode) -> bool:
        """Return True if more attempts would improve the estimate of a mode's success share."""
        return _LOW_SHARE <= self._share[mode] <= _HIGH_SHARE

    def _build_chain(self, first: WifiMode, second: WifiMode) -> tuple[WifiMode, ...]:
        """Return the mode of each attempt for a frame that starts with these two modes."""
        chain: list[WifiMode] = []
        for mode in (first, second, self._robust):
            max_attempts = self._max_attempts[mode]
            chain += [mode] * (max_attempts if self._is_uncertain(mode) else min(2, max_attempts // 2))
        chain += [self._modes[0]] * SHORT_RETRY_LIMIT
        return tuple(chain[:SHORT_RETRY_LIMIT])


def _count_fitting_attempts(time_ns: int) -> int:
    """Return the number of failed attempts, at least 1, that with mean backoffs in between take at most 6 ms."""
    attempts, window, elapsed_ns = 1, CW_MIN, 2 * time_ns + CW_MIN * SLOT_NS // 2
    while elapsed_ns <= _SEGMENT_NS:
        attempts, window = attempts + 1, 2 * window + 1
        elapsed_ns += time_ns + window * SLOT_NS // 2
    return attempts


def _time_per_frame_ns(mode: WifiMode, frames: int) -> int:
    exchange_ns, bits = _exchange_ns(mode), 8 * _REFERENCE_BYTES * 1_000_000_000
    return (exchange_ns + (frames - 1) * bits // mode.rate_bit_s) // frames


def _exchange_ns(mode: WifiMode) -> int:
    band = mode.band
    return band.difs_ns + mode.airtime_ns(_REFERENCE_BYTES) + band.sifs_ns + ack_ns(mode)
