"""Sources of the columns of a topic, and the checks between them."""

from typing import Final

from fieldkit.core.crosschecks import CheckOutcome, CrossCheck

_SAME_FILE: Final = "the same file: checksum and count of samples"

CROSS_CHECKS: Final = (
    CrossCheck(
        "samples sent",
        ("topic_sent", "topic_refused", "topic_skipped", "topic_loss"),
        "`ROLE-topic.bin` of the publisher: samples",
        ("the rate and duration of the procedure", "the publisher's capture: heads of samples", _SAME_FILE),
        "none: every number from 0 on is sent, refused or skipped; a sample in the capture is in the log",
    ),
    CrossCheck(
        "samples received",
        ("topic_received", "topic_loss", "topic_repeated"),
        "`ROLE-topic.bin` of the subscriber: samples",
        (
            "the publisher's log: numbers, sizes and times of sending",
            "the subscriber's capture: heads, packets and bytes of samples",
            _SAME_FILE,
        ),
        "a sample that arrived may be missing if the subscriber's queue overflowed, if an earlier one is missing and "
        "the middleware preserves the order, or within 0.3 s of the match or of the end",
    ),
    CrossCheck(
        "time of sending of each sample",
        ("topic_delay_*", "topic_age_*", "topic_jitter_s"),
        "`ROLE-topic.bin` of both ends: time in the sample",
        ("the publisher's capture: time in the sample, and time of its packet", "the subscriber's capture"),
        "the packet of the fastest sample leaves within 5 ms (20 ms if there are fewer than 20 samples)",
    ),
    CrossCheck(
        "time of arrival of each sample",
        ("topic_delay_*", "topic_age_*", "topic_jitter_s"),
        "`ROLE-topic.bin` of the subscriber: time of the record",
        ("the subscriber's capture: time of the packet with the sample", "the robot's clock around the attempt"),
        "no record is earlier than its packet; the fastest is at most 5 ms later (20 ms if there are fewer than 20)",
    ),
    CrossCheck(
        "delay added by the subscriber's program",
        ("topic_delay_*", "topic_age_*", "topic_jitter_s", "topic_deadline_misses"),
        "`ROLE-topic.bin` of the subscriber: time of the record",
        ("the subscriber's capture: time of the packet with the sample",),
        "up to 20 ms, or a tenth of the figure: a busy robot delays single samples",
        CheckOutcome.WITHHELD,
    ),
    CrossCheck(
        "discovery",
        ("topic_discovered", "topic_discovery_s"),
        "`ROLE-topic.bin` of the publisher: start and match",
        ("the robot's clock around the attempt", "the first sample, 0.5 s after the match"),
        "a first sample that is up to 0.1 s late, as on a busy robot; if it is later, the discovery time is withheld",
    ),
    CrossCheck(
        "completeness of a topic's captures",
        ("topic_capture_withheld",),
        "`ROLE-capture.log`: packets dropped before tcpdump",
        ("`ROLE.pcap`: number of packets, which is in the log too",),
        "none: if a packet was dropped, all columns that need the captures are empty; those of the logs remain",
        CheckOutcome.WITHHELD,
    ),
    CrossCheck(
        "packets and bytes of a topic",
        ("topic_data_*", "topic_discovery_packets", "topic_discovery_bytes", "topic_packet_loss"),
        "the captures: packets of its ports",
        (),
        "the logs give a lower bound of the data packets; only the captures contain discovery",
        CheckOutcome.UNCHECKED,
    ),
)
