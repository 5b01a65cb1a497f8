"""A-MPDU: aggregates of frames to one receiver, acknowledged by a Block Ack (IEEE 802.11-2020, 9.7, 10.12 and 10.25).

The originator (the sending station) sends frames again, alone or with new ones, until they are acknowledged or given
up. The recipient passes them to the layer above in the order of their sequence numbers, so a frame waits for the ones
before it. Two steps of the standard are instantaneous here: the agreement exists from the first frame, and the
recipient immediately skips a frame that the originator has given up (a BlockAckReq reports this in the standard).
Limits of HE are those of IEEE 802.11ax-2021.
"""

from collections import deque
from collections.abc import Iterable, Sequence, Set
from dataclasses import dataclass
from functools import lru_cache
from typing import Final, Generic

from sim_backends.radio.core.links import Payload
from sim_backends.radio.mac.frames import HEADER_BYTES, Frame
from sim_backends.radio.phy.modes import ACK_BYTES, PhyFormat, WifiMode

QOS_HEADER_BYTES: Final = HEADER_BYTES + 2
"""MAC header, LLC, SNAP and FCS of a QoS data frame: 9.2.4.5."""

TYPICAL_FRAMES: Final = 16
"""Number of frames per aggregate for which rate control compares modes. An assumption, between 1 and the window."""

DELIMITER_BYTES: Final = 4
"""Size of the delimiter before each frame of an aggregate."""
MAX_PPDU_NS: Final = 5_484_000
"""Longest airtime of an aggregate (aPPDUMaxTime): tables 19-25, 21-28 and 27-54."""


@dataclass(frozen=True)
class AmpduLimits:
    """Limits of aggregates.

    Attributes:
        window: Maximum number of frames from the oldest unacknowledged one to the newest. It is the number of bits in
            the bitmap of a Block Ack.
        max_bytes: Maximum size of an A-MPDU.
        amsdu_bytes: Maximum size of the A-MSDUs in it; 0 if each frame contains one packet.
    """

    window: int
    max_bytes: int
    amsdu_bytes: int = 0

    @property
    def block_ack_bytes(self) -> int:
        """Size of a compressed Block Ack with its bitmap: 9.3.1.8."""
        return 24 + self.window // 8


AMPDU_LIMITS: Final[dict[PhyFormat, AmpduLimits]] = {
    "HT": AmpduLimits(64, 65_535),
    "VHT": AmpduLimits(64, 1_048_575),
    "HE": AmpduLimits(256, 4_194_303),
}
"""Limits by the exponent of the maximum A-MPDU length: the largest exponent of HT (9.4.2.55.3) and VHT (9.4.2.157.2),
and exponent extension 2 of HE (9.4.2.248.2) at 5 and 6 GHz. At all modelled rates of VHT and HE, `MAX_PPDU_NS` is
reached first, at 2.4 GHz too: extension 3 permits 524,287 bytes there."""


@dataclass(eq=False, slots=True)
class Aggregate(Generic[Payload]):
    """Frames that are sent together.

    Attributes:
        frames: A `Frame` for each packet, in the order of sequence numbers. The packets of an A-MSDU have the same
            sequence number.
        size_bytes: Size of the PSDU.
        response_bytes: Size of the Block Ack, or of the ACK to a single frame.
        frame_count: Number of MPDUs, each with one packet or an A-MSDU.
        decoded_frames: The items of `frames` that the receiver decoded; empty until the aggregate ends.
    """

    frames: Sequence[Frame[Payload]]
    size_bytes: int
    response_bytes: int
    frame_count: int
    decoded_frames: Sequence[Frame[Payload]] = ()


