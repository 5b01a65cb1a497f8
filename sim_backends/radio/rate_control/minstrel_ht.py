"""Minstrel-HT: the rate control of Linux for radios of 802.11n and later whose driver is a SoftMAC.

The algorithm is from `net/mac80211/rc80211_minstrel_ht.c` in Linux 5.14 and later. Modes form groups with equal
width, guard interval and number of streams. Each mode has a smoothed share of acknowledged frames, updated
every 50 ms. A frame has a retry chain, which is the sequence of modes in which it is tried: the two modes with the
highest expected throughput, and a robust one. At most every 20 ms a frame is tried once in another mode before the
second mode of the chain.

The model differs from Linux in four ways. It does not use the rates of 802.11a/b/g. It applies the same rules to
groups of 802.11ax, which Linux does not have. After its chain, a frame is tried in the robust mode up to the retry
limit; Linux gives up a single frame at the end of its chain. The chain always has three modes; for drivers that
permit four, Linux adds the third fastest mode.

`benchmarks.minstrel_vs_kernel` compares the selected modes with those of Linux 6.1.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import cycle
from typing import Final

from sim_backends.radio.core.random_streams import PacketDraws, PacketIdentity
from sim_backends.radio.phy.modes import CW_MAX, CW_MIN, SHORT_RETRY_LIMIT, SLOT_NS, WifiMode
from sim_backends.radio.rate_control.rate_control import RateControl

_UPDATE_NS: Final = 50_000_000
_SAMPLE_NS: Final = 20_000_000
# The durations of modes are compared for aggregates of 16 frames of 1200 bytes.
_REFERENCE_BITS: Final = 8 * 1200
_REFERENCE_FRAMES: Final = 16
_OVERHEAD_NS: Final = 108_000
"""Time of an exchange besides the data, as mac80211 computes it: SIFS with signal extension (16 us), preamble and
header (20 us) and 3 symbols of 6 Mbit/s for an empty frame; the same and 6 symbols for its ACK."""
_SEGMENT_NS: Final = 6_000_000
"""Time into which all tries of one mode must fit: `segment_size` of mac80211."""
_RANKED: Final = 4
"""Number of modes in a ranking: `MAX_THR_RATES` of mac80211."""
_SAMPLES_PER_TYPE: Final = 5
"""Largest number of modes in each list of modes to sample."""
# Shares of acknowledged frames. Below the first, the throughput of a mode counts as 0. Above the second, a higher
# share does not increase the throughput. Below the third, a mode has two tries in the chain.
_UNUSABLE_SHARE, _CAPPED_SHARE, _UNRELIABLE_SHARE = 0.1, 0.9, 0.2
# The robust mode is the fastest mode with a share above the first. Slower modes with a share above the second are not
# sampled.
_ROBUST_SHARE, _RELIABLE_SHARE = 0.75, 0.95
# If fewer than 25 % of more than 30 frames were acknowledged, a mode is replaced before the next update.
_FAILING_FRAMES, _FAILING_SHARE = 30, 0.25
_LENGTH_OLD_WEIGHT: Final = 96 / 128
"""Weight of the old value in the mean length of aggregates."""

# A low-pass filter of the second order with a period of 16 values; rc80211_minstrel_ht.h has its formula.
_DECAY: Final = math.exp(-math.pi * math.sqrt(2) / 16)
_LAST_WEIGHT: Final = 2 * _DECAY * math.cos(math.sqrt(2) * 2 * math.pi / 16)
_SECOND_WEIGHT: Final = -(_DECAY**2)
_NEW_WEIGHT: Final = 1 - _LAST_WEIGHT - _SECOND_WEIGHT
_SMALLEST_SHARE: Final = 1 / 4096
"""Smallest share after a measurement; a share of 0 means that the mode was never measured."""

# Kinds of sampled modes (see `_refill_samples`), and the order in which they are sampled.
_FASTER, _JUMP, _SLOWER = range(3)
_SAMPLE_ORDER: Final = (_FASTER, _JUMP, _FASTER, _JUMP, _FASTER, _SLOWER)


@dataclass(eq=False, slots=True)
class _Statistics:
    """Statistics of one mode.

    Attributes:
        group: Index of its group.
        duration_ns: Duration of the symbols of an aggregate of 16 frames of 1200 bytes, divided by 16.
        frames: Frames sent since the last update.
        acknowledged: Number of these frames that were acknowledged.
        is_measured: True if the mode was used before the last update.
        share: Smoothed share of acknowledged frames. A mode that was not used has at least the highest share of the
            faster modes of its group.
        previous_share: Value of `share` before its last measurement.
    """

    group: int
    duration_ns: int
    frames: int = 0
    acknowledged: int = 0
    is_measured: bool = False
    share: float = 0.0
    previous_share: float = 0.0

    def update(self) -> None:
        """Update the share with the frames since the last update."""
        if not self.frames:
            return
        measured_share = max(self.acknowledged / self.frames, _SMALLEST_SHARE)
        if not self.share:
            self.share = self.previous_share = measured_share
        else:
            smoothed_share = (
                _NEW_WEIGHT * measured_share + _LAST_WEIGHT * self.share + _SECOND_WEIGHT * self.previous_share
            )
            self.previous_share, self.share = self.share, min(max(smoothed_share, _SMALLEST_SHARE), 1.0)
        self.is_measured = True
        self.frames = self.acknowledged = 0


class MinstrelHt(RateControl):
    """Rate control of one link.

    Args:
        groups: Modes of each group, slowest first. The groups are ordered by width, then guard interval (longest
            first), then number of streams.
        draws: Random draws that order the sampled modes.

    Attributes:
        is_probing: True if the most recent new frame is a sample of another mode; drivers do not aggregate it.
    """

    def __init__(self, groups: Sequence[Sequence[WifiMode]], draws: PacketDraws) -> None:
        self._groups = tuple(map(tuple, groups))
        self._draws = draws
        self._statistics = {
            mode: _Statistics(number, _duration_ns(mode))
            for number, group in enumerate(self._groups)
            for mode in group
        }
        self._group_best = [[group[0]] * _RANKED for group in self._groups]  # the ranking of each group
        self._aggregate_frames, self._aggregates, self._mean_length = 0, 0, 1.0
        self._updated_ns = self._sample_from_ns = 0
        self._samples: list[list[WifiMode]] = [[], [], []]
        self._sample_types = cycle(_SAMPLE_ORDER)
        self._last_group = [0, 0, 0]  # group of the last mode of each kind
        self._order_counts = [0] * len(self._groups)  # random orders drawn for each group
        self._orders: list[list[WifiMode]] = [[] for _ in self._groups]  # remaining modes of each random order
        self._best = self._second = self._robust = self._groups[0][0]
        self._fallback: list[WifiMode] = []  # the chain without the best mode
        self._chain = self._default_chain = _fill_chain([self._best])
        self.is_probing = False
        self._update(0)

    def choose(self, now_ns: int, packet: PacketIdentity, attempt: int) -> WifiMode:  # noqa: ARG002 (see RateControl)
        """Implement `RateControl.choose`."""
        if attempt == 1:
            self.is_probing = False
            if now_ns - self._updated_ns > _UPDATE_NS:
                self._update(now_ns)
            self._chain = self._default_chain
            if now_ns >= self._sample_from_ns:
                self._sample_from_ns = now_ns + _SAMPLE_NS
                if samples := self._samples[next(self._sample_types)]:
                    self.is_probing = True
                    self._chain = _fill_chain([samples.pop(0), *self._fallback])
        return self._chain[attempt - 1]

    def report(self, mode: WifiMode, *, acknowledged: int, frames: int = 1) -> None:
        """Implement `RateControl.report`."""
        statistics = self._statistics[mode]
        statistics.frames += frames
        statistics.acknowledged += acknowledged
        self._aggregate_frames += frames
        self._aggregates += 1
        # Replace a mode of the chain that fails by a mode of a lower group.
        is_failing = False
        for rank, chain_mode in enumerate((self._best, self._second)):
            statistics = self._statistics[chain_mode]
            if (
                statistics.frames > _FAILING_FRAMES
                and statistics.acknowledged < _FAILING_SHARE * statistics.frames
                and (lower := self._lower_group(statistics.group)) is not None
            ):
                is_failing = True
                if rank:
                    self._second = self._group_best[lower][1]
                else:
                    self._best = self._group_best[lower][0]
        if is_failing:
            self._build_chain()

    @property
    def stages(self) -> tuple[tuple[WifiMode, int], ...]:
        """The modes of the chain with their numbers of tries, for a frame that is not a sample."""
        return tuple((mode, self._count_tries(mode)) for mode in (self._best, self._second, self._robust))

    def _lower_group(self, group: int) -> int | None:
        """Return the closest earlier group that has at most as many streams as this one; None if there is none."""
        streams = self._groups[group][0].streams
        lower_groups = (number for number in range(group - 1, -1, -1) if self._groups[number][0].streams <= streams)
        return next(lower_groups, None)

    def _rank(self, mode: WifiMode) -> tuple[float, float]:
        """Return the expected throughput of a mode, in frames per ns, and its share."""
        statistics = self._statistics[mode]
        share = statistics.share
        if share < _UNUSABLE_SHARE:
            return 0.0, share
        time_ns = _OVERHEAD_NS / int(self._mean_length) + statistics.duration_ns
        return min(share, _CAPPED_SHARE) / time_ns, share

    def _update(self, now_ns: int) -> None:
        """Update the statistics of all modes, and choose the modes of the chain and the modes to sample."""
        if self._aggregates:
            length = self._aggregate_frames / self._aggregates
            self._mean_length = _LENGTH_OLD_WEIGHT * self._mean_length + (1 - _LENGTH_OLD_WEIGHT) * length
            self._aggregate_frames = self._aggregates = 0
        best = [self._groups[0][0]] * _RANKED
        for number, group in enumerate(self._groups):
            group_best, fastest_share = [group[0]] * _RANKED, 0.0
            for mode in reversed(group):
                statistics = self._statistics[mode]
                statistics.update()
                if statistics.is_measured:
                    fastest_share = max(fastest_share, statistics.share)
                else:
                    statistics.share = max(fastest_share, statistics.share)
                if self._rank(mode)[0]:
                    self._insert(best, mode)
                    self._insert(group_best, mode)
            self._group_best[number] = group_best
        self._best, self._second = best[:2]
        self._robust = self._find_robust()
        self._refill_samples()
        self._updated_ns = self._sample_from_ns = now_ns
        self._build_chain()

    def _insert(self, ranking: list[WifiMode], mode: WifiMode) -> None:
        """Insert a mode into a ranking of fixed length, after modes of equal rank."""
        rank, position = self._rank(mode), len(ranking)
        while position and rank > self._rank(ranking[position - 1]):
            position -= 1
        ranking.insert(position, mode)
        ranking.pop()

    def _find_robust(self) -> WifiMode:
        """Return the third mode of the chain.

        It is the mode with the highest throughput among the modes with more than 75 % success. If no mode has more
        than 75 %, it is the mode with the highest share. Modes that are faster and less reliable than the best mode
        are not considered. If groups with fewer streams than the best mode have usable modes, it is selected from
        these groups.
        """
        best = self._statistics[self._best]
        robust, group_robust = self._groups[0][0], []
        for group in self._groups:
            best_of_group = group[0]
            for mode in group:
                statistics = self._statistics[mode]
                if statistics.duration_ns < best.duration_ns and statistics.share < best.share:
                    continue
                robust, best_of_group = self._more_robust(robust, mode), self._more_robust(best_of_group, mode)
            group_robust.append(best_of_group)
        throughput = 0.0
        for mode in group_robust:
            if mode.streams < self._best.streams and self._rank(mode)[0] > throughput:
                robust, throughput = mode, self._rank(mode)[0]
        return robust

    def _more_robust(self, current: WifiMode, mode: WifiMode) -> WifiMode:
        throughput, share = self._rank(mode)
        current_throughput, current_share = self._rank(current)
        is_better = throughput > current_throughput if share > _ROBUST_SHARE else share > current_share
        return mode if is_better else current

    def _build_chain(self) -> None:
        self._fallback = []
        for mode in (self._second, self._robust):
            self._fallback += [mode] * self._count_tries(mode)
        self._default_chain = _fill_chain([self._best] * self._count_tries(self._best) + self._fallback)

    def _count_tries(self, mode: WifiMode) -> int:
        """Return the number of tries of a mode in the chain: as many as fit into 6 ms with mean backoffs, 2 to 7.

        A mode with a share below 20 % has 2.
        """
        statistics = self._statistics[mode]
        if statistics.share < _UNRELIABLE_SHARE:
            return 2
        exchange_ns = _OVERHEAD_NS + statistics.duration_ns * int(self._mean_length)
        tries, window = 0, CW_MIN
        elapsed_ns = exchange_ns + window * SLOT_NS // 2
        while tries < SHORT_RETRY_LIMIT and (tries < 2 or elapsed_ns < _SEGMENT_NS):
            tries, window = tries + 1, min(2 * window + 1, CW_MAX)
            elapsed_ns += exchange_ns + window * SLOT_NS // 2
        return tries

    def _refill_samples(self) -> None:
        """Fill the lists of modes to sample.

        The first list has the slowest mode of each group that is faster than the best mode. The second has random
        modes that are faster than the chain. The third has random modes that are between the fastest and the slowest
        mode of the chain and are not reliable.
        """
        best_ns, *others_ns = (
            self._statistics[mode].duration_ns for mode in (self._best, self._second, self._robust)
        )
        fastest_ns, slowest_ns = min(best_ns, *others_ns), max(best_ns, *others_ns)
        for kind in (_FASTER, _JUMP, _SLOWER):
            low_ns, high_ns = (fastest_ns, slowest_ns) if kind == _SLOWER else (0, fastest_ns)
            self._samples[kind] = [
                mode for mode in self._samples[kind] if low_ns < self._statistics[mode].duration_ns < high_ns
            ]
        faster, jumps, _ = self._samples
        while len(faster) < _SAMPLES_PER_TYPE and (mode := self._next_faster(best_ns)) is not None:
            faster.append(mode)
        while len(jumps) < _SAMPLES_PER_TYPE and (mode := self._next_jump(fastest_ns, slowest_ns)) is not None:
            jumps.append(mode)

    def _next_faster(self, best_ns: int) -> WifiMode | None:
        for step in range(1, len(self._groups) + 1):
            number = (self._last_group[_FASTER] + step) % len(self._groups)
            modes = [mode for mode in self._groups[number] if self._statistics[mode].duration_ns < best_ns]
            if modes and modes[0] not in self._samples[_FASTER]:
                self._last_group[_FASTER] = number
                return modes[0]
        return None

    def _next_jump(self, fastest_ns: int, slowest_ns: int) -> WifiMode | None:
        """Return a random mode that is faster than the chain; add slower modes drawn before it to their list."""
        jumps, slower = self._samples[_JUMP], self._samples[_SLOWER]
        for step in range(1, len(self._groups) + 1):
            number = (self._last_group[_JUMP] + step) % len(self._groups)
            limit_ns = slowest_ns if len(slower) < _SAMPLES_PER_TYPE else fastest_ns
            mode = self._draw_mode(number, limit_ns)
            if mode is None:
                continue
            statistics = self._statistics[mode]
            if statistics.duration_ns < fastest_ns:
                if mode not in jumps:
                    self._last_group[_JUMP] = number
                    return mode
            elif mode not in slower and statistics.share <= _RELIABLE_SHARE:
                slower.append(mode)
        return None

    def _draw_mode(self, group: int, limit_ns: int) -> WifiMode | None:
        """Return the next mode of a group's random order that is faster than a limit; None if there is none."""
        modes = self._groups[group]
        if self._statistics[modes[-1]].duration_ns >= limit_ns:
            return None
        while True:
            order = self._orders[group]
            if not order:
                count = self._order_counts[group] = self._order_counts[group] + 1
                draws = [self._draws.draw((f"order {group}", count * len(modes) + n)) for n in range(len(modes))]
                order.extend(mode for _, mode in sorted(zip(draws, modes, strict=True), key=lambda pair: pair[0]))
            mode = order.pop()
            if self._statistics[mode].duration_ns < limit_ns:
                return mode


def _duration_ns(mode: WifiMode) -> int:
    symbols = -(-_REFERENCE_FRAMES * _REFERENCE_BITS // mode.bits_per_symbol)
    return symbols * mode.symbol_ns // _REFERENCE_FRAMES


def _fill_chain(modes: list[WifiMode]) -> tuple[WifiMode, ...]:
    """Return the mode of each attempt: the modes of the chain, then its last mode up to the retry limit."""
    return tuple((modes + modes[-1:] * SHORT_RETRY_LIMIT)[:SHORT_RETRY_LIMIT])
