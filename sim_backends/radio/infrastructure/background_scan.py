"""Decides when a station scans and whether it roams, like `bgscan="simple"` of wpa_supplicant.

The model follows bgscan_simple.c and events.c of wpa_supplicant 2.10, and the signal events of mac80211 (mlme.c).
"""

from dataclasses import dataclass
from itertools import pairwise
from typing import Final

SIGNAL_HYSTERESIS_DB: Final = 4.0
"""Change of the signal after which mac80211 reports another event: bgscan_simple.c."""

_AVERAGE_SHIFT: Final = 4
_WEIGHT_SHIFT: Final = 2
_MIN_BEACONS: Final = 4
"""Fractional bits of the average signal, negative binary logarithm of the weight of the last beacon in it, and number
of beacons before the first event: ieee80211_i.h (`DECLARE_EWMA(beacon_signal, 4, 4)`)."""

_DIFFERENCES_DB: Final = ((-85, 1), (-80, 2), (-75, 3), (-70, 4))
"""Limits below which the current signal is, in dBm, each with the margin in dB: events.c."""
_LARGEST_DIFFERENCE_DB: Final = 5
_THROUGHPUT_RATIOS: Final = ((1.5, 10), (1.2, 5), (1.1, 2), (1.0, 1))
"""Ratios of the larger to the smaller estimated throughput, each with the change of the margin in dB: events.c."""
_THROUGHPUT_MARGIN_KBIT_S: Final = 5000
_GREAT_RATIO_DB: Final = 25
"""Difference of throughputs with which signals do not matter, and signal-to-noise ratio (SNR) above which a station
keeps its access point: events.c, scan.h."""

_G_RATES_KBIT_S: Final = (
    *((1, 1000), (4, 2000), (5, 6000), (6, 9000), (7, 12000), (8, 14000), (9, 16000), (10, 18000), (11, 24000)),
    *((12, 27000), (13, 30000), (14, 33000), (15, 36000), (16, 39000), (17, 42000), (18, 45000), (19, 48000)),
    *((20, 51000),),
)
_FASTEST_G_KBIT_S: Final = 54000
"""SNR below which a rate of 802.11g is limited, in dB, and the limit; the highest rate: scan.c, wpas_get_est_tpt."""
_HT20_RATES_KBIT_S: Final = (
    *((0, 0), (2, 6500), (5, 13000), (9, 19500), (11, 26000), (15, 39000), (18, 52000), (20, 58500), (25, 65000)),
)
"""Rates of 802.11n in 20 MHz at SNRs in dB, between which the rate is interpolated: scan.c."""