class BlockAckSession(Generic[Payload]):
    """The agreement between an originator and a recipient: sequence numbers and reordering.

    Args:
        limits: Limits of aggregates.
    """

    def __init__(self, limits: AmpduLimits) -> None:
        self._limits = limits
        self._next_sequence = 0
        # At the recipient: the next sequence number that it passes up, the decoded frames after this number, and the
        # sequence numbers after it that the originator has given up.
        self._next_passed_up = 0
        self._frames_waiting: dict[int, Frame[Payload]] = {}
        self._skipped_sequences: set[int] = set()

    @property
    def block_ack_bytes(self) -> int:
        """Size of a Block Ack."""
        return self._limits.block_ack_bytes

    def build_aggregate(
        self,
        queue: deque[Frame[Payload]],
        mode: WifiMode,
        *,
        is_single: bool = False,
        limit_ns: int = MAX_PPDU_NS,
    ) -> Aggregate[Payload]:
        """Return the aggregate of a queue's first frame and later frames to the same receiver.

        Args:
            queue: The queue.
            mode: Mode of the aggregate.
            is_single: True if the aggregate must contain only the first frame.
            limit_ns: Maximum airtime of the aggregate, unless it contains only the first frame.
        """
        limit_bytes = min(self._limits.max_bytes, bytes_in(mode, limit_ns))
        frames: list[Frame[Payload]] = []
        first, size_bytes, end_sequence = queue[0], 0, 0
        for frame in queue:
            if frame.receiver != first.receiver:
                continue
            sequence = self._next_sequence if frame.sequence < 0 else frame.sequence
            # Each subframe but the last is padded to a multiple of 4 bytes.
            new_bytes = -(-size_bytes // 4) * 4 + DELIMITER_BYTES + frame.size_bytes + QOS_HEADER_BYTES
            if not frames:
                end_sequence = sequence + self._limits.window
            elif new_bytes > limit_bytes or sequence >= end_sequence:
                break
            if frame.sequence < 0:
                frame.sequence = sequence
                self._next_sequence += 1
            frames.append(frame)
            size_bytes = new_bytes
            if is_single:
                break
        if len(frames) > 1:
            return Aggregate(frames, size_bytes, self._limits.block_ack_bytes, len(frames))
        # Frames of VHT and HE always have a delimiter: 9.7.1.
        return Aggregate(frames, size_bytes - (DELIMITER_BYTES if mode.phy_format == "HT" else 0), ACK_BYTES, 1)

    def first_frame_bytes(self, queue: deque[Frame[Payload]]) -> int:
        """Return the minimum size of the MPDU that contains a queue's first packet; it may contain more packets."""
        return queue[0].size_bytes + QOS_HEADER_BYTES

    def receive(self, frames: Iterable[Frame[Payload]]) -> list[Frame[Payload]]:
        """Store decoded frames at the recipient; return the frames that it passes up now, without duplicates."""
        for frame in frames:
            if not frame.is_received:
                frame.is_received = True
                self._frames_waiting[frame.sequence] = frame
        return self._pop_in_order()

    def skip(self, frames: Iterable[Frame[Payload]]) -> list[Frame[Payload]]:
        """Give up frames that were not received; return the frames that the recipient passes up now."""
        self._skipped_sequences.update(frame.sequence for frame in frames if frame.sequence >= 0)
        return self._pop_in_order()

    def _pop_in_order(self) -> list[Frame[Payload]]:
        frames = []
        while self._next_passed_up in self._frames_waiting or self._next_passed_up in self._skipped_sequences:
            if (frame := self._frames_waiting.pop(self._next_passed_up, None)) is not None:
                frames.append(frame)
            self._skipped_sequences.discard(self._next_passed_up)
            self._next_passed_up += 1
        return frames


def remove_frames(queue: deque[Frame[Payload]], finished_frames: Set[Frame[Payload]]) -> None:
    """Remove frames from a queue that contains all of them; the order of the others does not change."""
    kept_frames, remaining = [], len(finished_frames)
    while remaining:
        frame = queue.popleft()
        if frame in finished_frames:
            remaining -= 1
        else:
            kept_frames.append(frame)
    queue.extendleft(reversed(kept_frames))


@lru_cache(maxsize=4096)
def bytes_in(mode: WifiMode, time_ns: int) -> int:
    """Return the size of the largest PSDU with at most this airtime."""
    symbols = max(time_ns - mode.preamble_ns - mode.band.signal_extension_ns, 0) // mode.symbol_ns
    size_bytes = symbols * mode.bits_per_symbol // 8
    while size_bytes > 0 and mode.airtime_ns(size_bytes) > time_ns:
        size_bytes -= 1
    return size_bytes
