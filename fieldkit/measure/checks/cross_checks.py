"""Sources of the columns of a transfer, and the checks between them."""

from typing import Final

from fieldkit.core.crosschecks import CheckOutcome, CrossCheck
from fieldkit.measure.checks import udp_file

CROSS_CHECKS: Final = (
    udp_file.CROSS_CHECK,
    CrossCheck(
        "file that came by TCP",
        ("received_bytes", "file_loss", "hash_match", "goodput_bit_s", "completion_s"),
        "`recv.bag`",
        ("`scan.bag`: it begins with the same bytes", "both captures: bytes that arrived", "how the listener ended"),
        "bytes that its listener left unread at its limit",
    ),
    CrossCheck(
        "file that was sent",
        ("sent_bytes", "bag_messages", "bag_duration_s"),
        "`scan.bag`",
        ("sender's capture: bytes that left", "the procedure: topics and duration"),
        "half of the duration, because a recorder needs time to subscribe",
    ),
    CrossCheck(
        "packets that left and arrived",
        (
            *("ip_*", "datagram*", "byte_loss", "tcp_*", "paper_packets", "paper_received", "paper_loss"),
            *("transfer_s", "transfer_from", "throughput_bit_s", "paper_window_bytes"),
        ),
        "`sender.pcap`, `receiver.pcap`",
        ("each other", "`ROLE-capture.log`: tcpdump's counters", "TCP's acknowledgments", "both files"),
        "none: what a link loses, copies or reorders contradicts nothing",
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
        ("as the round-trip time of the step ping",),
        "as there",
    ),
    CrossCheck(
        "datagrams that the kernel refused",
        ("receiver_udp_buffer_errors", "receiver_reassembly_failures"),
        "`ROLE-before.txt`, `ROLE-after.txt`: /proc/net/snmp",
        (),
        "the kernel alone counts them; a counter that is missing or went back is withheld",
        CheckOutcome.UNCHECKED,
    ),
    CrossCheck(
        "parts of the delay in the emulator",
        ("delay_s", "delay_*_s", "delay_packets"),
        "`medium.txt`",
        (),
        "the testbed alone knows them; a robot that provides the file is refused",
        CheckOutcome.UNCHECKED,
    ),
    CrossCheck(
        "distance and speed meanwhile",
        ("transfer_distance_*", "transfer_*_speed_m_s"),
        "`track.csv` of the testbed, else `positions.json`",
        (),
        "compared where steps move robots, or record where they are",
        CheckOutcome.UNCHECKED,
    ),
)
