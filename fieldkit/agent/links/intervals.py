"""Message intervals that several clients request from one autopilot.

An interval applies to a port of the autopilot: all programs on that port share it, and ground stations may change it.
The link server sets the smallest requested interval. It sets the interval again if the rate of the message is too
low. It resets the interval to the default when no client requests the message any longer
(MAV_CMD_SET_MESSAGE_INTERVAL, https://mavlink.io/en/messages/common.html).
"""

from __future__ import annotations

from collections import deque
from typing import Any, Callable, Hashable, Mapping, Tuple

from fieldkit.agent.autopilots.mavlink_frames import ACCEPTED

DEFAULT = 0
"""Interval that selects the default rate of the autopilot; it also cancels a request."""
_OFF = -1
"""Interval that disables a message."""
RETRY_RESULTS = (1, 5)
"""MAV_RESULT_TEMPORARILY_REJECTED and MAV_RESULT_IN_PROGRESS: the request may be accepted later."""
_ANSWER_TIMEOUT_S = 0.4
_MIN_PAUSE_S, _MAX_PAUSE_S = 0.5, 8.0
"""Bounds of the time between two requests for the same interval of a message that the autopilot has answered."""
_MIN_FRACTION = 0.7
"""A message with less than this fraction of the requested rate is requested again: 4 Hz instead of 5 Hz may be jitter
or loss, but 4 Hz instead of 10 Hz is not."""
_SILENT_INTERVALS = 3
"""A message that does not arrive for this number of its intervals, and for `_MIN_PAUSE_S`, is requested again."""
_WINDOW_INTERVALS = 10
_WINDOW_S = 1.0
"""The rate of a message is measured in a window of `_WINDOW_INTERVALS` intervals, but at least `_WINDOW_S`."""
_MAX_RESETS = 3
"""Maximum number of requests that reset a message to its default rate if the autopilot does not answer."""

Target = Tuple[int, int]
"""System and component of an autopilot."""
Key = Tuple[Target, int]
"""Target of a request, and message id."""


class MessageInterval:
    """The requested intervals and the measured rate of one message.

    Attributes:
        requested_us: Requested interval of each client in microseconds.
        result: MAV_RESULT of the last answer; None before the first one.
        set_us: Interval of the last answered request; None if the request must be sent again in any case: before the
            first answer, after the connection was reopened, and after a new request for a refused message.
        tries: Number of requests since the last answer.
        due_s: Time of the next request.
        pause_s: Time until a request for the same interval is repeated.
    """

    def __init__(self) -> None:
        self.requested_us: dict[Hashable, int] = {}
        self.result: int | None = None
        self.set_us: int | None = None
        self.tries = 0
        self.due_s = 0.0
        self.pause_s = _MIN_PAUSE_S
        self._answered_s = 0.0
        self._arrivals_s: deque[float] = deque()

    @property
    def interval_us(self) -> int:
        """The interval for all clients: the smallest positive interval that a client requests.

        If no client requests a positive interval, it is `_OFF` if a client requests this, otherwise `DEFAULT`.
        """
        positive_us = [interval_us for interval_us in self.requested_us.values() if interval_us > 0]
        if positive_us:
            return min(positive_us)
        return _OFF if _OFF in self.requested_us.values() else DEFAULT

    @property
    def is_refused(self) -> bool:
        """Whether the autopilot refuses the request."""
        return self.result not in (None, ACCEPTED, *RETRY_RESULTS)

    def on_message(self, now_s: float) -> None:
        """Register an arrival of the message."""
        self._arrivals_s.append(now_s)
        self._drop_old_arrivals(now_s)

    def hz(self, now_s: float) -> float:
        """Return the recent rate in messages per second."""
        self._drop_old_arrivals(now_s)
        return len(self._arrivals_s) / self._window_s

    @property
    def _window_s(self) -> float:
        return max(_WINDOW_S, _WINDOW_INTERVALS * max(self.interval_us, 0) / 1e6)

    def _drop_old_arrivals(self, now_s: float) -> None:
        while self._arrivals_s and self._arrivals_s[0] < now_s - self._window_s:
            self._arrivals_s.popleft()

    def on_answer(self, interval_us: int, result: int, now_s: float) -> None:
        """Process the answer to a request."""
        self.result, self.set_us, self.tries = result, interval_us, 0
        self._answered_s = now_s
        self.due_s = now_s + self.pause_s

    def is_due(self, now_s: float) -> bool:
        """Return True if the interval must be requested now."""
        if self.interval_us != self.set_us:
            return self.tries == 0 or now_s >= self.due_s
        if self.is_refused or self.interval_us <= 0:
            return False
        if self.result in RETRY_RESULTS:
            return now_s >= self.due_s
        if not self._is_slow(now_s):
            if now_s > self._answered_s + self._window_s:
                self.pause_s = _MIN_PAUSE_S
            return False
        return now_s >= self.due_s

    def _is_slow(self, now_s: float) -> bool:
        interval_s = self.interval_us / 1e6
        last_s = max(self._arrivals_s[-1] if self._arrivals_s else 0.0, self._answered_s)
        if now_s - last_s > max(_SILENT_INTERVALS * interval_s, _MIN_PAUSE_S):
            return True
        return now_s - self._answered_s > self._window_s and self.hz(now_s) * interval_s < _MIN_FRACTION


