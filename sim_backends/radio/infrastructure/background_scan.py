"""Decides when a station scans and whether it roams, like `bgscan="simple"` of wpa_supplicant.

The model follows bgscan_simple.c and events.c of wpa_supplicant 2.10, and the signal events of mac80211 (mlme.c).
"""

from dataclasses import dataclass
from typing import Final

SIGNAL_HYSTERESIS_DB: Final = 4.0
"""Change of the signal after which mac80211 reports another event: bgscan_simple.c."""

_AVERAGE_WEIGHT: Final = 0.25
_MIN_BEACONS: Final = 4
"""Weight of the last beacon in the average signal, and number of beacons before the first event: ieee80211_i.h."""

_DIFFERENCES_DB: Final = ((-85.0, 1.0), (-80.0, 2.0), (-75.0, 3.0), (-70.0, 4.0))
"""Limits below which the current signal is, in dBm, each with the margin in dB."""
_LARGEST_DIFFERENCE_DB: Final = 5.0


def required_difference_db(current_dbm: float) -> float:
    """Return the margin by which another access point must be stronger than the current one (events.c).

    In wpa_supplicant, estimated throughputs also change this margin; these changes are omitted.
    """
    return next((difference for below, difference in _DIFFERENCES_DB if current_dbm < below), _LARGEST_DIFFERENCE_DB)


@dataclass(slots=True)
class BackgroundScan:
    """The schedule of the scans of one association.

    Attributes:
        threshold_dbm: Signal below which scans have the short interval.
        short_ns: Short interval.
        long_ns: Long interval.
        average_dbm: Average signal of beacons; before the first beacon the signal at the association.
        next_ns: Time of the next scan.
    """

    threshold_dbm: float
    short_ns: int
    long_ns: int
    average_dbm: float
    next_ns: int
    _interval_ns: int
    _last_ns: int
    _beacons: int = 0
    _short_scans: int = 0
    _last_event_dbm: float | None = None

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
        return cls(threshold_dbm, short_ns, long_ns, signal_dbm, now_ns + interval_ns, interval_ns, now_ns)

    def on_beacon(self, now_ns: int, signal_dbm: float) -> None:
        """Update the average; a signal event may change `next_ns`."""
        self._beacons += 1
        if self._beacons == 1:
            self.average_dbm = signal_dbm
        self.average_dbm += _AVERAGE_WEIGHT * (signal_dbm - self.average_dbm)
        if self._beacons < _MIN_BEACONS:
            return
        last_dbm, average_dbm = self._last_event_dbm, self.average_dbm
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
        if self._interval_ns == self.long_ns and self.long_ns != self.short_ns:
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

        After many consecutive scans at the short interval, the schedule switches to the long interval.
        """
        if self._interval_ns == self.short_ns:
            self._short_scans += 1
            if self._short_scans >= self._max_short_scans:
                self._interval_ns = self.long_ns
        elif self._short_scans:
            self._short_scans -= 1
        self._last_ns = now_ns
        self.next_ns = now_ns + self._interval_ns
