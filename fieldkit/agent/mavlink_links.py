"""Ways to an autopilot, shared by all programs of fieldkit on its computer (see `fieldkit.agent.links`)."""

from __future__ import annotations

from typing import Iterator, Mapping, Protocol

from fieldkit.agent.links import devices
from fieldkit.agent.links.client import MessageRate, SharedLink


class FlightLink(Protocol):
    """A way to an autopilot."""

    @property
    def messages(self) -> Mapping[int, MessageRate]:
        """Messages that were requested, by their ids."""

    def fileno(self) -> int:
        """Return the descriptor to wait for; it stays the same."""

    def receive(self) -> Iterator[bytes]:
        """Yield the frames that have arrived; bytes that are in none are left out."""

    def send(self, frame: bytes) -> None:
        """Send a frame, if that is possible now.

        A request for the interval of a message goes to the link server, which weighs those of all programs.
        """

    def close(self) -> None:
        """End it, and all requests for messages."""


def opened(connection: str) -> SharedLink:
    """Return a way to an autopilot, which survives the loss of its connection: the link server opens it again.

    Raises:
        OSError: It cannot be opened.
        ValueError: It is not the name of a connection.
    """
    devices.check(connection)
    link = SharedLink(connection)
    try:
        link.open()
    except BaseException:
        link.close()
        raise
    return link
