"""EDCA: four access categories with their own queue and contention in each station (IEEE 802.11-2020, 10.23.2).

A station that has won the contention may send for the time of a transmission opportunity (TXOP). The parameters are
the defaults of Linux's mac80211: table 9-155 with the TXOP limits of IEEE 802.11-2012 for voice and video. In the
other categories a TXOP has one exchange.
"""

from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import partial
from typing import Final, Generic

from typing_extensions import override

from fieldkit.config.wifi_phy import DscpMapping
from sim_backends.radio.core.links import Payload
from sim_backends.radio.mac.contention import ChannelAccess, Contention
from sim_backends.radio.mac.frames import Frame
from sim_backends.radio.phy.modes import CW_MAX, CW_MIN, SLOT_NS, Band

BEST_EFFORT, BACKGROUND, VIDEO, VOICE = range(4)


@dataclass(frozen=True)
class CategoryParameters:
    """Parameters of an access category.

    Attributes:
        aifsn: Number of slots after SIFS before the backoff.
        cw_min: Smallest contention window.
        cw_max: Largest contention window.
        txop_ns: Limit of a transmission opportunity; 0 for one exchange.
    """

    aifsn: int
    cw_min: int
    cw_max: int
    txop_ns: int


PARAMETERS: Final = (
    CategoryParameters(3, CW_MIN, CW_MAX, 0),
    CategoryParameters(7, CW_MIN, CW_MAX, 0),
    CategoryParameters(2, (CW_MIN + 1) // 2 - 1, CW_MIN, 3_008_000),
    CategoryParameters(2, (CW_MIN + 1) // 4 - 1, (CW_MIN + 1) // 2 - 1, 1_504_000),
)
"""Default parameters by access category."""

_UNLIMITED_NS: Final = 1 << 62
# Access categories, highest priority first.
_PRIORITY: Final = (VOICE, VIDEO, BEST_EFFORT, BACKGROUND)

# Access category by user priority: table 10-1.
_OF_USER_PRIORITY: Final = (
    *(BEST_EFFORT, BACKGROUND, BACKGROUND, BEST_EFFORT),
    *(VIDEO, VIDEO, VOICE, VOICE),
)
# User priorities of DSCPs by RFC 8325, 4.3 (figure 1), and of 1 (LE) by RFC 8622, 11; all others are 0.
_RFC_8325: Final = {
    **dict.fromkeys((46, 44), 6),
    40: 5,
    **dict.fromkeys((32, 34, 36, 38, 24, 26, 28, 30), 4),
    **dict.fromkeys((18, 20, 22), 3),
    8: 1,
    1: 1,
}


def category_of(dscp: int, mapping: DscpMapping) -> int:
    """Return the access category of packets with a DSCP.

    Args:
        dscp: Differentiated services code point, 0 to 63.
        mapping: `linux`: the three upper bits of the DSCP are the user priority (cfg80211 up to Linux 6.7).
            `rfc8325`: the mapping of RFC 8325. It permits two user priorities for network control (CS6, CS7), 7 and
            0; here they are best effort (0).
    """
    return _OF_USER_PRIORITY[dscp >> 3 if mapping == "linux" else _RFC_8325.get(dscp, 0)]


class CategoryContention(Contention):
    """Contention of one access category: a backoff of 0 slots is kept if the channel becomes busy (10.23.2.4)."""

    __slots__ = ("_has_backoff",)

    def __init__(self, draw: Callable[[], float], ifs_ns: int, *, cw_min: int, cw_max: int) -> None:
        super().__init__(draw, ifs_ns, cw_min=cw_min, cw_max=cw_max)
        # True if a backoff was drawn for the next frame, even if none of its slots remain.
        self._has_backoff = False

    def arrive(self, now_ns: int) -> None:
        """Record that a frame arrived at an empty queue; it needs a new backoff if the last one has ended."""
        self._count_down(now_ns)
        if not self.slots:
            self._has_backoff = False

    def require_backoff(self) -> None:
        """Draw a backoff if there is none, because the station itself uses the channel."""
        if not self.slots:
            self._draw_backoff()

    @override
    def on_success(self) -> None:
        self._has_backoff = False
        super().on_success()

    @override
    def on_failure(self) -> None:
        self._has_backoff = False
        super().on_failure()

    @override
    def _draw_backoff(self) -> None:
        if not self._has_backoff:
            super()._draw_backoff()
            self._has_backoff = True


class CategoryQueue(Generic[Payload]):
    """Queue and contention of one access category of a station.

    Args:
        category: The access category.
        band: Band of the station.
        draw: Returns the next random draw for the backoff of the first frame in a queue.
    """

    __slots__ = ("category", "contention", "frames", "parameters")

    def __init__(self, category: int, band: Band, draw: Callable[[deque[Frame[Payload]]], float]) -> None:
        self.category = category
        self.parameters = parameters = PARAMETERS[category]
        self.frames: deque[Frame[Payload]] = deque()
        ifs_ns = band.sifs_ns + parameters.aifsn * SLOT_NS
        self.contention = CategoryContention(
            partial(draw, self.frames), ifs_ns, cw_min=parameters.cw_min, cw_max=parameters.cw_max
        )


class AccessCategories(ChannelAccess, Generic[Payload]):
    """The access categories of one station, with the methods of `ChannelAccess` for all of them together.

    Args:
        mapping: Mapping of DSCPs.
        band: Band of the station.
        draw: Returns the next random draw for the backoff of the first frame in a queue.

    Attributes:
        active: The category of the current or last exchange.
    """

    def __init__(self, mapping: DscpMapping, band: Band, draw: Callable[[deque[Frame[Payload]]], float]) -> None:
        self.mapping: Final = mapping
        self._queues = [CategoryQueue(category, band, draw) for category in range(len(PARAMETERS))]
        self._by_priority = [self._queues[category] for category in _PRIORITY]
        self.active = self._queues[BEST_EFFORT]
        self._sifs_ns = band.sifs_ns
        # End of the transmission opportunity, 0 if it has one exchange; start of the next exchange in it.
        self._txop_end_ns = self._continue_ns = 0

    @property
    def queues(self) -> Iterable[deque[Frame[Payload]]]:
        """The queues of all categories."""
        return [queue.frames for queue in self._queues]

    @property
    @override
    def ifs_ns(self) -> int:
        return 0

    @property
    @override
    def busy_until_ns(self) -> int:
        return self.active.contention.busy_until_ns

    def queue_of(self, frame: Frame[Payload]) -> deque[Frame[Payload]]:
        """Return the queue of a frame."""
        return self._queues[frame.category].frames

    def has_frames(self) -> bool:
        """Return True if any queue has frames."""
        return any(queue.frames for queue in self._queues)

    def arrive(self, now_ns: int, frame: Frame[Payload], *, in_exchange: bool) -> None:
        """Prepare the contention of a frame that arrived at an empty queue, perhaps during the station's exchange."""
        contention = self._queues[frame.category].contention
        contention.arrive(now_ns)
        if in_exchange:
            contention.require_backoff()

    @override
    def earliest_start_ns(self, now_ns: int) -> int:
        return min(queue.contention.earliest_start_ns(now_ns) for queue in self._queues if queue.frames)

    @override
    def on_busy(self, now_ns: int, until_ns: int) -> None:
        for queue in self._queues:
            if queue.frames:
                queue.contention.postpone(now_ns, until_ns)
            else:
                queue.contention.on_busy(now_ns, until_ns)

    @override
    def postpone(self, now_ns: int, until_ns: int) -> int:
        self.on_busy(now_ns, until_ns)
        return self.earliest_start_ns(now_ns)

    @override
    def defer_until(self, until_ns: int) -> None:
        for queue in self._queues:
            queue.contention.defer_until(until_ns + queue.contention.ifs_ns)

    @override
    def end_eifs(self) -> None:
        for queue in self._queues:
            queue.contention.end_eifs()

    def wait_until(self, now_ns: int) -> None:
        """Restart the countdown at the end of the wait for a response, during which the channel was idle."""
        for queue in self._queues:
            queue.contention.defer_until(now_ns)

    @override
    def set_busy_until(self, until_ns: int) -> None:
        for queue in self._queues:
            queue.contention.set_busy_until(until_ns)

    @override
    def on_success(self) -> None:
        self.active.contention.on_success()

    @override
    def on_failure(self) -> None:
        self._txop_end_ns = 0  # a failure ends the transmission opportunity
        self.active.contention.on_failure()

    def select(self, now_ns: int) -> deque[Frame[Payload]]:
        """Return the queue whose first frame starts now; it becomes the active one.

        If several categories can start, the one with the highest priority starts, and the others behave as after a
        collision (10.23.2.4). Categories without frames count their backoff down until now.
        """
        if now_ns == self._continue_ns and self.active.frames and now_ns < self._txop_end_ns:
            return self.active.frames
        winner: CategoryQueue[Payload] | None = None
        for queue in self._by_priority:
            contention = queue.contention
            if not queue.frames:
                contention.on_busy(now_ns, now_ns)
            elif contention.earliest_start_ns(now_ns) <= now_ns:
                if winner is None:
                    winner = queue
                else:
                    contention.on_failure()
        assert winner is not None
        self.active = winner
        self._txop_end_ns = now_ns + winner.parameters.txop_ns if winner.parameters.txop_ns else 0
        return winner.frames

    def remaining_ns(self, now_ns: int) -> int:
        """Return the remaining time of the transmission opportunity; a very long time if it has one exchange."""
        return self._txop_end_ns - now_ns if self._txop_end_ns else _UNLIMITED_NS

    def continue_ns(self, now_ns: int, exchange_ns: int) -> int | None:
        """Return the start time of another exchange in the same transmission opportunity; None if it does not fit."""
        start_ns = now_ns + self._sifs_ns
        if start_ns + exchange_ns > self._txop_end_ns:
            return None
        self._continue_ns = start_ns
        return start_ns
