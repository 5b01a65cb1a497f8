"""Connections to an autopilot, shared by all programs of fieldkit on a computer (see `fieldkit.agent.links`)."""

from __future__ import annotations

from typing import Iterator, Mapping, Protocol

from fieldkit.agent.links import devices
from fieldkit.agent.links.client import MessageRate, SharedLink


class FlightLink(Protocol):
    """A connection to an autopilot."""

    @property
    def messages(self) -> Mapping[int, MessageRate]:
        """State of this program's requests for messages, by message id."""

    def fileno(self) -> int:
        """Return a file descriptor that is readable when frames have arrived. A reconnection does not change it."""

    def receive(self) -> Iterator[bytes]:
        """Yield frames that have arrived; bytes outside of frames are ignored."""

    def send(self, frame: bytes) -> None:
        """Send a frame; it is dropped if the connection is closed or busy.

        A request for the interval of a message goes to the link server, which combines the requests of all programs.
        """

    def close(self) -> None:
        """Close the connection, and end all requests for messages."""


def open_link(connection: str) -> SharedLink:
    """Open a shared connection to an autopilot. The link server reopens a lost connection.

    Raises:
        OSError: The connection cannot be opened.
        ValueError: The name of the connection is invalid.
    """
    devices.check(connection)
    link = SharedLink(connection)
    try:
        link.open()
    except BaseException:
        link.close()
        raise
    return link