def estimated_throughput_kbit_s(ratio_db: int, *, high_throughput: bool = True) -> int:
    """Return the throughput that wpa_supplicant estimates at a signal-to-noise ratio (scan.c).

    Args:
        ratio_db: Signal-to-noise ratio in 20 MHz.
        high_throughput: True for 802.11n, false for 802.11g. Faster standards are estimated as 802.11n.
    """
    g_rate = next((rate for below_db, rate in _G_RATES_KBIT_S if ratio_db < below_db), _FASTEST_G_KBIT_S)
    if not high_throughput or ratio_db < 0:
        return g_rate
    for (low_db, low_rate), (high_db, high_rate) in pairwise(_HT20_RATES_KBIT_S):
        if ratio_db < high_db:
            return max(g_rate, low_rate + (ratio_db - low_db) * (high_rate - low_rate) // (high_db - low_db))
    return _HT20_RATES_KBIT_S[-1][1]


def prefers_other(current_dbm: int, other_dbm: int, noise_dbm: int, *, high_throughput: bool = True) -> bool:
    """Return True if wpa_supplicant moves to another access point of the network (events.c).

    Args:
        current_dbm: Average signal of the current access point.
        other_dbm: Signal of the strongest other one.
        noise_dbm: Noise at the station.
        high_throughput: True for 802.11n or later.
    """
    current, other = (
        estimated_throughput_kbit_s(level_dbm - noise_dbm, high_throughput=high_throughput)
        for level_dbm in (current_dbm, other_dbm)
    )
    if other > current + _THROUGHPUT_MARGIN_KBIT_S:
        return True
    if (current_dbm > other_dbm and other < current * 1.2) or current > other + _THROUGHPUT_MARGIN_KBIT_S:
        return False
    if current_dbm - noise_dbm > _GREAT_RATIO_DB:
        return False
    margin_db = next((margin for below, margin in _DIFFERENCES_DB if current_dbm < below), _LARGEST_DIFFERENCE_DB)
    slower, faster = sorted((current, other))
    change_db = next((change for ratio, change in _THROUGHPUT_RATIOS if faster > slower * ratio), 0)
    return other_dbm - current_dbm >= margin_db + (change_db if current > other else -change_db)


@dataclass(slots=True)
class BackgroundScan:
    """The schedule of the scans of one association.

    Attributes:
        threshold_dbm: Signal below which scans have the short interval.
        short_ns: Short interval.
        long_ns: Long interval.
        level_dbm: Average signal of beacons; before the first beacon the signal at the association.
        next_ns: Time of the next scan.
    """

    threshold_dbm: float
    short_ns: int
    long_ns: int
    level_dbm: int
    next_ns: int
    _interval_ns: int
    _last_ns: int
    _beacons: int = 0
    _average: int = 0
    _short_scans: int = 0
    _last_event_dbm: int | None = None

    @classmethod
    def start(
        cls, now_ns: int, signal_dbm: float, *, threshold_dbm: float, short_ns: int, long_ns: int
    ) -> "BackgroundScan":
        """Return the schedule after an association.

        Args:
            now_ns: Time of the association.
            signal_dbm: Signal of the access point at that time.
            threshold_dbm: Signal below which scans have the short interval.
            short_ns: Short interval.
            long_ns: Long interval.
        """
        interval_ns = long_ns if signal_dbm >= threshold_dbm else short_ns
        return cls(threshold_dbm, short_ns, long_ns, round(signal_dbm), now_ns + interval_ns, interval_ns, now_ns)

    def on_beacon(self, now_ns: int, signal_dbm: float) -> None:
        """Update the average; a signal event may change `next_ns`."""
        self._beacons += 1
        # mac80211 averages the negative signal, and rounds down.
        last = -round(signal_dbm) << _AVERAGE_SHIFT
        others = (self._average << _WEIGHT_SHIFT) - self._average
        self._average = (others + last) >> _WEIGHT_SHIFT if self._average else last
        self.level_dbm = average_dbm = -(self._average >> _AVERAGE_SHIFT)
        if self._beacons < _MIN_BEACONS or self.short_ns == self.long_ns:
            return
        last_dbm = self._last_event_dbm
        if average_dbm < self.threshold_dbm and (last_dbm is None or average_dbm < last_dbm - SIGNAL_HYSTERESIS_DB):
            self._last_event_dbm = average_dbm
            self._on_weak_signal(now_ns)
        elif average_dbm > self.threshold_dbm and (last_dbm is None or average_dbm > last_dbm + SIGNAL_HYSTERESIS_DB):
            self._last_event_dbm = average_dbm
            if self._interval_ns == self.short_ns:
                self._interval_ns = self.long_ns
                self.next_ns = now_ns + self.long_ns

    def _on_weak_signal(self, now_ns: int) -> None:
        """Use the short interval, and scan immediately unless scans were recent or many (bgscan_simple.c).

        A scan is recent for 1 s if the long interval was in use, otherwise for 10 s.
        """
        if self._interval_ns == self.long_ns:
            self._interval_ns = self.short_ns
            may_scan = now_ns > self._last_ns + 1_000_000_000 and self._short_scans <= self._max_short_scans
            self.next_ns = now_ns if may_scan else now_ns + self.short_ns
        elif now_ns > self._last_ns + 10_000_000_000:
            self.next_ns = now_ns

    @property
    def _max_short_scans(self) -> int:
        return self.long_ns // self.short_ns + 1

    def on_scan(self, now_ns: int) -> None:
        """Record that a scan starts.

        Scans at the short interval are counted, and each scan at the long interval reduces the count by 1. When the
        count reaches its limit, the schedule switches to the long interval.
        """
        if self._interval_ns == self.short_ns:
            self._short_scans += 1
            if self._short_scans >= self._max_short_scans:
                self._interval_ns = self.long_ns
        elif self._short_scans:
            self._short_scans -= 1
        self._last_ns = now_ns

    def on_scan_end(self, now_ns: int) -> None:
        """Start the interval until the next scan."""
        self.next_ns = now_ns + self._interval_ns
