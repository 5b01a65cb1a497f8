"""Messages of JSON in an MCAP file. The only module of fieldkit that writes one.

File format: https://mcap.dev/spec; what Foxglove expects of JSON: https://docs.foxglove.dev, custom schema encodings.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any, BinaryIO, Final

from mcap.writer import CompressionType, Writer

from fieldkit import __version__
from fieldkit.core.text import json_text

Json = Mapping[str, Any]

_MESSAGE_ENCODING: Final = "json"
_SCHEMA_ENCODING: Final = "jsonschema"


@dataclass(frozen=True, eq=False)
class Channel:
    """One channel of the file.

    Attributes:
        name: Its name.
        schema: JSON Schema of its messages, whose title names it.
        clock: Whose clock its times are of.
        meaning: What a message says.
    """

    name: str
    schema: Json
    clock: str
    meaning: str


@dataclass(frozen=True, eq=False)
class Message:
    """One message.

    Attributes:
        channel: Where it goes.
        time_ns: When, nanoseconds since 1970 UTC by the channel's clock.
        content: Its values; they conform to the channel's schema.
    """

    channel: Channel
    time_ns: int
    content: Json


def write(file: BinaryIO, about: Mapping[str, str], messages: Iterable[Message]) -> None:
    """Write messages, chunk by chunk as they come.

    The same messages give the same bytes.

    Args:
        file: Where to.
        about: What the file is of; kept as metadata.
        messages: In the order of their times, as far as their clocks agree.

    Raises:
        OSError: The file cannot be written.
    """
    writer = Writer(file, compression=CompressionType.ZSTD)
    writer.start(library=f"fieldkit {__version__}")
    writer.add_metadata("fieldkit", dict(about))
    channels = _Channels(writer)
    for message in messages:
        writer.add_message(
            channel_id=channels.of(message.channel),
            log_time=message.time_ns,
            publish_time=message.time_ns,
            data=_encoded(message.content),
        )
    writer.finish()  # type: ignore[no-untyped-call]


class _Channels:
    """The channels of a file by name, and its schemas by title, each registered once."""

    def __init__(self, writer: Writer) -> None:
        self._writer = writer
        self._channels: dict[str, int] = {}
        self._schemas: dict[str, int] = {}

    def of(self, channel: Channel) -> int:
        if channel.name not in self._channels:
            self._channels[channel.name] = self._writer.register_channel(
                topic=channel.name,
                message_encoding=_MESSAGE_ENCODING,
                schema_id=self._schema(channel.schema),
                metadata={"clock": channel.clock, "meaning": channel.meaning},
            )
        return self._channels[channel.name]

    def _schema(self, schema: Json) -> int:
        title = schema["title"]
        if title not in self._schemas:
            self._schemas[title] = self._writer.register_schema(title, _SCHEMA_ENCODING, _encoded(schema))
        return self._schemas[title]


def _encoded(value: Json) -> bytes:
    return json_text(value, separators=(",", ":"), allow_nan=False).encode()
