"""Contradictions between the logs of a video over RTP and the captures of its ends.

`fieldkit.ros.streams.topic_checks` and `read_checks` compare the logs with each other and with the procedure.
"""

from collections.abc import Iterator
from typing import Final

import numpy as np

from fieldkit.core.crosschecks import CheckOutcome, CrossCheck
from fieldkit.core.units import format_count
from fieldkit.ros.streams.sample_arrivals import STAMP_NS
from fieldkit.ros.streams.topic_columns import first_arrivals
from fieldkit.ros.streams.topic_samples import TopicLog
from fieldkit.ros.video.rtp_packets import NO_PACKET, RtpPackets, match_frames


def check_captures(sent: TopicLog, received: TopicLog, sender: RtpPackets, receiver: RtpPackets) -> Iterator[str]:
    """Yield each contradiction as a sentence.

    Args:
        sent: Complete log of the sender.
        received: Complete log of the receiver.
        sender: Packets in the sender's complete capture.
        receiver: Packets in the receiver's complete capture.
    """
    frames = match_frames(sender, receiver)
    if len(frames) != len(sent.samples):
        in_capture = f"the sender's capture has {format_count(len(frames), 'frame')}"
        yield f"{in_capture} of the video, but its log has {len(sent.samples)}"
        return
    if early := int((frames.sent_ns < sent.samples.sent_ns - STAMP_NS).sum()):
        early_text = f"the sender's capture has {format_count(early, 'frame')}"
        yield f"{early_text} sent before the time of the frame in the sender's log"
    arrived = first_arrivals(received)
    sent_arrivals = arrived.where(np.isin(arrived.sequence, np.arange(len(frames))))
    numbers, arrived_ns = sent_arrivals.sequence, sent_arrivals.at_ns
    first_ns, last_ns = frames.first_ns[numbers], frames.last_ns[numbers]
    if lacking := int((first_ns == NO_PACKET).sum()):
        yield f"the receiver's capture has no packet of {format_count(lacking, 'frame')} in its log"
    if early := int(((first_ns != NO_PACKET) & (arrived_ns < first_ns - STAMP_NS)).sum()):
        yield f"{format_count(early, 'frame')} in the receiver's log arrived before the packets in its capture"
    is_complete = frames.arrived[numbers] == frames.packets[numbers]
    if early := int((is_complete & (arrived_ns < last_ns - STAMP_NS)).sum()):
        yield f"{format_count(early, 'frame')} in the receiver's log arrived before the last packet in its capture"
    returned, captured = len(received.samples) + received.unreadable, int((frames.arrived > 0).sum())
    if returned > captured:
        yield f"the receiver's log has {format_count(returned, 'frame')}, but its capture has packets of {captured}"


CROSS_CHECKS: Final = (
    CrossCheck(
        quantity="frames sent",
        columns=("video_sent", "video_loss", "video_skipped", "seen_never"),
        source="`ROLE-video.bin` of the sender: frames",
        against=(
            "the rate and duration of the procedure",
            "the sender's capture: RTP time stamps and times of packets",
        ),
        tolerance="none: every frame is sent or skipped; its packets are not earlier than the time in its pixels",
    ),
    CrossCheck(
        quantity="frames received",
        columns=("video_received", "video_loss", "video_unreadable", "seen_*"),
        source="`ROLE-video.bin` of the receiver: numbers and times in the pixels",
        against=("the sender's log: numbers and times", "the receiver's capture: RTP packets of each frame"),
        tolerance="none: each frame was sent with this time, has packets, and is not earlier than the last of them",
    ),
    CrossCheck(
        quantity="packets of a video",
        columns=("video_packets", "video_packet_loss", "video_bit_s", "video_undecoded"),
        source="the captures: RTP sequence numbers and time stamps",
        against=(),
        tolerance="the logs contain frames, not packets",
        outcome=CheckOutcome.UNCHECKED,
    ),
)
