"""Fuzz targets: the frames of external federates and of coordinators, which are both untrusted."""

from collections.abc import Iterator
from contextlib import suppress
from functools import partial
from pathlib import Path

from sim_backends.federates.frames import HEADER_BYTES, MalformedFrameError, read_header
from tests.fuzz.harness import Target
from tests.helpers.federate_decoders import DECODERS
from tests.helpers.federate_frames import example_frames


def _decode(name: str, data: bytes, _: Path) -> None:
    with suppress(MalformedFrameError):
        if len(data) >= HEADER_BYTES:
            read_header(data)
        DECODERS[name](data[HEADER_BYTES:])


def federate_targets() -> Iterator[Target]:
    """Yield the targets."""
    for name, frame in example_frames().items():
        if name in DECODERS:
            yield Target(f"federate {name}", [frame], partial(_decode, name), weight=0.5)
