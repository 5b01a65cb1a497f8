"""Every CSV column declared once: name, unit, meaning, how it is missing. Missing is empty, never 0."""

import csv
import io
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, fields
from typing import Any, Final

SCHEMA_VERSION: Final = 1


def _column(unit: str, meaning: str) -> Any:  # noqa: ANN401 (as dataclasses.field)
    return field(default=None, metadata={"unit": unit, "meaning": meaning})


@dataclass(frozen=True)
class Column:
    """One declared column.

    Attributes:
        name: Column name.
        unit: Unit, or the kind of value where it has none.
        meaning: What it says, and when it is empty.
    """

    name: str
    unit: str
    meaning: str


@dataclass(frozen=True, kw_only=True)
class Measures:
    """What the raw evidence of one repeat says; computed by `measure.repeat`, None where it does not say it."""

    sent_bytes: int | None = _column("B", "Size of the bag on the sender.")
    received_bytes: int | None = _column("B", "Size of the file that the listener wrote.")
    file_loss: float | None = _column("share", "1 - received_bytes/sent_bytes, what the application missed.")
    hash_match: bool | None = _column("bool", "Whether the received file equals the bag, byte for byte.")
    bag_messages: int | None = _column("count", "Messages in the bag.")
    bag_duration_s: float | None = _column("s", "Time from the bag's first message to its last.")
    ip_packets_sent: int | None = _column(
        "count", "IP packets of the transfer, fragments counted singly, that left the sender (its capture)."
    )
    ip_packets_received: int | None = _column(
        "count",
        "Of these, the ones in the receiver's capture, matched by IP id and offset; TCP: all frames captured.",
    )
    ip_loss: float | None = _column(
        "share", "UDP: 1 - ip_packets_received/ip_packets_sent. Empty for TCP: see tcp_byte_loss."
    )
    datagrams_sent: int | None = _column("count", "UDP datagrams that left the sender. Empty for TCP.")
    datagrams_received: int | None = _column(
        "count", "UDP datagrams of which every fragment reached the receiver's interface. Empty for TCP."
    )
    datagram_loss: float | None = _column("share", "1 - datagrams_received/datagrams_sent. Empty for TCP.")
    byte_loss: float | None = _column(
        "share", "Share of payload bytes of the transfer that never reached the receiver's interface."
    )
    tcp_sent_bytes: int | None = _column("B", "TCP payload bytes sent, retransmissions included. Empty for UDP.")
    tcp_unique_bytes: int | None = _column("B", "TCP payload bytes sent, each sequence number once. Empty for UDP.")
    tcp_received_bytes: int | None = _column(
        "B",
        "Of tcp_sent_bytes, those in the receiver's capture, each sequence number at most as often as it was sent. "
        "Empty for UDP.",
    )
    tcp_byte_loss: float | None = _column(
        "share", "1 - tcp_received_bytes/tcp_sent_bytes: what the radio lost and TCP repaired. Empty for UDP."
    )
    tcp_retransmitted_segments: int | None = _column(
        "count",
        "Data frames sent whose sequence range had been sent before, wholly or in part. Empty for UDP.",
    )
    transfer_s: float | None = _column(
        "s", "First frame of the transfer to its last with payload, both in the capture that transfer_from names."
    )
    transfer_from: str | None = _column("text", "Whose capture transfer_s is from: receiver.")
    rtt_sent: int | None = _column("count", "Echo requests sent.")
    rtt_received: int | None = _column("count", "Echo requests answered, duplicates not counted.")
    rtt_loss: float | None = _column("share", "1 - rtt_received/rtt_sent.")
    rtt_payload_bytes: int | None = _column("B", "ICMP payload of each echo request.")
    rtt_min_s: float | None = _column("s", "Smallest round-trip time.")
    rtt_median_s: float | None = _column("s", "Median round-trip time.")
    rtt_mean_s: float | None = _column("s", "Mean round-trip time.")
    rtt_p95_s: float | None = _column("s", "95th percentile of the round-trip time.")
    rtt_max_s: float | None = _column("s", "Largest round-trip time.")
    paper_packets: int | None = _column(
        "count", "Frames that the paper's filter, src and port of the transfer, counts at the sender."
    )
    paper_received: int | None = _column(
        "count", "Frames that the paper's filter, dst and port of the transfer, counts at the receiver."
    )
    paper_window_bytes: int | None = _column(
        "B", "Ping payload that the paper takes for the protocol: TCP 502, UDP 8192."
    )
    paper_delay_s: float | None = _column("s", "Mean RTT with that payload; empty when the ping had another.")
    paper_transfer_s: float | None = _column("s", "paper_packets * paper_delay_s.")
    paper_loss: float | None = _column("share", "1 - paper_received/paper_packets; sees first fragments only.")
    sender_captured: int | None = _column("count", "Packets in the sender's capture.")
    sender_capture_dropped: int | None = _column("count", "Packets that the sender's kernel dropped before tcpdump.")
    receiver_captured: int | None = _column("count", "Packets in the receiver's capture.")
    receiver_capture_dropped: int | None = _column(
        "count", "Packets that the receiver's kernel dropped before tcpdump."
    )
    receiver_udp_buffer_errors: int | None = _column(
        "count", "Datagrams that the receiver's socket buffer refused during the repeat (RcvbufErrors)."
    )
    receiver_reassembly_failures: int | None = _column(
        "count", "Reassemblies that the receiver's kernel gave up during the repeat (ReasmFails)."
    )


