"""Sizes and contents of the RTPS messages that are used (OMG DDSI-RTPS 2.5, clause 9.4).

A message consists of a header and submessages. Message sizes include the headers of IP and UDP.
"""

from dataclasses import dataclass, field
from typing import Final

IP_AND_UDP_BYTES: Final = 20 + 8
"""Headers of IPv4 without options and of UDP."""
RTPS_HEADER_BYTES: Final = 20
"""Protocol, version, vendor, prefix of the participant's GUID (clause 9.4.4)."""
INFO_DESTINATION_BYTES: Final = 16
INFO_TIMESTAMP_BYTES: Final = 12
# Sizes of submessages, without samples and bitmaps.
_DATA_BYTES: Final = 24
_DATA_FRAG_BYTES: Final = 36
_HEARTBEAT_BYTES: Final = 32
_ACKNACK_BYTES: Final = 28
_NACK_FRAG_BYTES: Final = 32
_GAP_BYTES: Final = 32


@dataclass(slots=True, eq=False)
class Sample:
    """A sample of a topic, with statistics that the ends do not use.

    Attributes:
        size_bytes: Serialized size with the encapsulation header of 4 bytes.
        key: Key of its random draws: its number in the flow, assigned by the program.
        packet_id: Number of the program's packet that it carries; -1 for samples of the discovery.
        number: Its sequence number at its writer; 0 until it is sent.
        times_sent: Number of transmissions of each fragment.
        in_flight: Number of messages with a part of it that have neither arrived nor been lost.
        is_stored: True if its reader has stored all of it, possibly until an earlier sample has been delivered.
        give_up_reason: Reason why its writer will not send it again; empty while the writer may send it.
        is_settled: True if it was delivered or dropped.
        endpoint_flow: For a sample of the discovery, the flow whose endpoint it describes.
    """

    size_bytes: int
    key: int
    packet_id: int = -1
    number: int = 0
    times_sent: dict[int, int] = field(default_factory=dict)
    in_flight: int = 0
    is_stored: bool = False
    give_up_reason: str = ""
    is_settled: bool = False
    endpoint_flow: str = ""

    def fragments(self, fragment_bytes: int) -> int:
        """Return the number of fragments in which it is sent."""
        return max(-(-self.size_bytes // fragment_bytes), 1)


@dataclass(frozen=True, slots=True)
class Data:
    """DATA, or DATA_FRAG with consecutive fragments of a sample that is too large for DATA (8.3.8.2, 8.3.8.3).

    Attributes:
        sample: The sample; its reader uses only its number and size.
        first: Index of the first fragment, from 0.
        count: Number of consecutive fragments.
        fragment_count: Number of fragments of the whole sample.
        fragment_bytes: Size of each fragment except the last.
    """

    sample: Sample
    first: int
    count: int
    fragment_count: int
    fragment_bytes: int

    @property
    def size_bytes(self) -> int:
        """Its size, with a timestamp before the first fragment."""
        begin = self.first * self.fragment_bytes
        payload = min(self.count * self.fragment_bytes, self.sample.size_bytes - begin)
        header = _DATA_BYTES if self.fragment_count == 1 else _DATA_FRAG_BYTES
        return header + payload + (0 if self.first else INFO_TIMESTAMP_BYTES)


@dataclass(frozen=True, slots=True)
class Heartbeat:
    """HEARTBEAT: the samples that a writer has (8.3.8.6).

    Attributes:
        first: The oldest sample that it can send again; `last` + 1 if there is none.
        last: The newest sample that it sent.
        count: Number of the heartbeat.
        final: True if no response is required.
        directed: True if it is for one reader, in response to its request.
    """

    first: int
    last: int
    count: int
    final: bool
    directed: bool

    @property
    def size_bytes(self) -> int:
        """Its size, without the headers of the message."""
        return _HEARTBEAT_BYTES


@dataclass(frozen=True, slots=True)
class AckNack:
    """ACKNACK: the samples that a reader has, and the samples that it lacks (8.3.8.1).

    Attributes:
        base: The reader has all samples before this number.
        missing: Requested samples in ascending order, none before `base`.
        count: Number of the message.
        final: True if no heartbeat is required in response; False for a reader's first ACKNACK.
    """

    base: int
    missing: tuple[int, ...]
    count: int
    final: bool = True

    @property
    def size_bytes(self) -> int:
        """Its size, with a bitmap of 4-byte words from `base` to the last requested sample."""
        return _ACKNACK_BYTES + _bitmap_bytes(self.missing[-1] - self.base + 1 if self.missing else 0)


@dataclass(frozen=True, slots=True)
class NackFrag:
    """NACK_FRAG: the fragments of a sample that a reader lacks (8.3.8.12).

    Attributes:
        number: Number of the sample.
        missing: Indices of fragments, from 0, in ascending order, within 256 of each other.
        count: Number of the message.
    """

    number: int
    missing: tuple[int, ...]
    count: int

    @property
    def size_bytes(self) -> int:
        """Its size, with a bitmap of 4-byte words from the first fragment to the last."""
        return _NACK_FRAG_BYTES + _bitmap_bytes(self.missing[-1] - self.missing[0] + 1)


@dataclass(frozen=True, slots=True)
class Gap:
    """GAP: samples that a writer will never send again (8.3.8.4).

    Attributes:
        first: Number of the first of these samples.
        end: Number after the last of these samples.
    """

    first: int
    end: int

    @property
    def size_bytes(self) -> int:
        """Its size, with a bitmap of one empty word."""
        return _GAP_BYTES + _bitmap_bytes(1)


Submessage = Data | Heartbeat | AckNack | NackFrag | Gap


@dataclass(slots=True, eq=False)
class RtpsMessage:
    """A message from one end of a flow to the other.

    Attributes:
        flow: Name of the flow.
        submessages: Its content.
        is_resolved: True if it has already arrived or been lost; only statistics use it.
    """

    flow: str
    submessages: tuple[Submessage, ...]
    is_resolved: bool = False


def ip_bytes(submessages: tuple[Submessage, ...]) -> int:
    """Return the size of an IP packet with these submessages.

    A message for a single reader or writer also contains an INFO_DST.
    """
    header_bytes = IP_AND_UDP_BYTES + RTPS_HEADER_BYTES
    if not all(
        isinstance(submessage, Data) or (isinstance(submessage, Heartbeat) and not submessage.directed)
        for submessage in submessages
    ):
        header_bytes += INFO_DESTINATION_BYTES
    return header_bytes + sum(submessage.size_bytes for submessage in submessages)


def _bitmap_bytes(bits: int) -> int:
    return 4 * -(-bits // 32)
