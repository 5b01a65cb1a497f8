"""Pipelines of GStreamer that send a video as JPEG over RTP (RFC 2435) and receive it, and the elements they need."""

from collections.abc import Sequence
from fractions import Fraction
from typing import Final

from fieldkit.core.model import Role, Verdict
from fieldkit.ros.streams.read_options import dimensions
from fieldkit.steps.scene import CommandResult, Need

PROGRAM: Final = "gst-launch-1.0"
PACKAGES: Final = "gstreamer1.0-tools gstreamer1.0-plugins-good"
"""Debian packages of the program and of all elements."""
PACKET_BYTES: Final = 1400
"""Largest RTP packet, the default of `rtpjpegpay`: it is sent in one IP packet."""

_FD: Final = "{fd}"
"""Placeholder of a file descriptor (`fieldkit.agent.messaging.rtp_stream.FD`)."""
_RTP_FORMAT: Final = "application/x-rtp,media=video,clock-rate=90000,encoding-name=JPEG,payload=26"
_SEND_ELEMENTS: Final = ("fdsrc", "rawvideoparse", "jpegenc", "rtpjpegpay", "udpsink")
_RECEIVE_ELEMENTS: Final = ("udpsrc", "rtpjitterbuffer", "rtpjpegdepay", "jpegdec", "fdsink")
_LIST_MISSING: Final = 'for element; do gst-inspect-1.0 --exists "$element" || echo "$element"; done 2>&1'


def sender(size: str, rate_hz: float, quality: int, address: str, port: int) -> list[str]:
    """Return the command that reads frames in I420 from a file descriptor and sends them.

    Args:
        size: Size of a frame, `640x480`.
        rate_hz: Frames per second.
        quality: Quality of JPEG, 1 to 100.
        address: Address of the receiver.
        port: Its port.
    """
    width, height = dimensions(size)
    rate = Fraction(rate_hz).limit_denominator(1001)  # rates of NTSC are such fractions: 29.97 Hz is 30000/1001
    return _command(
        ("fdsrc", f"fd={_FD}", f"blocksize={width * height * 3 // 2}"),
        (
            "rawvideoparse",
            "format=i420",
            f"width={width}",
            f"height={height}",
            f"framerate={rate.numerator}/{rate.denominator}",
        ),
        ("jpegenc", f"quality={quality}"),
        ("rtpjpegpay", f"mtu={PACKET_BYTES}"),
        # Frames are sent when they are written, not at times of GStreamer's clock.
        ("udpsink", f"host={address}", f"port={port}", "sync=false", "async=false"),
    )


def receiver(address: str, port: int, buffer_s: float) -> list[str]:
    """Return the command that receives frames and writes them to a file descriptor.

    Args:
        address: Address of the receiver.
        port: Its port.
        buffer_s: Delay of the jitter buffer; 0 to show each frame as soon as it is complete.
    """
    jitter_buffer = [("rtpjitterbuffer", f"latency={round(1e3 * buffer_s)}")] if buffer_s else []
    return _command(
        ("udpsrc", f"address={address}", f"port={port}", f"caps={_RTP_FORMAT}"),
        *jitter_buffer,
        ("rtpjpegdepay",),
        ("jpegdec",),
        ("fdsink", f"fd={_FD}", f"sync={'true' if buffer_s else 'false'}"),
    )


def _command(*elements: Sequence[str]) -> list[str]:
    first, *others = elements
    return [PROGRAM, *first, *(word for element in others for word in ("!", *element))]


def need(role: Role, *, sends: bool) -> Need:
    """Return the preflight check that a robot has the elements of its pipeline."""
    return Need(
        role, "GStreamer", ("sh", "-c", _LIST_MISSING, "sh", *(_SEND_ELEMENTS if sends else _RECEIVE_ELEMENTS)), judge
    )


def judge(result: CommandResult) -> tuple[Verdict, str, str]:
    """Return verdict, detail and remedy from the list of missing elements."""
    if "not found" in result.text or result.code == CommandResult.MISSING:
        return Verdict.FAIL, "gst-inspect-1.0 is not installed", f"on the robot: sudo apt-get install {PACKAGES}"
    missing = ", ".join(result.text.split())
    if missing or not result.ok:
        return Verdict.FAIL, f"missing elements: {missing}", f"on the robot: sudo apt-get install {PACKAGES}"
    return Verdict.OK, "all elements are installed", ""
