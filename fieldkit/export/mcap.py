"""Writer of JSON messages to an MCAP file.

File format: https://mcap.dev/spec. JSON for Foxglove: https://docs.foxglove.dev, custom schema encodings.
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
    """A channel of the file.

    Attributes:
        name: Name of the channel.
        schema: JSON Schema of the messages; its title is the name of the schema.
        clock: Clock of the messages' times.
        meaning: Description of the messages.
    """

    name: str
    schema: Json
    clock: str
    meaning: str


@dataclass(frozen=True, eq=False)
class Message:
    """A message.

    Attributes:
        channel: Channel of the message.
        time_ns: Time of the message by the channel's clock, in nanoseconds since 1970 UTC.
        content: Values of the message, which conform to the channel's schema.
    """

    channel: Channel
    time_ns: int
    content: Json


def write(file: BinaryIO, about: Mapping[str, str], messages: Iterable[Message]) -> None:
    """Write messages in chunks. The same messages give the same bytes.

    Args:
        file: The output file.
        about: Metadata of the file.
        messages: Messages in the order of their times. Differences between their clocks are ignored.

    Raises:
        OSError: The file cannot be written.
    """
    writer = Writer(file, compression=CompressionType.ZSTD)
    writer.start(library=f"fieldkit {__version__}")
    writer.add_metadata("fieldkit", dict(about))
    channels = _Channels(writer)
    for message in messages:
        writer.add_message(
            channel_id=channels.id_of(message.channel),
            log_time=message.time_ns,
            publish_time=message.time_ns,
            data=_encoded(message.content),
        )
    writer.finish()  # type: ignore[no-untyped-call]


class _Channels:
    """The channels of a file by name, and its schemas by title. Each of them is registered once."""

    def __init__(self, writer: Writer) -> None:
        self._writer = writer
        self._channels: dict[str, int] = {}
        self._schemas: dict[str, int] = {}

    def id_of(self, channel: Channel) -> int:
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
