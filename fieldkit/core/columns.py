"""Every CSV column declared once: name, unit, meaning, how it is missing. Missing is empty, never 0."""

import csv
import io
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, fields
from typing import Any, Final

from fieldkit.core.model import FaultKind

SCHEMA_VERSION: Final = 2


def _column(unit: str, meaning: str) -> Any:  # noqa: ANN401 (as dataclasses.field)
    return field(default=None, metadata={"unit": unit, "meaning": meaning})


def _outage(kind: str) -> Any:  # noqa: ANN401 (as dataclasses.field)
    return _column("s", f"Longest time without an answer around the fault {kind}; empty when it did not recover.")


def _recovery(kind: str) -> Any:  # noqa: ANN401 (as dataclasses.field)
    return _column("s", f"What of the outage by {kind} was left when its cause was over; empty when nobody knows.")


def _recovered(kind: str) -> Any:  # noqa: ANN401 (as dataclasses.field)
    return _column("bool", f"Whether the robot was back within the limit after {kind}.")


def of_fault(kind: FaultKind, what: str) -> str:
    """Return the name of the column that says `what` of a kind of fault: `outage_s`, `recovery_s`, `recovered`."""
    return f"{kind.replace('-', '_')}_{what}"


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
    ip_packets_duplicated: int | None = _column(
        "count",
        "Further copies of ip_packets_sent in the receiver's capture. Empty for TCP: see tcp_duplicated_bytes.",
    )
    ip_packets_reordered: int | None = _column(
        "count",
        "Of ip_packets_received, those that arrived after a packet that was sent later (RFC 4737, section 3). Empty "
        "for TCP: see tcp_reordered_segments.",
    )
    ip_packets_doubtful: int | None = _column(
        "count",
        "Of ip_packets_sent, those that look like others of which not all arrived: which of them were lost is told "
        "by time alone. Empty for TCP.",
    )
    ip_loss_bursts: int | None = _column(
        "count", "Runs of lost packets among ip_packets_sent, in the order of sending. Empty for TCP."
    )
    ip_loss_longest_burst: int | None = _column("count", "Packets in the longest of these runs. Empty for TCP.")
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
    tcp_spurious_segments: int | None = _column(
        "count",
        "Of tcp_retransmitted_segments, those of which an earlier copy of every byte reached the receiver's "
        "interface, before or after. Empty for UDP.",
    )
    tcp_duplicated_bytes: int | None = _column(
        "B", "TCP payload bytes in the receiver's capture beyond the first copy of each. Empty for UDP."
    )
    tcp_reordered_segments: int | None = _column(
        "count",
        "Data frames received whose first byte was sent before one that had arrived; a retransmission is as late as "
        "it was sent. Empty for UDP.",
    )
    tcp_doubtful_segments: int | None = _column(
        "count",
        "Data frames sent with bytes that were sent several times and arrived less often, where time alone tells "
        "which copy arrived. Empty for UDP.",
    )
    tcp_superframes: int | None = _column(
        "count",
        "Data frames in either capture with more payload than the largest MSS that a SYN announced: offload made "
        "several segments one. Empty for UDP, and when no SYN says it.",
    )
    transfer_s: float | None = _column(
        "s", "First frame of the transfer to its last with payload, both in the capture that transfer_from names."
    )
    transfer_from: str | None = _column("text", "Whose capture transfer_s is from: receiver.")
    one_way_min_s: float | None = _column(
        "s",
        "Smallest delay of the transfer's packets from one capture to the other (TCP: frames with payload). This and "
        "the next three are empty when one_way_error_s is above a tenth of them.",
    )
    one_way_median_s: float | None = _column("s", "Median of that delay.")
    one_way_mean_s: float | None = _column("s", "Mean of that delay.")
    one_way_p95_s: float | None = _column("s", "95th percentile of that delay.")
    one_way_error_s: float | None = _column("s", "The most that each of these can be wrong by the two clocks.")
    one_way_withheld: str | None = _column("text", "Why some or all of them are empty; empty when none is.")
    delay_variation_median_s: float | None = _column(
        "s", "Median of the same packets' delay less that of the fastest, which needs no common clock (RFC 5481)."
    )
    delay_variation_p95_s: float | None = _column("s", "95th percentile of that.")
    jitter_s: float | None = _column(
        "s", "Interarrival jitter of the same packets after the last one (RFC 3550, section 6.4.1)."
    )
    clock_offset_s: float | None = _column(
        "s", "Receiver's clock less sender's in the middle of the captures; empty without packets in both directions."
    )
    clock_offset_error_s: float | None = _column("s", "The most that clock_offset_s can be wrong.")
    clock_skew_ppm: float | None = _column(
        "ppm", "How much faster the receiver's clock goes; empty when it can be wrong by more than 100."
    )
    clock_skew_error_ppm: float | None = _column("ppm", "The most that clock_skew_ppm can be wrong.")
    rtt_sent: int | None = _column("count", "Echo requests sent.")
    rtt_received: int | None = _column("count", "Echo requests answered, duplicates not counted.")
    rtt_loss: float | None = _column("share", "1 - rtt_received/rtt_sent.")
    rtt_payload_bytes: int | None = _column("B", "ICMP payload of each echo request.")
    rtt_min_s: float | None = _column("s", "Smallest round-trip time.")
    rtt_median_s: float | None = _column("s", "Median round-trip time.")
    rtt_mean_s: float | None = _column("s", "Mean round-trip time.")
    rtt_p95_s: float | None = _column("s", "95th percentile of the round-trip time.")
    rtt_max_s: float | None = _column("s", "Largest round-trip time.")
    rtt_jitter_s: float | None = _column("s", "Mean absolute difference between one round-trip time and the next.")
    delay_s: float | None = _column(
        "s",
        "Mean delay of the packets from sender to receiver during the transfer, the sum of the paper's four parts "
        "(its eq. 2). Empty where nobody knows them, as in the field.",
    )
    delay_processing_s: float | None = _column("s", "Of delay_s, what the stations took.")
    delay_transmission_s: float | None = _column(
        "s", "Of delay_s, what the packet's bits took at the rate of the link."
    )
    delay_propagation_s: float | None = _column("s", "Of delay_s, what the way took once they had left.")
    delay_queuing_s: float | None = _column("s", "Of delay_s, what the packet waited for others before it.")
    delay_packets: int | None = _column(
        "count", "How many packets delay_s is the mean of: those that were delivered."
    )
    transfer_distance_start_m: float | None = _column(
        "m",
        "Distance between sender and receiver when the transfer's first packet was sent. This and the next eleven "
        "are empty where the lab does not say where robots are, as in the field.",
    )
    transfer_distance_min_m: float | None = _column("m", "Smallest distance from that packet to the last one sent.")
    transfer_distance_mean_m: float | None = _column("m", "Mean distance over that time.")
    transfer_distance_max_m: float | None = _column("m", "Largest distance in that time.")
    transfer_sender_speed_m_s: float | None = _column("m/s", "Mean speed of the sender over that time.")
    transfer_relative_speed_m_s: float | None = _column(
        "m/s", "Mean magnitude of the sender's velocity less the receiver's over that time."
    )
    rtt_distance_start_m: float | None = _column(
        "m", "Distance between sender and receiver at the first reply to ping that has a time stamp."
    )
    rtt_distance_min_m: float | None = _column("m", "Smallest distance from that reply to the last.")
    rtt_distance_mean_m: float | None = _column("m", "Mean distance over that time.")
    rtt_distance_max_m: float | None = _column("m", "Largest distance in that time.")
    rtt_sender_speed_m_s: float | None = _column("m/s", "Mean speed of the sender over that time.")
    rtt_relative_speed_m_s: float | None = _column(
        "m/s", "Mean magnitude of the sender's velocity less the receiver's over that time."
    )
    emulator_late_p99_s: float | None = _column(
        "s",
        "99th percentile of how late packets were handed to their robots, against the emulator's own model, over the "
        "whole repeat; rounded up by an eighth at most. This and the next two are empty where the air is real.",
    )
    emulator_late_max_s: float | None = _column("s", "The latest of these packets.")
    emulator_too_late: int | None = _column(
        "count", "How many of them were later than the site file's emulated.late_bound; the repeat is void above 0."
    )
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
    link_down_outage_s: float | None = _outage("link-down")
    link_down_recovery_s: float | None = _recovery("link-down")
    link_down_recovered: bool | None = _recovered("link-down")
    out_of_range_outage_s: float | None = _outage("out-of-range")
    out_of_range_recovery_s: float | None = _recovery("out-of-range")
    out_of_range_recovered: bool | None = _recovered("out-of-range")
    reboot_outage_s: float | None = _outage("reboot")
    reboot_recovery_s: float | None = _recovery("reboot")
    reboot_recovered: bool | None = _recovered("reboot")
    kill_outage_s: float | None = _outage("kill")
    kill_recovery_s: float | None = _recovery("kill")
    kill_recovered: bool | None = _recovered("kill")


