"""A-MSDU: several packets in one frame (IEEE 802.11-2020, 9.3.2.2 and 10.11), here always inside an A-MPDU.

A frame with several packets has one sequence number. All its packets are received, or none. A frame that is sent
again has the same packets.
"""

from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from itertools import groupby
from typing import Final

from typing_extensions import override

from sim_backends.radio.core.links import Payload
from sim_backends.radio.mac.aggregation import (
    AMPDU_LIMITS,
    DELIMITER_BYTES,
    MAX_PPDU_NS,
    QOS_HEADER_BYTES,
    Aggregate,
    AmpduLimits,
    BlockAckSession,
    bytes_in,
)
from sim_backends.radio.mac.frames import Frame
from sim_backends.radio.phy.modes import ACK_BYTES, PhyFormat, WifiMode

SUBFRAME_HEADER_BYTES: Final = 14
"""Destination, source and length before each packet: 9.3.2.2.2."""
_LLC_BYTES: Final = 8
"""LLC and SNAP of each packet: RFC 1042."""
FRAME_OVERHEAD_BYTES: Final = QOS_HEADER_BYTES - _LLC_BYTES
"""MAC header and FCS of a frame."""

_MAX_FRAME_BYTES: Final[dict[PhyFormat, int]] = {"HT": 4_095, "VHT": 11_454, "HE": 11_454}
"""Largest frame in an A-MPDU: table 9-25; in HT, the largest length in the delimiter (10.12.2)."""


def limits_with_amsdu(phy_format: PhyFormat, max_bytes: int) -> AmpduLimits:
    """Return the limits of aggregates whose frames have A-MSDUs up to `max_bytes`."""
    format_bytes = _MAX_FRAME_BYTES[phy_format] - FRAME_OVERHEAD_BYTES
    return replace(AMPDU_LIMITS[phy_format], amsdu_bytes=min(max_bytes, format_bytes))


def amsdu_bytes(packet_sizes_bytes: Iterable[int]) -> int:
    """Return the size of an A-MSDU of packets; each subframe but the last is padded to a multiple of 4 bytes."""
    size_bytes = 0
    for packet_bytes in packet_sizes_bytes:
        size_bytes = -(-size_bytes // 4) * 4 + SUBFRAME_HEADER_BYTES + _LLC_BYTES + packet_bytes
    return size_bytes


def frame_bytes(packets: Sequence[Frame[Payload]]) -> int:
    """Return the size of a frame with these packets; a frame of one packet has no A-MSDU."""
    if len(packets) == 1:
        return packets[0].size_bytes + QOS_HEADER_BYTES
    return FRAME_OVERHEAD_BYTES + amsdu_bytes(packet.size_bytes for packet in packets)


def frames_of(packets: Iterable[Frame[Payload]]) -> Iterator[list[Frame[Payload]]]:
    """Yield the packets of each frame of an aggregate."""
    for _, group in groupby(packets, key=lambda packet: packet.sequence):
        yield list(group)


class AmsduSession(BlockAckSession[Payload]):
    """A Block Ack session whose frames contain A-MSDUs.

    Args:
        limits: Limits of aggregates.
    """

    def __init__(self, limits: AmpduLimits) -> None:
        super().__init__(limits)
        # Packets of decoded frames that wait for earlier frames, by sequence number.
        self._waiting_packets: dict[int, list[Frame[Payload]]] = {}

    @override
    def build_aggregate(
        self,
        queue: deque[Frame[Payload]],
        mode: WifiMode,
        *,
        is_single: bool = False,
        limit_ns: int = MAX_PPDU_NS,
    ) -> Aggregate[Payload]:
        """Return the aggregate of a queue's first frame and later frames to the same receiver.

        A probe of rate control contains a single packet, unless the first frame was already sent with several.
        """
        limit_bytes = min(self._limits.max_bytes, bytes_in(mode, limit_ns))
        packets = [packet for packet in queue if packet.receiver == queue[0].receiver]
        frames: list[list[Frame[Payload]]] = []
        size_bytes = first = 0
        end_sequence = -1
        while first < len(packets):
            before_bytes = -(-size_bytes // 4) * 4 + DELIMITER_BYTES
            frame = self._next_frame(packets, first, limit_bytes - before_bytes, is_single=is_single)
            new_bytes = before_bytes + frame_bytes(frame)
            sequence = self._next_sequence if frame[0].sequence < 0 else frame[0].sequence
            if not frames:
                end_sequence = sequence + self._limits.window
            elif new_bytes > limit_bytes or sequence >= end_sequence:
                break
            if frame[0].sequence < 0:
                self._next_sequence += 1
                for packet in frame:
                    packet.sequence = sequence
            frames.append(frame)
            size_bytes = new_bytes
            first += len(frame)
            if is_single:
                break
        response_bytes = self._limits.block_ack_bytes if len(frames) > 1 else ACK_BYTES
        if len(frames) == 1 and mode.phy_format == "HT":
            size_bytes -= DELIMITER_BYTES
        all_packets = [packet for frame in frames for packet in frame]
        return Aggregate(all_packets, size_bytes, response_bytes, len(frames))

    def _next_frame(
        self, packets: Sequence[Frame[Payload]], first: int, room_bytes: int, *, is_single: bool
    ) -> list[Frame[Payload]]:
        """Return the packets of the frame that starts with a packet: those of its last attempt, or as many as fit.

        A probe that was not sent before has only the first packet.
        """
        sequence = packets[first].sequence
        frame = [packets[first]]
        if is_single and sequence < 0:
            return frame
        size_bytes = amsdu_bytes([packets[first].size_bytes])
        limit_bytes = min(self._limits.amsdu_bytes, room_bytes - FRAME_OVERHEAD_BYTES)
        for index in range(first + 1, len(packets)):
            packet = packets[index]
            if packet.sequence != sequence:
                break
            size_bytes = -(-size_bytes // 4) * 4 + SUBFRAME_HEADER_BYTES + _LLC_BYTES + packet.size_bytes
            if sequence < 0 and size_bytes > limit_bytes:
                break
            frame.append(packet)
        return frame

    @override
    def first_frame_bytes(self, queue: deque[Frame[Payload]]) -> int:
        first = queue[0]
        if first.sequence < 0:
            return super().first_frame_bytes(queue)
        return frame_bytes([packet for packet in queue if packet.sequence == first.sequence])

    @override
    def _pop_in_order(self) -> list[Frame[Payload]]:
        packets: list[Frame[Payload]] = []
        while self._next_passed_up in self._waiting_packets or self._next_passed_up in self._skipped_sequences:
            packets.extend(self._waiting_packets.pop(self._next_passed_up, ()))
            self._skipped_sequences.discard(self._next_passed_up)
            self._next_passed_up += 1
        return packets

    @override
    def receive(self, frames: Iterable[Frame[Payload]]) -> list[Frame[Payload]]:
        for packet in frames:
            if not packet.is_received:
                packet.is_received = True
                self._waiting_packets.setdefault(packet.sequence, []).append(packet)
        return self._pop_in_order()
