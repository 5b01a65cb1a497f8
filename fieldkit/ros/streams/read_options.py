"""Keys of steps for reads of the newest sample by a program of the receiver, and for sizes of images."""

from typing import Annotated, Final

from fieldkit.config import schema
from fieldkit.config.schema import AfterValidator, Duration, Field, Hertz, Strict

_SIZE_MULTIPLE: Final = 16
_WIDTHS: Final = (128, 2032)
_HEIGHTS: Final = (64, 2032)
"""Limits in pixels. At the lower limits, each of the 16 x 8 cells with the number and time of a frame has 8 x 8
pixels (`fieldkit.agent.video.frame_code`). The upper limit is the largest multiple of 16 for JPEG over RTP (RFC
2435)."""


class Reads(Strict):
    """Reads of the newest sample by the receiver's program: a control loop or a display.

    Attributes:
        rate: Reads per second: the rate of the control loop, or the refresh rate of the display.
        limit: Maximum age: an older sample counts as late, and a longer time without a newer sample counts as a gap.
            For commands to a robot, use the time after which it stops if no new command arrives.
    """

    rate: Annotated[Hertz, Field(gt=0, le=1000)] = 60.0
    limit: Annotated[Duration, Field(gt=0, le=60)] = 0.5


def _validate_size(text: str) -> str:
    for pixels, (least, most) in zip(dimensions(text), (_WIDTHS, _HEIGHTS), strict=True):
        if not least <= pixels <= most or pixels % _SIZE_MULTIPLE:
            raise schema.validation_error(
                f"an image is {_WIDTHS[0]} to {_WIDTHS[1]} pixels wide and {_HEIGHTS[0]} to {_HEIGHTS[1]} high, each "
                f"a multiple of {_SIZE_MULTIPLE}, not {text}"
            )
    return text


ImageSize = Annotated[
    str,
    schema.pattern_field(r"^[0-9]{2,4}x[0-9]{2,4}$", "width x height in pixels, such as 640x480"),
    AfterValidator(_validate_size),
]
"""Width and height in pixels, written as `640x480`."""


def dimensions(size: str) -> tuple[int, int]:
    """Return width and height of an `ImageSize`."""
    width, height = map(int, size.split("x"))
    return width, height
