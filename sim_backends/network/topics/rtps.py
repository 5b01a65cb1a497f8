"""Messages of RTPS and their sizes (OMG DDSI-RTPS 2.5, clause 9.4), as far as publish-subscribe here uses them.

A message is a header and submessages. Sizes hold everything that goes over the air, from the header of IP on.
"""

from dataclasses import dataclass, field
from typing import Final

IP_AND_UDP_BYTES: Final = 20 + 8
"""Headers of IPv4 without options and of UDP."""
RTPS_HEADER_BYTES: Final = 20
"""Protocol, version, vendor, prefix of the participant's GUID (clause 9.4.4)."""
INFO_DESTINATION_BYTES: Final = 16
INFO_TIMESTAMP_BYTES: Final = 12
_DATA_BYTES: Final = 24
_DATA_FRAG_BYTES: Final = 36
_HEARTBEAT_BYTES: Final = 32
_ACKNACK_BYTES: Final = 28
_NACK_FRAG_BYTES: Final = 32
_GAP_BYTES: Final = 32


@dataclass(slots=True, eq=False)
class Sample:
    """A sample of a topic, and what is known of it from outside of both ends.

    Attributes:
        size_bytes: As serialized, with the encapsulation's header of 4 bytes.
        key: What draws over it are keyed by: its number in the flow, which the program gave it.
        packet_id: Of the program's packet that it carries; -1 for samples of the discovery.
        number: Its sequence number at its writer; 0 until it is sent.
        times_sent: How often each of its fragments was sent.
        under_way: How many messages that carry a part of it have neither arrived nor been lost.
        held: Whether its reader has it whole, though it may wait there for one before it.
        given_up: Why its writer sends it no more; empty while it may.
        settled: Whether it was delivered, or dropped.
        tells: The flow of which a sample of the discovery tells an endpoint.
    """

    size_bytes: int
    key: int
    packet_id: int = -1
    number: int = 0
    times_sent: dict[int, int] = field(default_factory=dict)
    under_way: int = 0
    held: bool = False
    given_up: str = ""
    settled: bool = False
    tells: str = ""

    def fragments(self, fragment_bytes: int) -> int:
        """Return how many fragments it is sent in."""
        return max(-(-self.size_bytes // fragment_bytes), 1)


@dataclass(frozen=True, slots=True)
class Data:
    """DATA, or DATA_FRAG with one or more fragments of a sample that is too large for it (8.3.8.2, 8.3.8.3).

    Attributes:
        sample: The sample; its reader looks at nothing of it but number and size.
        first: Its first fragment in here, from 0.
        count: How many follow each other in here.
        of: How many the sample has.
        fragment_bytes: Size of each but the last.
    """

    sample: Sample
    first: int
    count: int
    of: int
    fragment_bytes: int

    @property
    def size_bytes(self) -> int:
        """Its size; a timestamp goes before the first fragment."""
        begin = self.first * self.fragment_bytes
        payload = min(self.count * self.fragment_bytes, self.sample.size_bytes - begin)
        header = _DATA_BYTES if self.of == 1 else _DATA_FRAG_BYTES
        return header + payload + (0 if self.first else INFO_TIMESTAMP_BYTES)


@dataclass(frozen=True, slots=True)
class Heartbeat:
    """HEARTBEAT: which samples a writer has (8.3.8.6).

    Attributes:
        first: The oldest that it can send again; one beyond `last` where there is none.
        last: The newest that it sent.
        count: Counts its heartbeats.
        final: Whether it asks for no answer.
        directed: Whether it goes to one reader, after what that asked for.
    """

    first: int
    last: int
    count: int
    final: bool
    directed: bool

    @property
    def size_bytes(self) -> int:
        """Its size."""
        return _HEARTBEAT_BYTES


@dataclass(frozen=True, slots=True)
class AckNack:
    """ACKNACK: what a reader has, and what it misses (8.3.8.1).

    Attributes:
        base: It has all samples before this one.
        missing: Samples that it asks for, rising, the first not before `base`.
        count: Counts its messages.
        final: Whether it asks for no heartbeat in answer, unlike the one by which a reader begins.
    """

    base: int
    missing: tuple[int, ...]
    count: int
    final: bool = True

    @property
    def size_bytes(self) -> int:
        """Its size, with a bitmap of whole words from `base` to the last sample that is asked for."""
        return _ACKNACK_BYTES + _bitmap_bytes(self.missing[-1] - self.base + 1 if self.missing else 0)


@dataclass(frozen=True, slots=True)
class NackFrag:
    """NACK_FRAG: which fragments of a sample a reader misses (8.3.8.11).

    Attributes:
        number: Of the sample.
        missing: Fragments, from 0, rising, within 256 of each other.
        count: Counts its messages.
    """

    number: int
    missing: tuple[int, ...]
    count: int

    @property
    def size_bytes(self) -> int:
        """Its size, with a bitmap of whole words from the first fragment to the last."""
        return _NACK_FRAG_BYTES + _bitmap_bytes(self.missing[-1] - self.missing[0] + 1)


@dataclass(frozen=True, slots=True)
class Gap:
    """GAP: samples that a writer will never send again (8.3.8.4).

    Attributes:
        first: The first of them.
        end: One beyond the last.
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
    """A message of one end of a flow for the other.

    Attributes:
        flow: Name of the flow.
        submessages: What it says.
        landed: Whether it has arrived or been lost already, for the account.
    """

    flow: str
    submessages: tuple[Submessage, ...]
    landed: bool = False


def ip_bytes(submessages: tuple[Submessage, ...]) -> int:
    """Return the size of an IP packet that carries a message of these; what answers one reader or writer names it."""
    head = IP_AND_UDP_BYTES + RTPS_HEADER_BYTES
    if not all(isinstance(one, Data) or (isinstance(one, Heartbeat) and not one.directed) for one in submessages):
        head += INFO_DESTINATION_BYTES
    return head + sum(one.size_bytes for one in submessages)


def _bitmap_bytes(bits: int) -> int:
    return 4 * -(-bits // 32)
