"""Intervals of messages that several clients request from one autopilot.

An interval belongs to the autopilot's port: it is the same for all programs behind it, and other stations change it.
So the smallest requested one is set, set again when the message is slower or missing, and set to the default when no
client requests it any more (MAV_CMD_SET_MESSAGE_INTERVAL, https://mavlink.io/en/messages/common.html).
"""

from __future__ import annotations

from collections import deque
from typing import Any, Callable, Hashable, Mapping, Tuple

from fieldkit.agent.mavlink_frames import ACCEPTED

DEFAULT = 0
"""Interval that stands for the autopilot's own rate; also the end of a request."""
_OFF = -1
LATER = (1, 5)
"""MAV_RESULT_TEMPORARILY_REJECTED and MAV_RESULT_IN_PROGRESS: it may be accepted later."""
_ANSWERS_S = 0.4
_SHORTEST_S, _LONGEST_S = 0.5, 8.0
"""Bounds of the time between two requests for the same message."""
_ENOUGH = 0.7
"""Share of the requested rate below which it is requested again: 4 Hz of 5 is jitter and loss, 4 Hz of 10 is not."""
_SILENT_INTERVALS = 3
_WINDOW_INTERVALS = 10
_WINDOW_S = 1.0
_RESETS = 3

Target = Tuple[int, int]
"""System and component of an autopilot."""
Key = Tuple[Target, int]


class MessageInterval:
    """One message: which intervals are requested, and how often it came.

    Attributes:
        wanted_us: Interval of each client in microseconds.
        result: MAV_RESULT of the last answer; None before there was one.
        set_us: Interval of the last answered request; None before there was one.
    """

    def __init__(self) -> None:
        self.wanted_us: dict[Hashable, int] = {}
        self.result: int | None = None
        self.set_us: int | None = None
        self.tries = 0
        self.due_s = 0.0
        self.pause_s = _SHORTEST_S
        self._since_s = 0.0
        self._came_s: deque[float] = deque()

    @property
    def interval_us(self) -> int:
        """The interval that serves all clients."""
        positive = [wanted for wanted in self.wanted_us.values() if wanted > 0]
        if positive:
            return min(positive)
        return _OFF if _OFF in self.wanted_us.values() else DEFAULT

    @property
    def denied(self) -> bool:
        """Whether the autopilot does not send the message as requested."""
        return self.result not in (None, ACCEPTED, *LATER)

    def heard(self, now_s: float) -> None:
        """Note that it came."""
        self._came_s.append(now_s)
        self._forget(now_s)

    def hz(self, now_s: float) -> float:
        """Return how often it came of late, messages a second."""
        self._forget(now_s)
        return len(self._came_s) / self._window_s

    @property
    def _window_s(self) -> float:
        return max(_WINDOW_S, _WINDOW_INTERVALS * max(self.interval_us, 0) / 1e6)

    def _forget(self, now_s: float) -> None:
        while self._came_s and self._came_s[0] < now_s - self._window_s:
            self._came_s.popleft()

    def answered(self, interval_us: int, result: int, now_s: float) -> None:
        """Note an answer."""
        self.result, self.set_us, self.tries = result, interval_us, 0
        self._since_s = now_s
        self.due_s = now_s + self.pause_s

    def is_due(self, now_s: float) -> bool:
        """Return whether to request it now."""
        if self.interval_us != self.set_us:
            return self.tries == 0 or now_s >= self.due_s
        if self.denied or self.interval_us <= 0:
            return False
        if self.result in LATER:
            return now_s >= self.due_s
        if not self._is_slow(now_s):
            if now_s > self._since_s + self._window_s:
                self.pause_s = _SHORTEST_S
            return False
        return now_s >= self.due_s

    def _is_slow(self, now_s: float) -> bool:
        interval_s = self.interval_us / 1e6
        last_s = max(self._came_s[-1] if self._came_s else 0.0, self._since_s)
        if now_s - last_s > max(_SILENT_INTERVALS * interval_s, _SHORTEST_S):
            return True
        return now_s - self._since_s > self._window_s and self.hz(now_s) * interval_s < _ENOUGH


class MessageIntervals:
    """The intervals of all messages, requested one after the other: an answer does not name its message.

    Args:
        send: Sends a request to a target: id of a message, interval in microseconds.
    """

    def __init__(self, send: Callable[[Target, int, int], None]) -> None:
        self._send = send
        self._messages: dict[Key, MessageInterval] = {}
        self._open: tuple[Key, int, float] | None = None

    @property
    def settled(self) -> bool:
        """Whether each message has the interval that it should have, or the autopilot denied it."""
        return all(message.interval_us == message.set_us for message in self._messages.values())

    def request(self, client: Hashable, target: Target, kind: int, interval_us: int) -> None:
        """Note the request of a client; `DEFAULT` ends it."""
        key = target, kind
        if interval_us == DEFAULT and key not in self._messages:
            return
        message = self._messages.setdefault(key, MessageInterval())
        if interval_us == DEFAULT:
            message.wanted_us.pop(client, None)
        elif message.wanted_us.get(client) != interval_us:
            message.wanted_us[client] = interval_us
            if message.denied:
                message.set_us = message.result = None
        message.pause_s = _SHORTEST_S

    def leave(self, client: Hashable) -> None:
        """End all requests of a client."""
        for message in self._messages.values():
            message.wanted_us.pop(client, None)

    def reopened(self) -> None:
        """Request everything again: the port may be a new one."""
        self._open = None
        for message in self._messages.values():
            message.set_us, message.tries = None, 0

    def heard(self, source: Target, kind: int, now_s: float) -> None:
        """Note a message of the autopilot."""
        message = self._messages.get((source, kind))
        if message is not None:
            message.heard(now_s)

    def answered(self, source: Target, result: int, now_s: float) -> None:
        """Note an answer to the request that was sent last."""
        if self._open is None or self._open[0][0] != source:
            return
        key, interval_us, _ = self._open
        self._open = None
        message = self._messages.get(key)
        if message is not None:
            message.answered(interval_us, result, now_s)
            self._drop_if_done(key, message)

    def _drop_if_done(self, key: Key, message: MessageInterval) -> None:
        if not message.wanted_us and (message.set_us == DEFAULT or message.tries >= _RESETS):
            del self._messages[key]

    def advance(self, now_s: float) -> None:
        """Send the next request that is due."""
        if self._open is not None:
            key, _, until_s = self._open
            if now_s < until_s:
                return
            self._open = None
            if key in self._messages:
                self._drop_if_done(key, self._messages[key])
        for key, message in self._messages.items():
            if message.is_due(now_s):
                self._request(key, message, now_s)
                return

    def _request(self, key: Key, message: MessageInterval, now_s: float) -> None:
        again = message.interval_us == message.set_us
        message.tries += 1
        if again or message.tries > 1:
            message.pause_s = min(2 * message.pause_s, _LONGEST_S)
        message.due_s = now_s + (message.pause_s if again else _ANSWERS_S)
        self._open = key, message.interval_us, now_s + _ANSWERS_S
        self._send(key[0], key[1], message.interval_us)

    def report(self, client: Hashable, now_s: float) -> Mapping[str, Any]:
        """Return for each message that a client requested: its interval in us, MAV_RESULT, and rate in Hz."""
        return {
            str(kind): {"interval_us": message.interval_us, "result": message.result, "hz": message.hz(now_s)}
            for (_, kind), message in self._messages.items()
            if client in message.wanted_us
        }
