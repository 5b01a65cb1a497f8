"""Frames of IEEE 802.11 with radiotap headers as columns: rate, signal and retransmissions.

Sources: https://www.radiotap.org; IEEE 802.11-2020, 9.2 (MAC header), 19.5 and 21.5 (rates of HT and VHT).
mac80211 adds the field `TX flags` only to frames that its radio has sent. These frames have no signal.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np

from fieldkit.core.errors import EvidenceError
from fieldkit.measure.captures import pcap
from fieldkit.measure.captures.arrays import LITTLE, Frames, Integers, Ints, Mask, Table
from fieldkit.measure.evidence import reading

LINK_TYPE: Final = 127
"""Link type of frames with radiotap headers."""

UNKNOWN: Final = -1
"""Value of a column of integers if the frame does not state it. A signal is `NO_SIGNAL` instead."""

NO_SIGNAL: Final = 0
"""Signal of a frame without this field. Received signals are negative."""

_HEADER_BYTES: Final = 8
_FLAGS, _RATE, _SIGNAL, _TX_FLAGS, _RETRIES, _MCS, _VHT = 1, 2, 5, 15, 17, 19, 21
_ALIGN_AND_BYTES: Final = (
    (8, 8),  # TSFT
    (1, 1),  # flags
    (1, 1),  # rate
    (2, 4),  # channel
    (2, 2),  # FHSS
    (1, 1),  # antenna signal, dBm
    (1, 1),  # antenna noise, dBm
    (2, 2),  # lock quality
    (2, 2),  # TX attenuation
    (2, 2),  # TX attenuation, dB
    (1, 1),  # TX power, dBm
    (1, 1),  # antenna
    (1, 1),  # antenna signal, dB
    (1, 1),  # antenna noise, dB
    (2, 2),  # RX flags
    (2, 2),  # TX flags
    (1, 1),  # RTS retries
    (1, 1),  # data retries
    (4, 8),  # XChannel
    (1, 3),  # MCS
    (4, 8),  # A-MPDU status
    (2, 12),  # VHT
)
"""Alignment and size of each field, by its bit in the first word of presence bits."""
_WRONG_FCS: Final = 0x40
_TX_FAILED: Final = 0x0001
_RATE_UNIT_BIT_S: Final = 500_000
_MCS_KNOWN: Final = 0x07
"""Bits of the field MCS that show that bandwidth, MCS and guard interval are known."""
_BITS_PER_SUBCARRIER: Final = np.array((0.5, 1, 1.5, 2, 3, 4, 4.5, 5, 6, 20 / 3))
"""Data bits per subcarrier and symbol of each MCS of VHT; the first 8 are those of HT."""
_HT_SUBCARRIERS: Final = np.array((52, 108, 52, 52))
"""Data subcarriers by the bandwidth in the field MCS: 20 MHz, 40 MHz, and 20 MHz in the lower or upper half."""
_VHT_SUBCARRIERS: Final = {0: 52, 1: 108, 4: 234, 11: 468}
"""Data subcarriers by the bandwidth in the field VHT; the other values are parts of wider channels."""
_SYMBOL_S: Final = 4.0e-6
_SHORT_SYMBOL_S: Final = 3.6e-6

RETRY: Final = 0x08
"""Flag of a retransmission in `RadioFrames.flags`."""
_DATA_TYPE: Final = 0x08
_TYPE_BITS: Final = 0x0C
_QOS_BIT: Final = 0x80
_NULL_BIT: Final = 0x40
_FOUR_ADDRESSES: Final = 0x03
_AMSDU_BIT: Final = 0x80


@dataclass(frozen=True, eq=False)
class RadioFrames(Table):
    """Frames of a radio.

    Attributes:
        time_ns: Time of capture, nanoseconds since 1970 UTC.
        is_sent: True if this radio has sent the frame, False if it has received it.
        kind: First byte of the frame: version, type and subtype.
        flags: Second byte of the frame.
        receiver: Address 1 as a number of 48 bits.
        transmitter: Address 2 as a number of 48 bits; `UNKNOWN` if the frame is too short to have it.
        sequence: Sequence number and fragment number; `UNKNOWN` if the frame is too short to have them.
        signal_dbm: Received signal, or `NO_SIGNAL`.
        rate_bit_s: PHY rate; of a sent frame the rate of its first attempt. 0 if it is unknown, for example for
            802.11ax.
        retries: Retransmissions of a sent frame; `UNKNOWN` for a received frame.
        is_failed: True for a sent frame without an acknowledgement.
        has_many_packets: True for an A-MSDU, which contains several packets.
    """

    time_ns: Ints
    is_sent: Mask
    kind: Ints
    flags: Ints
    receiver: Ints
    transmitter: Ints
    sequence: Ints
    signal_dbm: Ints
    rate_bit_s: Ints
    retries: Ints
    is_failed: Mask
    has_many_packets: Mask

    @property
    def is_unicast(self) -> Mask:
        """True for a frame with a single receiver."""
        mask: Mask = (self.receiver >> 40) & 1 == 0
        return mask

    @property
    def is_data(self) -> Mask:
        """True for a data frame that contains a packet."""
        mask: Mask = self.kind & (_TYPE_BITS | _NULL_BIT) == _DATA_TYPE
        return mask

    @property
    def is_retry(self) -> Mask:
        """True for a frame with the retry flag."""
        mask: Mask = self.flags & RETRY != 0
        return mask


class RadioCapture(NamedTuple):
    """Content of a capture on a monitor interface.

    Attributes:
        frames: Frames with a correct FCS.
        damage: Position and kind of the damage after the frames; None if the file is undamaged.
    """

    frames: RadioFrames
    damage: str | None


def read(path: Path) -> RadioCapture:
    """Return the frames of a capture file with radiotap headers.

    Raises:
        EvidenceError: The file is missing, not pcap or pcapng, or has another link type.
    """
    data = reading.mapped(path)
    reader = pcap.frame_reader(data)
    if reader is None:
        raise EvidenceError("is not a pcap or pcapng file", where=str(path), remedy="read the capture's log")
    integers, parts, damage = Integers(data, LITTLE), [], None
    for chunk in reader(data, where=str(path), chunk_bytes=pcap.CHUNK_BYTES):
        if (chunk.frames.link_type != LINK_TYPE).any():
            raise EvidenceError(
                "has frames without radiotap headers",
                where=str(path),
                remedy="capture on an interface in monitor mode",
            )
        parts.append(decode(integers, chunk.frames))
        damage = chunk.damage
    return RadioCapture(RadioFrames.concatenated(parts), damage)


def decode(integers: Integers, frames: Frames) -> RadioFrames:
    """Return the frames with a correct FCS; `integers` must be little-endian.

    Frames with a truncated or malformed radiotap header are omitted.
    """
    length = integers.u16(frames.start + 2)
    is_valid = (integers.u8(frames.start) == 0) & (length >= _HEADER_BYTES)
    # The shortest frames are ACK and CTS, which have 10 bytes without FCS.
    frames = frames.where(is_valid & (length + 10 <= frames.captured_bytes))
    present = integers.u32(frames.start + 4)
    fields_at = _fields_at(integers, frames)
    headers = {
        bit: np.full(len(frames), UNKNOWN) for bit in (_FLAGS, _RATE, _SIGNAL, _TX_FLAGS, _RETRIES, _MCS, _VHT)
    }
    layouts, layout_of_row = np.unique(
        np.stack((present, fields_at - frames.start), axis=1).reshape(-1, 2), axis=0, return_inverse=True
    )
    header_end = frames.start + integers.u16(frames.start + 2)
    for number, (word, first_offset) in enumerate(layouts.tolist()):
        rows = np.flatnonzero(layout_of_row.reshape(-1) == number)
        for bit, offset, size in _field_offsets(word, first_offset):
            if bit in headers:
                at = frames.start[rows] + offset
                headers[bit][rows] = np.where(at + size <= header_end[rows], at, UNKNOWN)
    return _radio_frames(integers, frames, headers)


def _fields_at(integers: Integers, frames: Frames) -> Ints:
    """Return the position of the first field of each radiotap header, after all words of presence bits."""
    end = frames.start + integers.u16(frames.start + 2)
    word_at = frames.start + 4
    open_rows = np.flatnonzero(integers.u32(word_at) >> 31)
    while len(open_rows):
        word_at[open_rows] += 4
        more = (integers.u32(word_at[open_rows]) >> 31 == 1) & (word_at[open_rows] + 4 < end[open_rows])
        open_rows = open_rows[more]
    return word_at + 4


def _field_offsets(word: int, offset: int) -> Iterator[tuple[int, int, int]]:
    """Yield bit, offset and size of each field whose bit is set; an unknown field hides the fields after it."""
    for bit, (alignment, size) in enumerate(_ALIGN_AND_BYTES):
        if word >> bit & 1:
            offset = (offset + alignment - 1) // alignment * alignment
            yield bit, offset, size
            offset += size


def _radio_frames(integers: Integers, frames: Frames, headers: dict[int, Ints]) -> RadioFrames:
    """Return the frames, from the position of each field of their radiotap headers; `UNKNOWN` for no field."""
    mac = frames.start + integers.u16(frames.start + 2)
    available = frames.start + frames.captured_bytes - mac
    kind, flags = integers.u8(mac), integers.u8(mac + 1)
    qos_at = 24 + 6 * (flags & _FOUR_ADDRESSES == _FOUR_ADDRESSES)
    is_qos_data = (kind & _TYPE_BITS == _DATA_TYPE) & (kind & _QOS_BIT != 0) & (available > qos_at)
    tx_flags = _values(integers.u16(_inside(headers[_TX_FLAGS])), headers[_TX_FLAGS])
    signal = integers.u8(_inside(headers[_SIGNAL])).astype(np.int8).astype(np.int64)
    result = RadioFrames(
        time_ns=frames.time_ns,
        is_sent=headers[_TX_FLAGS] != UNKNOWN,
        kind=kind,
        flags=flags,
        receiver=_address(integers, mac + 4),
        transmitter=np.where(available >= 16, _address(integers, mac + 10), UNKNOWN),
        sequence=np.where(available >= 24, integers.u16(mac + 22), UNKNOWN),
        signal_dbm=np.where(headers[_SIGNAL] == UNKNOWN, NO_SIGNAL, signal),
        rate_bit_s=_rates_bit_s(integers, headers),
        retries=_values(integers.u8(_inside(headers[_RETRIES])), headers[_RETRIES]),
        is_failed=(tx_flags != UNKNOWN) & (tx_flags & _TX_FAILED != 0),
        has_many_packets=is_qos_data & (integers.u8(mac + qos_at) & _AMSDU_BIT != 0),
    )
    header_flags = _values(integers.u8(_inside(headers[_FLAGS])), headers[_FLAGS])
    return result.where((header_flags == UNKNOWN) | (header_flags & _WRONG_FCS == 0))


def _inside(at: Ints) -> Ints:
    """Return positions in the file; 0 for a missing field, whose value is masked later."""
    return np.maximum(at, 0)


def _values(values: Ints, at: Ints) -> Ints:
    return np.where(at == UNKNOWN, UNKNOWN, values)


def _address(integers: Integers, at: Ints) -> Ints:
    number = np.zeros(len(at), dtype=np.int64)
    for offset in range(6):
        number = number << 8 | integers.u8(at + offset)
    return number


def _rates_bit_s(integers: Integers, headers: dict[int, Ints]) -> Ints:
    """Return the PHY rates: of 802.11b/a/g, HT or VHT; 0 if none of these fields is present or complete."""
    legacy_at, ht_at, vht_at = (headers[bit] for bit in (_RATE, _MCS, _VHT))
    rates = np.where(legacy_at == UNKNOWN, 0, integers.u8(_inside(legacy_at)) * _RATE_UNIT_BIT_S)
    at = _inside(ht_at)
    known, ht_flags, mcs = integers.u8(at), integers.u8(at + 1), integers.u8(at + 2)
    streams = mcs // 8 + 1
    symbol_s = np.where(ht_flags & 0x04, _SHORT_SYMBOL_S, _SYMBOL_S)
    ht_bits = _BITS_PER_SUBCARRIER[mcs % 8] * _HT_SUBCARRIERS[ht_flags & 0x03]
    is_ht = (ht_at != UNKNOWN) & (known & _MCS_KNOWN == _MCS_KNOWN) & (streams <= 4)
    rates = np.where(is_ht, np.rint(streams * ht_bits / symbol_s), rates)
    at = _inside(vht_at)
    vht_flags, bandwidth, user = integers.u8(at + 2), integers.u8(at + 3), integers.u8(at + 4)
    subcarriers = sum(np.where(bandwidth == value, count, 0) for value, count in _VHT_SUBCARRIERS.items())
    vht_mcs, streams = user >> 4, user & 0x0F
    symbol_s = np.where(vht_flags & 0x04, _SHORT_SYMBOL_S, _SYMBOL_S)
    vht_bits = _BITS_PER_SUBCARRIER[np.minimum(vht_mcs, len(_BITS_PER_SUBCARRIER) - 1)] * subcarriers
    is_vht = (vht_at != UNKNOWN) & (vht_mcs < len(_BITS_PER_SUBCARRIER))
    return np.where(is_vht, np.rint(streams * vht_bits / symbol_s), rates).astype(np.int64)
