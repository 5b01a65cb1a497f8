"""Packets of a video over RTP in captures (RFC 3550, section 5.1). Packets of a frame have the same time stamp."""

from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from fieldkit.measure.captures.arrays import BIG, Integers, Ints, Table
from fieldkit.measure.captures.headers import UDP, ip_header_positions, ip_headers
from fieldkit.measure.captures.packets import UDP_HEADER_BYTES
from fieldkit.measure.captures.pcap import CHUNK_BYTES, frame_reader
from fieldkit.measure.evidence import reading

_RTP_BYTES: Final = 12
_VERSION: Final = 2
NO_PACKET: Final = -1
"""Value of `first_ns` and `last_ns` of a frame without a captured packet."""


@dataclass(frozen=True, eq=False)
class RtpPackets(Table):
    """RTP packets to a port in the order of a capture.

    Attributes:
        stamp: RTP time stamp, which the packets of a frame share.
        sequence: Sequence number, modulo 65536.
        at_ns: Time of capture.
        wire_bytes: Length of the link-layer frame.
    """

    stamp: Ints
    sequence: Ints
    at_ns: Ints
    wire_bytes: Ints

    @property
    def keys(self) -> Ints:
        """An integer for each packet, which is equal only for copies of the same packet."""
        keys: Ints = (self.stamp << 16) | self.sequence
        return keys


@dataclass(frozen=True, eq=False)
class CapturedFrames(Table):
    """Frames of a video in both captures, in the order of sending.

    Attributes:
        sent_ns: Time of the first packet in the sender's capture.
        packets: Number of packets in the sender's capture.
        arrived: Number of these packets that are in the receiver's capture, without copies.
        first_ns: Time of the first packet in the receiver's capture, or `NO_PACKET`.
        last_ns: Time of the last packet in the receiver's capture, or `NO_PACKET`.
    """

    sent_ns: Ints
    packets: Ints
    arrived: Ints
    first_ns: Ints
    last_ns: Ints


def read(path: Path, port: int) -> RtpPackets:
    """Return the RTP packets to a UDP port in a capture.

    Raises:
        EvidenceError: For the same reasons as `pcap.read`.
    """
    data = reading.mapped(path)
    integers = Integers(data).with_order(BIG)
    reader = frame_reader(data)
    parts = [RtpPackets(*(np.empty(0, dtype=np.int64) for _ in range(4)))]
    for chunk in reader(data, where=str(path), chunk_bytes=CHUNK_BYTES) if reader else ():
        ip = ip_headers(integers, chunk.frames, ip_header_positions(integers, chunk.frames))
        frames = chunk.frames.where(ip.frame)
        rtp_at = ip.payload_at + UDP_HEADER_BYTES
        is_captured = rtp_at + _RTP_BYTES <= frames.start + frames.captured_bytes
        # The destination port is at byte 2 of the UDP header (RFC 768).
        is_video = (ip.protocol == UDP) & (ip.fragment_offset == 0) & (integers.u16(ip.payload_at + 2) == port)
        chosen = np.flatnonzero(is_captured & is_video & (integers.u8(rtp_at) >> 6 == _VERSION))
        rtp_at = rtp_at[chosen]
        parts.append(
            RtpPackets(
                stamp=integers.u32(rtp_at + 4),
                sequence=integers.u16(rtp_at + 2),
                at_ns=frames.time_ns[chosen],
                wire_bytes=frames.wire_bytes[chosen],
            )
        )
    return RtpPackets.concatenated(parts)


def match_frames(sent: RtpPackets, received: RtpPackets) -> CapturedFrames:
    """Return the frames of the sender's capture, with their packets in the receiver's capture."""
    # The arrays below have one element per time stamp, sorted by time stamp; the result is in the order of sending.
    stamps, first = np.unique(sent.stamp, return_index=True)
    in_order = np.argsort(first)
    _, distinct = np.unique(sent.keys, return_index=True)
    packets = np.bincount(np.searchsorted(stamps, sent.stamp[distinct]), minlength=len(stamps))
    arrived_keys, first_copy = np.unique(received.keys, return_index=True)
    copies = received.where(first_copy[np.isin(arrived_keys, sent.keys)])
    frame = np.searchsorted(stamps, copies.stamp)
    first_ns, last_ns = np.full(len(stamps), np.iinfo(np.int64).max), np.full(len(stamps), NO_PACKET)
    np.minimum.at(first_ns, frame, copies.at_ns)
    np.maximum.at(last_ns, frame, copies.at_ns)
    first_ns[last_ns == NO_PACKET] = NO_PACKET
    return CapturedFrames(
        sent_ns=sent.at_ns[first],
        packets=packets,
        arrived=np.bincount(frame, minlength=len(stamps)),
        first_ns=first_ns,
        last_ns=last_ns,
    ).where(in_order)
