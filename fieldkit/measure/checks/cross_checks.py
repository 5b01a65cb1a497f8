"""Sources of the columns of a transfer, and the checks between them."""

from typing import Final

from fieldkit.core.crosschecks import CheckOutcome, CrossCheck
from fieldkit.measure.checks import udp_file

CROSS_CHECKS: Final = (
    udp_file.CROSS_CHECK,
    CrossCheck(
        "file received over TCP",
        ("received_bytes", "file_loss", "hash_match", "goodput_bit_s", "completion_s"),
        "`recv.bag`",
        ("`scan.bag`: the same content up to there", "both captures: bytes that arrived", "how the listener ended"),
        "bytes that its listener did not read before its time limit",
    ),
    CrossCheck(
        "file sent",
        ("sent_bytes", "bag_messages", "bag_duration_s"),
        "`scan.bag`",
        ("sender's capture: bytes that left", "the procedure: topics and duration"),
        "half of the duration, because a recorder needs time to subscribe",
    ),
    CrossCheck(
        "packets sent and received",
        (
            *("ip_*", "datagram*", "byte_loss", "tcp_*", "paper_packets", "paper_received", "paper_loss"),
            *("transfer_s", "transfer_from", "throughput_bit_s", "paper_window_bytes"),
        ),
        "`sender.pcap`, `receiver.pcap`",
        ("each other", "`ROLE-capture.log`: tcpdump's counters", "TCP's acknowledgments", "both files"),
        "none: losses, copies and reordering on the link are no contradictions",
    ),
    CrossCheck(
        "delay and its variation",
        ("one_way_*", "delay_variation_*", "jitter_s", "clock_*"),
        "times in `sender.pcap` and `receiver.pcap`",
        ("packets in both directions: offset and skew of the clocks", "each robot's clock before and after"),
        "withheld if the error of the offset is above a tenth of the delay, or the clocks were unsteady",
        CheckOutcome.WITHHELD,
    ),
    CrossCheck(
        "the paper's delay",
        ("paper_delay_s", "paper_transfer_s"),
        "`ping.txt`: `time=`",
        ("as for the round-trip time of the step ping",),
        "as for the step ping",
    ),
    CrossCheck(
        "datagrams that the kernel refused",
        ("receiver_udp_buffer_errors", "receiver_reassembly_failures"),
        "`ROLE-before.txt`, `ROLE-after.txt`: /proc/net/snmp",
        (),
        "only the kernel counts them; a counter that is missing or decreased is withheld",
        CheckOutcome.UNCHECKED,
    ),
    CrossCheck(
        "components of the delay in the emulator",
        ("delay_s", "delay_*_s", "delay_packets"),
        "`medium.txt`",
        (),
        "only the testbed knows them; the file is rejected if a robot provides it",
        CheckOutcome.UNCHECKED,
    ),
    CrossCheck(
        "distance and speed during the transfer",
        ("transfer_distance_*", "transfer_*_speed_m_s"),
        "`track.csv` of the testbed, else `positions.json`",
        (),
        "compared if steps move robots or record positions",
        CheckOutcome.UNCHECKED,
    ),
)