@dataclass(frozen=True, kw_only=True)
class RepeatRow(Measures):
    """One row of trial.csv: one attempt at one repeat."""

    schema_version: int | None = _column(
        "count",
        "Version of these columns, of the fieldkit that measured the row.",
    )
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
    profiles_sha256: str | None = _column("hash", "First 16 digits of the hash over the robots' profiles and roles.")
    procedure_sha256: str | None = _column(
        "hash", "First 16 digits of the hash of the procedure: its file and --record."
    )
    code_sha256: str | None = _column("hash", "First 16 digits of the hash over fieldkit's own source.")


@dataclass(frozen=True, kw_only=True)
class EstimateRow:
    """What summary.csv says of one quantity under one condition, after the columns that name the condition.

    Computed by `analysis.cells`.
    """

    quantity: str | None = _column("text", "Column of trial.csv that the numbers are of.")
    unit: str | None = _column("text", "Unit of all numbers but the counts: s or share.")
    n_valid: int | None = _column("count", "Valid repeats.")
    n_void: int | None = _column("count", "Attempts whose evidence was not whole.")
    n_failed: int | None = _column("count", "Attempts that failed.")
    n: int | None = _column("count", "Valid repeats that have the quantity; all numbers are of these.")
    value: float | None = _column(
        "unit", "The figure to quote: share of all that was counted, mean over repeats, or median over repeats."
    )
    low: float | None = _column(
        "unit", "Lower end of its 95 % interval, the repeat being the unit; empty for a single repeat."
    )
    high: float | None = _column("unit", "Upper end of its 95 % interval.")
    estimate: str | None = _column("text", "What value is: counted, mean, median, or flag (share of the repeats).")
    wilson_low: float | None = _column(
        "unit",
        "Lower end of the 95 % Wilson interval, as if all that was counted were independent. Empty unless counted, "
        "and where more arrived than was sent, as offload lets the paper's filter see.",
    )
    wilson_high: float | None = _column("unit", "Upper end of the 95 % Wilson interval.")
    events: int | None = _column("count", "What was lost, or true; empty unless counted or a flag.")
    trials: int | None = _column("count", "Of how many.")
    mean: float | None = _column("unit", "Mean over repeats.")
    median: float | None = _column("unit", "Median over repeats.")
    p95: float | None = _column("unit", "95th percentile over repeats.")
    minimum: float | None = _column("unit", "Smallest of a single repeat.")
    maximum: float | None = _column("unit", "Largest of a single repeat.")


