"""Columns of one transfer: loss on each layer, duration, delay, and the figures of the paper.

*The paper* is the publication whose field trials fieldkit automates (docs/index.md).
"""

from typing import Final

from fieldkit.core.columns import NEGATIVE_LOSS_BOUNDS, Column, Figure, Kind, columns
from fieldkit.measure.evidence import host, oracle_delays
from fieldkit.measure.transfers import delay, rates, stalls

FILES: Final = columns(
    10,
    ("sent_bytes", "B", "Size of the bag on the sender."),
    ("received_bytes", "B", "Size of the file that the listener wrote."),
    (
        "file_loss",
        "share",
        "1 - received_bytes/sent_bytes: the share of the bytes that the application did not receive.",
        Figure("file loss", Kind.MEAN, rank=14),
        NEGATIVE_LOSS_BOUNDS,
    ),
    ("hash_match", "bool", "True if the received file equals the bag byte for byte."),
    ("bag_messages", "count", "Messages in the bag."),
    ("bag_duration_s", "s", "Time from the bag's first message to its last."),
)
LAYERS: Final = columns(
    10,
    (
        "ip_packets_sent",
        "count",
        "IP packets of the transfer in the sender's capture; each fragment is a packet.",
    ),
    (
        "ip_packets_received",
        "count",
        (
            "Packets of ip_packets_sent that are in the receiver's capture, matched by IP id and offset. TCP: all "
            "frames in the receiver's capture."
        ),
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
        "Further copies of sent packets in the receiver's capture. Empty for TCP: see tcp_duplicated_bytes.",
    ),
    (
        "ip_packets_reordered",
        "count",
        (
            "Packets of ip_packets_received that arrived after a packet that was sent later (RFC 4737, section 3)."
            " Empty if packets are ambiguous, and for TCP: see tcp_reordered_segments."
        ),
    ),
    (
        "ip_packets_doubtful",
        "count",
        (
            "Packets of ip_packets_sent that are ambiguous: other packets with the same headers and contents were"
            " sent at nearly the same time, and only some of these packets arrived. Empty for TCP."
        ),
    ),
    (
        "ip_loss_bursts",
        "count",
        (
            "Runs of consecutively sent packets that were lost. Empty for TCP, and if packets are ambiguous and"
            " some were lost."
        ),
    ),
    ("ip_loss_longest_burst", "count", "Packets in the longest such run; empty if ip_loss_bursts is empty."),
    ("datagrams_sent", "count", "UDP datagrams that left the sender. Empty for TCP."),
    (
        "datagrams_received",
        "count",
        "UDP datagrams of which all fragments reached the receiver's interface. Empty for TCP.",
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
        "Share of the transfer's payload bytes that never reached the receiver's interface.",
        Figure("payload byte loss", Kind.MEAN, rank=13),
    ),
    ("tcp_sent_bytes", "B", "Sent TCP payload bytes, including retransmissions. Empty for UDP."),
    ("tcp_unique_bytes", "B", "Sent TCP payload bytes; each sequence number counts once. Empty for UDP."),
    (
        "tcp_received_bytes",
        "B",
        (
            "Bytes of tcp_sent_bytes that are in the receiver's capture; if a byte arrived more often than it was "
            "sent, the further copies do not count. Empty if a copy may hide a loss, and for UDP."
        ),
    ),
    (
        "tcp_byte_loss",
        "share",
        "1 - tcp_received_bytes/tcp_sent_bytes: the loss on the link, which TCP repairs. Empty for UDP.",
        Figure("TCP byte loss before retransmission", Kind.MEAN, rank=12),
    ),
    (
        "tcp_retransmitted_segments",
        "count",
        "Sent data frames with bytes that had been sent before. Empty for UDP.",
    ),
    (
        "tcp_spurious_segments",
        "count",
        (
            "Segments of tcp_retransmitted_segments that were not necessary: an earlier copy of each byte reached "
            "the receiver's interface at any time. Empty if segments are ambiguous, and for UDP."
        ),
    ),
    (
        "tcp_duplicated_bytes",
        "B",
        "TCP payload bytes in the receiver's capture, without the first copy of each byte. Empty for UDP.",
    ),
    (
        "tcp_reordered_segments",
        "count",
        (
            "Received data frames whose first byte was sent before a byte that had already arrived. The time of "
            "sending of a retransmission is the time at which it was retransmitted. Empty if segments are ambiguous, "
            "and for UDP."
        ),
    ),
    (
        "tcp_doubtful_segments",
        "count",
        (
            "Sent data frames with bytes that were sent several times and arrived, if neither time stamps nor IP "
            "ids nor the time between the frames show which copy arrived. Empty for UDP."
        ),
    ),
    (
        "tcp_superframes",
        "count",
        (
            "Data frames in either capture with more payload than the largest MSS in a SYN, because offload joined "
            "several segments. Empty for UDP, and if no SYN has an MSS."
        ),
    ),
    (
        "transfer_s",
        "s",
        "Time from the first frame of the transfer to the last frame with payload, in the capture of transfer_from.",
        Figure("transfer time", Kind.MEDIAN, rank=35),
    ),
    ("transfer_from", "text", "Robot whose capture gives transfer_s: receiver."),
)
DISTANCE: Final = columns(
    35,
    (
        "transfer_distance_start_m",
        "m",
        (
            "Distance between sender and receiver when the transfer's first packet was sent. All distances and "
            "speeds are empty if no positions are known."
        ),
    ),
    ("transfer_distance_min_m", "m", "Smallest distance from the first packet sent to the last."),
    ("transfer_distance_mean_m", "m", "Mean distance from the first packet sent to the last."),
    ("transfer_distance_max_m", "m", "Largest distance from the first packet sent to the last."),
    ("transfer_sender_speed_m_s", "m/s", "Mean speed of the sender from the first packet sent to the last."),
    (
        "transfer_relative_speed_m_s",
        "m/s",
        "Mean magnitude of the relative velocity of sender and receiver from the first packet sent to the last.",
    ),
)
PAPER: Final = columns(
    60,
    (
        "paper_packets",
        "count",
        "Frames in the sender's capture that match the filter of the paper, `src SENDER and port PORT`.",
    ),
    (
        "paper_received",
        "count",
        "Frames in the receiver's capture that match the filter of the paper, `dst RECEIVER and port PORT`.",
    ),
    ("paper_window_bytes", "B", "Ping payload that the paper uses for the protocol: TCP 502, UDP 8192."),
    (
        "paper_delay_s",
        "s",
        "Mean RTT of a ping with paper_window_bytes of payload; empty if its payload was different.",
    ),
    ("paper_transfer_s", "s", "paper_packets * paper_delay_s."),
    (
        "paper_loss",
        "share",
        "1 - paper_received/paper_packets; only the first fragment of a fragmented packet counts.",
        Figure("paper's loss (eq. 1)", Kind.COUNTED, "paper_received", "paper_packets", rank=15),
        NEGATIVE_LOSS_BOUNDS,
    ),
)
STALLS: Final = stalls.declare_columns("transfer", "the transfer", 36)

COLUMNS: Final[tuple[Column, ...]] = (
    *FILES,
    *LAYERS,
    *delay.COLUMNS,
    *oracle_delays.AIR_DELAY_COLUMNS,
    *DISTANCE,
    *PAPER,
    *host.COLUMNS,
    *host.SYSTEM,
    *rates.COLUMNS,
    *STALLS,
    *delay.SENT_COLUMNS,
    *oracle_delays.POLICY_COLUMNS,
)

TIMES: Final = [column for column in LAYERS if column.name in {"transfer_s", "transfer_from"}]
"""Columns that depend only on the receiver's clock."""

OF_TCP: Final = frozenset(column.name for column in LAYERS if column.name.startswith("tcp_"))
"""Names of the columns that only a TCP transfer has."""
OF_UDP: Final = frozenset(
    column.name
    for column in LAYERS
    if column.name.startswith(("ip_", "datagram")) and column.name not in {"ip_packets_sent", "ip_packets_received"}
)
"""Names of the columns that only a UDP transfer has."""
