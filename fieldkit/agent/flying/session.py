"""A program's session with an autopilot: sends heartbeats, and receives the messages of the autopilot."""

from __future__ import annotations

import selectors
import time
from typing import Callable

from fieldkit.agent.autopilots.autopilot import PILOT, AutopilotState
from fieldkit.agent.autopilots.mavlink_links import open_link

_HEARTBEAT_INTERVAL_S = 1.0


class AutopilotSession:
    """Exchanges messages with an autopilot. The link server reopens a lost connection, and repeats requests.

    Args:
        connection: Name of the connection; see `mavlink_links.open_link`.
        on_state: Called at the end of each `exchange` with the state of the autopilot.
        component: Component id of this program.

    Attributes:
        link: The connection.
        drone: The state of the autopilot.

    Raises:
        OSError: The connection cannot be opened.
        ValueError: The name of the connection is invalid.
    """

    def __init__(
        self, connection: str, on_state: Callable[[AutopilotState], None] = lambda _: None, component: int = PILOT
    ) -> None:
        self._on_state = on_state
        self.link = open_link(connection)
        self.drone = AutopilotState(self.link, component)
        self._selector = selectors.DefaultSelector()
        self._selector.register(self.link.fileno(), selectors.EVENT_READ)
        self._next_heartbeat_s = 0.0

    def exchange(self, duration_s: float) -> None:
        """Send a heartbeat if it is due, and receive messages for this time in seconds.

        With 0 s, it receives at most one packet of the link server, if one has arrived.
        """
        end_s = time.monotonic() + duration_s
        if time.monotonic() > self._next_heartbeat_s:
            self._next_heartbeat_s = time.monotonic() + _HEARTBEAT_INTERVAL_S
            self.drone.commands.send_heartbeat()
        while True:
            remaining_s = end_s - time.monotonic()
            if self._selector.select(max(remaining_s, 0.0)):
                self.drone.receive()
            if remaining_s <= 0:
                break
        self._on_state(self.drone)

    def close(self) -> None:
        """Close the connection, which ends this program's requests for messages."""
        self._selector.close()
        self.link.close()