@dataclass(frozen=True, kw_only=True)
class DifferenceRow:
    """What a comparison of two runs says of one quantity under one condition, after the columns that name it.

    Computed by `analysis.compare`.
    """

    missing_in: str | None = _column("text", "A or B if that run has no such condition; empty if both have.")
    quantity: str | None = _column("text", "Column of trial.csv that the numbers are of.")
    unit: str | None = _column("text", "Unit of all numbers but the counts: s or share.")
    estimate: str | None = _column("text", "What a and b are: counted, mean, median, or flag (share of the repeats).")
    n_a: int | None = _column("count", "Valid repeats of A that have the quantity.")
    n_b: int | None = _column("count", "Valid repeats of B that have it.")
    a: float | None = _column("unit", "What A measured, as `value` of summary.csv; empty if it did not.")
    b: float | None = _column("unit", "What B measured.")
    difference: float | None = _column("unit", "b - a.")
    low: float | None = _column("unit", "Lower end of its 95 % interval; empty where a or b has no interval.")
    high: float | None = _column("unit", "Upper end of its 95 % interval.")
    cliffs_delta: float | None = _column(
        "share", "Pairs of repeats in which B is the larger, less those in which it is the smaller: -1 to 1."
    )
    p_holm: float | None = _column(
        "share", "p-value of the difference, corrected by Holm for the number of all that were compared."
    )
    threshold: float | None = _column("unit", "How far apart a and b may be; empty if nobody said.")
    within: bool | None = _column("bool", "Whether the whole interval is within the threshold.")
    verdict: str | None = _column("text", "All of it in words.")


def declared(row: type[Any]) -> Iterator[Column]:
    """Yield the columns of the row type `row`, its own first, then the measures if it has them."""
    measured = {item.name for item in fields(Measures)} if issubclass(row, Measures) else set()
    for item in sorted(fields(row), key=lambda one: one.name in measured):
        yield Column(name=item.name, unit=item.metadata["unit"], meaning=item.metadata["meaning"])


def cell(value: object) -> str:
    """Return `value` as it stands in a CSV: empty for None, `true`/`false`, floats to 9 digits, text in one line."""
    if value is None:
        return ""
    if isinstance(value, bool):
        return "true" if value else "false"
    return f"{value:.9g}" if isinstance(value, float) else " ".join(str(value).splitlines())


def to_csv(row: type[Any], rows: Sequence[Any]) -> str:
    """Return `rows`, instances of the row type `row`, as CSV with a header line (RFC 4180, lines end in LF)."""
    names = [column.name for column in declared(row)]
    return csv_text(names, ([getattr(one, name) for name in names] for one in rows))


def csv_text(names: Iterable[str], rows: Iterable[Iterable[object]]) -> str:
    """Return a header line and lines of values as CSV, as `to_csv`."""
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(names)
    writer.writerows(map(cell, row) for row in rows)
    return out.getvalue()
