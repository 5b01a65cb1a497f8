"""The columns of one transfer: what it lost on each layer, how long it took, and how the paper counts."""

from typing import Final

from fieldkit.core.columns import OVERCOUNTED, Column, Figure, Kind, columns
from fieldkit.measure.evidence import host, medium
from fieldkit.measure.transfers import delay, rates, stalls

FILES: Final = columns(
    10,
    ("sent_bytes", "B", "Size of the bag on the sender."),
    ("received_bytes", "B", "Size of the file that the listener wrote."),
    (
        "file_loss",
        "share",
        "1 - received_bytes/sent_bytes, what the application missed.",
        Figure("file loss", Kind.MEAN, rank=14),
        OVERCOUNTED,
    ),
    ("hash_match", "bool", "Whether the received file equals the bag, byte for byte."),
    ("bag_messages", "count", "Messages in the bag."),
    ("bag_duration_s", "s", "Time from the bag's first message to its last."),
)
LAYERS: Final = columns(
    10,
    (
        "ip_packets_sent",
        "count",
        "IP packets of the transfer, fragments counted singly, that left the sender (its capture).",
    ),
    (
        "ip_packets_received",
        "count",
        "Of these, the ones in the receiver's capture, matched by IP id and offset; TCP: all frames captured.",
    ),
    (
        "ip_loss",
        "share",
        "UDP: 1 - ip_packets_received/ip_packets_sent. Empty for TCP: see tcp_byte_loss.",
        Figure("IP packet loss", Kind.COUNTED, "ip_packets_received", "ip_packets_sent", rank=10),
    ),
    (
        "ip_packets_duplicated",
        "count",
        "Further copies of ip_packets_sent in the receiver's capture. Empty for TCP: see tcp_duplicated_bytes.",
    ),
    (
        "ip_packets_reordered",
        "count",
        (
            "Of ip_packets_received, those that arrived after a packet that was sent later (RFC 4737, section 3)."
            " Empty where packets are doubtful, and for TCP: see tcp_reordered_segments."
        ),
    ),
    (
        "ip_packets_doubtful",
        "count",
        (
            "Of ip_packets_sent, those of which some arrived that look alike, in their bytes too, and were sent so"
            " close to each other that nothing tells which. Empty for TCP."
        ),
    ),
    (
        "ip_loss_bursts",
        "count",
        (
            "Runs of lost packets among ip_packets_sent, in the order of sending. Empty for TCP, and where packets"
            " are doubtful and some were lost."
        ),
    ),
    ("ip_loss_longest_burst", "count", "Packets in the longest of these runs, likewise."),
    ("datagrams_sent", "count", "UDP datagrams that left the sender. Empty for TCP."),
    (
        "datagrams_received",
        "count",
        "UDP datagrams of which every fragment reached the receiver's interface. Empty for TCP.",
    ),
    (
        "datagram_loss",
        "share",
        "1 - datagrams_received/datagrams_sent. Empty for TCP.",
        Figure("UDP datagram loss", Kind.COUNTED, "datagrams_received", "datagrams_sent", rank=11),
    ),
    (
        "byte_loss",
        "share",
        "Share of payload bytes of the transfer that never reached the receiver's interface.",
        Figure("payload byte loss", Kind.MEAN, rank=13),
    ),
    ("tcp_sent_bytes", "B", "TCP payload bytes sent, retransmissions included. Empty for UDP."),
    ("tcp_unique_bytes", "B", "TCP payload bytes sent, each sequence number once. Empty for UDP."),
    (
        "tcp_received_bytes",
        "B",
        (
            "Of tcp_sent_bytes, those in the receiver's capture; what arrived more often than it was sent counts "
            "no further. Empty where a copy may hide a loss, and for UDP."
        ),
    ),
    (
        "tcp_byte_loss",
        "share",
        "1 - tcp_received_bytes/tcp_sent_bytes: what the radio lost and TCP repaired. Empty for UDP.",
        Figure("TCP byte loss before retransmission", Kind.MEAN, rank=12),
    ),
    (
        "tcp_retransmitted_segments",
        "count",
        "Data frames sent whose sequence range had been sent before, wholly or in part. Empty for UDP.",
    ),
    (
        "tcp_spurious_segments",
        "count",
        (
            "Of tcp_retransmitted_segments, those of which an earlier copy of every byte reached the receiver's "
            "interface, before or after. Empty where segments are doubtful, and for UDP."
        ),
    ),
    (
        "tcp_duplicated_bytes",
        "B",
        "TCP payload bytes in the receiver's capture beyond the first copy of each. Empty for UDP.",
    ),
    (
        "tcp_reordered_segments",
        "count",
        (
            "Data frames received whose first byte was sent before one that had arrived; a retransmission is as "
            "late as it was sent. Empty where segments are doubtful, and for UDP."
        ),
    ),
    (
        "tcp_doubtful_segments",
        "count",
        (
            "Data frames sent with bytes that were sent several times and arrived, where neither time stamps nor IP "
            "ids nor the time between them tell which copy did. Empty for UDP."
        ),
    ),
    (
        "tcp_superframes",
        "count",
        (
            "Data frames in either capture with more payload than the largest MSS that a SYN announced: offload "
            "made several segments one. Empty for UDP, and when no SYN says it."
        ),
    ),
    (
        "transfer_s",
        "s",
        "First frame of the transfer to its last with payload, both in the capture that transfer_from names.",
        Figure("transfer time", Kind.MEDIAN, rank=35),
    ),
    ("transfer_from", "text", "Whose capture transfer_s is from: receiver."),
)
WAY: Final = columns(
    35,
    (
        "transfer_distance_start_m",
        "m",
        (
            "Distance between sender and receiver when the transfer's first packet was sent. This and the next "
            "eleven are empty where the lab does not say where robots are, as in the field."
        ),
    ),
    ("transfer_distance_min_m", "m", "Smallest distance from that packet to the last one sent."),
    ("transfer_distance_mean_m", "m", "Mean distance over that time."),
    ("transfer_distance_max_m", "m", "Largest distance in that time."),
    ("transfer_sender_speed_m_s", "m/s", "Mean speed of the sender over that time."),
    (
        "transfer_relative_speed_m_s",
        "m/s",
        "Mean magnitude of the sender's velocity less the receiver's over that time.",
    ),
)
PAPER: Final = columns(
    60,
    (
        "paper_packets",
        "count",
        "Frames that the paper's filter, src and port of the transfer, counts at the sender.",
    ),
    (
        "paper_received",
        "count",
        "Frames that the paper's filter, dst and port of the transfer, counts at the receiver.",
    ),
    ("paper_window_bytes", "B", "Ping payload that the paper takes for the protocol: TCP 502, UDP 8192."),
    ("paper_delay_s", "s", "Mean RTT with that payload; empty when the ping had another."),
    ("paper_transfer_s", "s", "paper_packets * paper_delay_s."),
    (
        "paper_loss",
        "share",
        "1 - paper_received/paper_packets; sees first fragments only.",
        Figure("paper's loss (eq. 1)", Kind.COUNTED, "paper_received", "paper_packets", rank=15),
        OVERCOUNTED,
    ),
)
STALLS: Final = stalls.declared("transfer", "the transfer", 36)

COLUMNS: Final[tuple[Column, ...]] = (
    *FILES,
    *LAYERS,
    *delay.COLUMNS,
    *medium.COLUMNS,
    *WAY,
    *PAPER,
    *host.COLUMNS,
    *host.SYSTEM,
    *rates.COLUMNS,
    *STALLS,
    *delay.SENT_COLUMNS,
)

TIMES: Final = [column for column in LAYERS if column.name in {"transfer_s", "transfer_from"}]
"""What is told by one clock, the receiver's."""

OF_TCP: Final = frozenset(column.name for column in LAYERS if column.name.startswith("tcp_"))
OF_UDP: Final = frozenset(
    column.name
    for column in LAYERS
    if column.name.startswith(("ip_", "datagram")) and column.name not in {"ip_packets_sent", "ip_packets_received"}
)