@dataclass(frozen=True, kw_only=True)
class RepeatRow(Measures):
    """One row of trial.csv: one attempt at one repeat."""

    schema_version: int | None = _column("count", "Version of these columns.")
    trial: str | None = _column("text", "Name of the trial's folder.")
    procedure: str | None = _column("text", "Procedure.")
    scenario: str | None = _column("text", "los or nlos.")
    topology: str | None = _column("text", "master or masterless.")
    backend: str | None = _column("text", "Where the robots came from.")
    distance_m: float | None = _column("m", "Distance.")
    distance: str | None = _column("text", "Distance as the operator wrote it.")
    protocol: str | None = _column("text", "tcp or udp.")
    repeat: int | None = _column("count", "Number of the repeat, from 1, per protocol.")
    attempt: int | None = _column(
        "count", "Number of the attempt, from 1; above 1 after a void one. The last one allowed is failed, not void."
    )
    status: str | None = _column("text", "valid, void (evidence not whole) or failed.")
    reason: str | None = _column("text", "Why it is not valid; empty when it is.")
    started_utc_ns: int | None = _column("ns", "Start by the laptop's clock, nanoseconds since 1970 UTC.")
    seed: int | None = _column("count", "The trial's seed.")
    sender: str | None = _column("text", "Robot that sends.")
    receiver: str | None = _column("text", "Robot that receives.")
    relay: str | None = _column("text", "Robot whose access point relays; empty when masterless.")
    profiles_sha256: str | None = _column("hash", "First 16 digits of the hash over the robots' profiles.")
    procedure_sha256: str | None = _column("hash", "First 16 digits of the hash of the procedure.")
    code_sha256: str | None = _column("hash", "First 16 digits of the hash over fieldkit's own source.")


_WILSON: Final = (
    "95 % Wilson interval; empty where more arrived than was sent, as offload lets the paper's filter see"
)
_BOOTSTRAP: Final = "95 % bootstrap interval over repeats; empty for a single one"


def _end(which: str, name: str, how: str, unit: str = "share") -> Any:  # noqa: ANN401 (as dataclasses.field)
    return _column(unit, f"{which} end of {name}: {how}.")


def _extreme(which: str, name: str) -> Any:  # noqa: ANN401 (as dataclasses.field)
    return _column("share", f"{which} {name} of a single repeat.")


