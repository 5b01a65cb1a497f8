"""Columns of a video over RTP: frames from the logs of both ends, packets from the captures."""

from typing import Final

import numpy as np

from fieldkit.core.columns import Figure, Kind, Measured, Value, columns
from fieldkit.ros.streams import sample_reads
from fieldkit.ros.streams.topic_columns import first_arrivals
from fieldkit.ros.streams.topic_samples import TopicLog
from fieldkit.ros.video.rtp_packets import RtpPackets, match_frames

_OF_LOGS: Final = columns(
    sample_reads.RANK,
    ("video_sent", "count", "Frames that the sender passed to its pipeline."),
    ("video_received", "count", "Frames of video_sent that the receiver's pipeline returned, each counted once."),
    (
        "video_loss",
        "share",
        "1 - video_received/video_sent. Empty if nothing was sent.",
        Figure("frame loss", Kind.COUNTED, "video_received", "video_sent", rank=86),
    ),
    ("video_skipped", "count", "Frames that were never sent: their time passed while the pipeline was busy."),
    ("video_unreadable", "count", "Frames that the receiver's pipeline returned with unreadable pixels."),
)
_OF_CAPTURES: Final = columns(
    sample_reads.RANK,
    (
        "video_bit_s",
        "bit/s",
        "Bit rate of the video at the sender, with the headers of its frames on the link.",
        Figure("bit rate of the video", Kind.MEDIAN, rank=87),
    ),
    ("video_packets", "count", "RTP packets in the sender's capture."),
    (
        "video_packet_loss",
        "share",
        "Share of video_packets that are not in the receiver's capture.",
        Figure("RTP packet loss", Kind.MEAN, rank=87),
    ),
    (
        "video_undecoded",
        "count",
        (
            "Frames whose packets all arrived, but which the receiver's pipeline did not return, for example because "
            "its socket buffer was full, or packets were reordered."
        ),
    ),
)
COLUMNS: Final = (*_OF_LOGS, *_OF_CAPTURES, *sample_reads.declare_columns("seen", "video_sent"))


def measure_frames(sent: TopicLog | None, received: TopicLog | None) -> Measured:
    """Return the columns of frames; a log is None if it is incomplete."""
    if sent is None or received is None:
        return Measured.all_missing(_OF_LOGS, "there are no complete logs of both ends")
    arrived = np.isin(first_arrivals(received).sequence, sent.samples.sequence)
    sent_count, received_count = len(sent.samples), int(arrived.sum())
    values: dict[str, Value | None] = {
        "video_sent": sent_count,
        "video_received": received_count,
        "video_loss": 1 - received_count / sent_count if sent_count else None,
        "video_skipped": sent.skipped,
        "video_unreadable": received.unreadable,
    }
    return Measured.from_optional(values, "no frame was sent")


def measure_packets(
    sent: RtpPackets | None, captured: RtpPackets | None, received: TopicLog | None, interval_s: float
) -> Measured:
    """Return the columns of packets.

    Args:
        sent: Packets in the sender's capture; None without a complete capture.
        captured: Packets in the receiver's capture; None without a complete capture.
        received: Log of the receiver; None if it is incomplete.
        interval_s: Time between two frames.
    """
    if sent is None or captured is None:
        return Measured.all_missing(_OF_CAPTURES, "there are no complete captures of both ends")
    if not len(sent):
        return Measured.all_missing(_OF_CAPTURES, "the sender's capture has no packet of the video")
    frames = match_frames(sent, captured)
    duration_s = float(frames.sent_ns[-1] - frames.sent_ns[0]) / 1e9 + interval_s
    packets = int(frames.packets.sum())
    values: dict[str, Value | None] = {
        "video_bit_s": 8 * int(sent.wire_bytes.sum()) / duration_s,
        "video_packets": packets,
        "video_packet_loss": 1 - int(frames.arrived.sum()) / packets,
    }
    if received is not None:
        complete = np.flatnonzero(frames.arrived == frames.packets)
        values["video_undecoded"] = int((~np.isin(complete, received.samples.sequence)).sum())
    return Measured.from_optional(values, "") | Measured.all_missing(
        _OF_CAPTURES, "there is no complete log of the receiver"
    )
