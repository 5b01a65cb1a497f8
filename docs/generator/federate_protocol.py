"""The page of the rules and layouts of the protocol of external federates, from the code of the protocol."""

import inspect
from typing import Final

from docs.generator.federate_frames import example_frames
from docs.generator.markdown import page, relative, table
from fieldkit.config.documentation import attribute_meanings
from sim_backends.federates import exchanges, frames
from sim_backends.federates.frames import MessageKind
from sim_backends.federates.handshake import FederateCapability
from sim_backends.federates.records import LAYOUTS
from sim_backends.federates.transports import datagrams, samples
from sim_backends.federates.transports.datagrams import DatagramHeader, DatagramKind, pack_datagram

_NUMBERS: Final = (
    "Numbers are little endian, without padding: `i64` signed, `u32` unsigned, `f64` an IEEE 754 double; `text` is a "
    "`u16` with the number of bytes, then UTF-8. A list is a number of items, then the items: `commands` u32, each a "
    "command. A frame has a header of 16 bytes: `size` u32 (bytes after it), "
    "`kind` u16, `reserved` u16 (0), `request` u32 (its number), `copy` u32 (the copy of the federate that the "
    "request is for; 0 is the original). The answer repeats `request` and `copy`, also to `fork`."
)


def federate_protocol() -> str:
    """Return the page."""
    return page(
        "Rules and layouts of the federate protocol",
        f"Version {frames.VERSION} of the [protocol](../federates.md#protocol) of external federates. "
        "[Test vectors](federate-vectors.md) has an example of each frame in hexadecimal.",
        _NUMBERS,
        "## Rules",
        relative(_without_title(exchanges.__doc__)),
        "## Messages",
        table(("kind", "message", "from", "body"), map(_message, MessageKind)),
        "## Parts of messages",
        table(("part", "layout"), LAYOUTS.items()),
        "## Capabilities",
        table(("bit", "capability", "meaning"), map(_capability, FederateCapability)),
        "## Limits",
        f"{frames.MAX_AGENTS:,} agents; {frames.MAX_TEXT_BYTES:,} bytes in a text; {_mib(frames.MAX_HELLO_BYTES)} in "
        f"hello, {_mib(frames.MAX_FRAME_BYTES)} in any frame.",
        "## UDP",
        _without_title(datagrams.__doc__),
        f"Example: the ping of the test vectors as data 5, with `connection` {_CONNECTION:#x} and `cookie` "
        f"{_COOKIE:#x}, which expects 4:",
        f"```text\n{_example_datagram().hex()}\n```",
        "## DDS and ROS 1",
        _without_title(samples.__doc__),
    )


def _message(kind: MessageKind) -> tuple[str, str, str, str]:
    sender, _, body = attribute_meanings(MessageKind)[kind.name].partition(": ")
    return str(int(kind)), kind.name.lower().replace("_", " "), sender, body


def _capability(capability: FederateCapability) -> tuple[str, str, str]:
    name = str(capability.name)
    return str(int(capability)), name.lower().replace("_", " "), attribute_meanings(FederateCapability)[name]


def _mib(size_bytes: int) -> str:
    return f"{size_bytes >> 20} MiB"


def _without_title(docstring: str | None) -> str:
    return inspect.cleandoc(docstring or "").partition("\n\n")[2]


_CONNECTION: Final = 0x1122334455667788
_COOKIE: Final = 0xA1B2C3D4E5F60718


def _example_datagram() -> bytes:
    header = DatagramHeader(DatagramKind.DATA, _CONNECTION, _COOKIE, 5, 4)
    return pack_datagram(header, example_frames()["ping"])
