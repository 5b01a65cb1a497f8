"""The conversation of a program with an autopilot: heartbeats, and what the autopilot sends."""

from __future__ import annotations

import selectors
import time
from typing import Callable

from fieldkit.agent.autopilot import PILOT, AutopilotState
from fieldkit.agent.mavlink_links import opened

_BEAT_S = 1.0


class AutopilotTalk:
    """Exchanges messages with an autopilot. The link server opens a lost connection again, and repeats requests.

    Args:
        connection: Where the autopilot is, as `mavlink_links.opened` takes it.
        look: Called at the end of each turn, with the state of the autopilot.
        component: Component id of this program.

    Attributes:
        link: The connection.
        drone: The state of the autopilot.

    Raises:
        OSError: The connection cannot be opened.
        ValueError: It is not a connection.
    """

    def __init__(
        self, connection: str, look: Callable[[AutopilotState], None] = lambda _: None, component: int = PILOT
    ) -> None:
        self._look = look
        self.link = opened(connection)
        self.drone = AutopilotState(self.link, component)
        self._waiting = selectors.DefaultSelector()
        self._waiting.register(self.link.fileno(), selectors.EVENT_READ)
        self._beat_s = 0.0

    def turn(self, lasts_s: float) -> None:
        """Receive and send for this time; in seconds."""
        end_s = time.monotonic() + lasts_s
        if time.monotonic() > self._beat_s:
            self._beat_s = time.monotonic() + _BEAT_S
            self.drone.beat()
        while (left_s := end_s - time.monotonic()) > 0:
            if self._waiting.select(left_s):
                self.drone.receive()
        self._look(self.drone)

    def close(self) -> None:
        """Close the connection, which ends the requests for messages of this program."""
        self._waiting.close()
        self.link.close()