@dataclass(frozen=True, kw_only=True)
class CellRow:
    """One row of summary.csv: the valid repeats under one condition; computed by `analysis.summary`.

    Packets and datagrams are counted over all repeats; bytes come in packets, so the repeat is what varies there.
    """

    procedure: str | None = _column("text", "Procedure.")
    scenario: str | None = _column("text", "los or nlos.")
    topology: str | None = _column("text", "master or masterless.")
    backend: str | None = _column("text", "Where the robots came from.")
    distance: str | None = _column("text", "Distance as the operator wrote it.")
    distance_m: float | None = _column("m", "Distance.")
    protocol: str | None = _column("text", "tcp or udp.")
    n_valid: int = _column("count", "Valid repeats; all numbers are of these.")
    n_void: int = _column("count", "Attempts whose evidence was not whole.")
    n_failed: int = _column("count", "Attempts that failed.")
    ip_loss: float | None = _column(
        "share", "UDP: share of the IP packets of all repeats that were lost. Empty for TCP: see tcp_byte_loss."
    )
    ip_loss_low: float | None = _end("Lower", "ip_loss", _WILSON)
    ip_loss_high: float | None = _end("Upper", "ip_loss", _WILSON)
    ip_loss_min: float | None = _extreme("Smallest", "ip_loss")
    ip_loss_max: float | None = _extreme("Largest", "ip_loss")
    tcp_byte_loss: float | None = _column(
        "share", "Mean over repeats of what the radio lost and TCP repaired. Empty for UDP."
    )
    tcp_byte_loss_low: float | None = _end("Lower", "tcp_byte_loss", _BOOTSTRAP)
    tcp_byte_loss_high: float | None = _end("Upper", "tcp_byte_loss", _BOOTSTRAP)
    tcp_byte_loss_min: float | None = _extreme("Smallest", "tcp_byte_loss")
    tcp_byte_loss_max: float | None = _extreme("Largest", "tcp_byte_loss")
    datagram_loss: float | None = _column(
        "share", "Share of the datagrams of all repeats that lost a fragment. Empty for TCP."
    )
    datagram_loss_low: float | None = _end("Lower", "datagram_loss", _WILSON)
    datagram_loss_high: float | None = _end("Upper", "datagram_loss", _WILSON)
    datagram_loss_min: float | None = _extreme("Smallest", "datagram_loss")
    datagram_loss_max: float | None = _extreme("Largest", "datagram_loss")
    byte_loss: float | None = _column("share", "Mean over repeats of the share of payload bytes that never arrived.")
    byte_loss_low: float | None = _end("Lower", "byte_loss", _BOOTSTRAP)
    byte_loss_high: float | None = _end("Upper", "byte_loss", _BOOTSTRAP)
    byte_loss_min: float | None = _extreme("Smallest", "byte_loss")
    byte_loss_max: float | None = _extreme("Largest", "byte_loss")
    file_loss: float | None = _column(
        "share", "Mean over repeats of the share of the file that the application missed."
    )
    file_loss_low: float | None = _end("Lower", "file_loss", _BOOTSTRAP)
    file_loss_high: float | None = _end("Upper", "file_loss", _BOOTSTRAP)
    file_loss_min: float | None = _extreme("Smallest", "file_loss")
    file_loss_max: float | None = _extreme("Largest", "file_loss")
    paper_loss: float | None = _column("share", "Loss by the paper's filter, all repeats together.")
    paper_loss_low: float | None = _end("Lower", "paper_loss", _WILSON)
    paper_loss_high: float | None = _end("Upper", "paper_loss", _WILSON)
    paper_loss_min: float | None = _extreme("Smallest", "paper_loss")
    paper_loss_max: float | None = _extreme("Largest", "paper_loss")
    rtt_loss: float | None = _column("share", "Share of the echo requests of all repeats without an answer.")
    rtt_loss_low: float | None = _end("Lower", "rtt_loss", _WILSON)
    rtt_loss_high: float | None = _end("Upper", "rtt_loss", _WILSON)
    rtt_loss_min: float | None = _extreme("Smallest", "rtt_loss")
    rtt_loss_max: float | None = _extreme("Largest", "rtt_loss")
    rtt_median_s: float | None = _column("s", "Median over repeats of their median round-trip time.")
    rtt_median_s_low: float | None = _end("Lower", "rtt_median_s", _BOOTSTRAP, unit="s")
    rtt_median_s_high: float | None = _end("Upper", "rtt_median_s", _BOOTSTRAP, unit="s")
    transfer_s: float | None = _column("s", "Median over repeats of the transfer time.")
    transfer_s_low: float | None = _end("Lower", "transfer_s", _BOOTSTRAP, unit="s")
    transfer_s_high: float | None = _end("Upper", "transfer_s", _BOOTSTRAP, unit="s")


def declared(row: type[Any]) -> Iterator[Column]:
    """Yield the columns of the row type `row`, its own first, then the measures if it has them."""
    measured = {item.name for item in fields(Measures)} if issubclass(row, Measures) else set()
    for item in sorted(fields(row), key=lambda one: one.name in measured):
        yield Column(name=item.name, unit=item.metadata["unit"], meaning=item.metadata["meaning"])


def cell(value: object) -> str:
    """Return `value` as it stands in a CSV: empty for None, `true`/`false`, floats to 9 significant digits."""
    if value is None:
        return ""
    if isinstance(value, bool):
        return "true" if value else "false"
    return f"{value:.9g}" if isinstance(value, float) else str(value)


def to_csv(row: type[Any], rows: Sequence[Any]) -> str:
    """Return `rows`, instances of the row type `row`, as CSV with a header line (RFC 4180, lines end in LF)."""
    names = [column.name for column in declared(row)]
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(names)
    writer.writerows([cell(getattr(one, name)) for name in names] for one in rows)
    return out.getvalue()