class MessageIntervals:
    """The intervals of all messages. They are requested in sequence, because an answer contains no message id.

    Args:
        send: Sends a request to a target, with message id and interval in microseconds.
    """

    def __init__(self, send: Callable[[Target, int, int], None]) -> None:
        self._send = send
        self._messages: dict[Key, MessageInterval] = {}
        self._pending: tuple[Key, int, float] | None = None

    @property
    def settled(self) -> bool:
        """Whether the autopilot has answered a request for the current interval of each message."""
        return all(message.interval_us == message.set_us for message in self._messages.values())

    def request(self, client: Hashable, target: Target, kind: int, interval_us: int) -> None:
        """Register the request of a client; the interval `DEFAULT` cancels a request."""
        key = target, kind
        if interval_us == DEFAULT and key not in self._messages:
            return
        message = self._messages.setdefault(key, MessageInterval())
        if interval_us == DEFAULT:
            message.requested_us.pop(client, None)
        elif message.requested_us.get(client) != interval_us:
            message.requested_us[client] = interval_us
            if message.is_refused:
                message.set_us = message.result = None
        message.pause_s = _MIN_PAUSE_S

    def remove_client(self, client: Hashable) -> None:
        """Remove all requests of a client."""
        for message in self._messages.values():
            message.requested_us.pop(client, None)

    def on_reopened(self) -> None:
        """Repeat all requests after the connection was reopened, because it may use another port of the autopilot."""
        self._pending = None
        for message in self._messages.values():
            message.set_us, message.tries = None, 0

    def on_message(self, source: Target, kind: int, now_s: float) -> None:
        """Register a message of the autopilot."""
        message = self._messages.get((source, kind))
        if message is not None:
            message.on_message(now_s)

    def on_answer(self, source: Target, result: int, now_s: float) -> None:
        """Process an answer to the last sent request."""
        if self._pending is None or self._pending[0][0] != source:
            return
        key, interval_us, _ = self._pending
        self._pending = None
        message = self._messages.get(key)
        if message is not None:
            message.on_answer(interval_us, result, now_s)
            self._drop_if_done(key, message)

    def _drop_if_done(self, key: Key, message: MessageInterval) -> None:
        if not message.requested_us and (message.set_us == DEFAULT or message.tries >= _MAX_RESETS):
            del self._messages[key]

    def advance(self, now_s: float) -> None:
        """Send the next request that is due, unless the answer to the previous one may still arrive."""
        if self._pending is not None:
            key, _, timeout_s = self._pending
            if now_s < timeout_s:
                return
            self._pending = None
            if key in self._messages:
                self._drop_if_done(key, self._messages[key])
        for key, message in self._messages.items():
            if message.is_due(now_s):
                self._request(key, message, now_s)
                return

    def _request(self, key: Key, message: MessageInterval, now_s: float) -> None:
        is_repeat = message.interval_us == message.set_us
        message.tries += 1
        if is_repeat or message.tries > 1:
            message.pause_s = min(2 * message.pause_s, _MAX_PAUSE_S)
        message.due_s = now_s + (message.pause_s if is_repeat else _ANSWER_TIMEOUT_S)
        self._pending = key, message.interval_us, now_s + _ANSWER_TIMEOUT_S
        self._send(key[0], key[1], message.interval_us)

    def report(self, client: Hashable, now_s: float) -> Mapping[str, Any]:
        """Return interval in us, MAV_RESULT and rate in Hz of each message that a client requested, by message id."""
        return {
            str(kind): {"interval_us": message.interval_us, "result": message.result, "hz": message.hz(now_s)}
            for (_, kind), message in self._messages.items()
            if client in message.requested_us
        }
