"""The program on a robot: `agent.pyz VERB JSON [LOG]`; the JSON says what to do, and `_USAGE` lists the verbs.

Arguments: the verb, the JSON, and for all but a router, a flight and its checks a log. It says `up` on standard error
when it is, and ends well on SIGINT and SIGTERM.
"""

from __future__ import annotations

import json
import signal
import sys
import threading
import time
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any, Callable, Iterator, Mapping, Sequence

from fieldkit.agent import drive, middleware, records, stream
from fieldkit.agent.middleware import MiddlewareError, Network, Topic
from fieldkit.agent.records import Log, LogError
from fieldkit.agent.stream import Stream

_USAGE = "usage: agent.pyz publish|subscribe|mavlink|drive JSON LOG, or agent.pyz route|fly|arming|survey|link JSON"

Told = Mapping[str, Any]


class EndRequest(threading.Event):
    """Asks the program to end; a signal handler's request is visible before the next statement of the main thread.

    A program that was suspended (SIGSTOP) when the signal came sees it before it sends anything.
    """

    _signalled = False

    def from_signal(self) -> None:
        """Ask from a signal handler."""
        self._signalled = True
        # In a thread of its own: this one may be inside `wait` and have the lock that `set` waits for.
        threading.Thread(target=self.set).start()

    def is_set(self) -> bool:
        """Return whether the program is to end."""
        return self._signalled or super().is_set()


def main(argv: Sequence[str]) -> int:
    """Run a command line; return its exit code."""
    if len(argv) == 3 and argv[0] in _WITH_LOG:
        work = partial(_WITH_LOG[argv[0]], path=argv[2])
    elif len(argv) == 2 and argv[0] in _WITHOUT_LOG:
        work = partial(_WITHOUT_LOG[argv[0]])
    else:
        sys.stderr.write(f"{_USAGE}\n")
        return 2
    over = EndRequest()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: over.from_signal())
    try:
        return work(json.loads(argv[1]), over)
    except (MiddlewareError, LogError) as error:
        sys.stderr.write(f"error: {error}\n")
        return 3


def _route(told: Told, over: threading.Event) -> int:
    """Route for other Zenoh sessions until `over` is set."""
    from fieldkit.agent import zenoh  # noqa: PLC0415 (only where it is asked for)

    router = zenoh.route(Network(**told["network"]))
    _say(f"up, {router.version}")
    while not over.wait(stream.WAKES_S):
        pass
    router.close()
    return 0


def _record(told: Told, over: threading.Event, path: str) -> int:
    """Record MAVLink until `over` is set."""
    from fieldkit.agent import mavlink  # noqa: PLC0415 (only where it is asked for)

    with _talking(told["connection"]):
        try:
            mavlink.record(mavlink.FlightRecording(**told), path, over)
        except mavlink.MissingMessageError as error:
            raise MiddlewareError(str(error)) from error
    return 0


def _drive(told: Told, over: threading.Event, path: str) -> int:
    """Drive a robot along its way; return an exit code, which says whether it came back home."""
    begun = middleware.adapter(told["over"])(Network(**told["network"]))
    try:
        _say(f"up, {begun.version}")
        stopped = drive.drive(begun, told, Path(path), over)
    except OSError as error:
        raise MiddlewareError(f"it stands: {path} cannot be written: {error.strerror}") from error
    finally:
        begun.close()
    if stopped:
        _say(f"stopped: {stopped}")
    return 4 if stopped else 0


def _fly(told: Told, over: threading.Event) -> int:
    """Fly a drone, or watch one that others fly; return the exit code."""
    from fieldkit.agent import flight, flight_plan  # noqa: PLC0415 (only where it is asked for)

    with _talking(told["connection"]):
        return flight.fly(flight_plan.FlightPlan(**told), over)


def _look(told: Told, over: threading.Event) -> int:
    """Say what speaks against a flight; return the exit code."""
    from fieldkit.agent import arming, flight_plan  # noqa: PLC0415 (only where it is asked for)

    with _talking(told["connection"]):
        return arming.look(told["connection"], flight_plan.FlightNeeds(**told["needs"]), over)


def _survey(told: Told, over: threading.Event) -> int:
    """Print whether a connection works, and which others there may be; return the exit code."""
    from fieldkit.agent.links import survey  # noqa: PLC0415 (only where it is asked for)

    with _talking(told["connection"]):
        return survey.survey(told["connection"], over)


def _link(told: Told, over: threading.Event) -> int:
    """Serve a connection to an autopilot for the other programs here, in a process of its own."""
    from fieldkit.agent.links import server  # noqa: PLC0415 (only where it is asked for)

    with _talking(told["connection"]):
        server.serve(told["connection"], over)
    return 0


@contextmanager
def _talking(connection: str) -> Iterator[None]:
    """Say of what goes wrong with a connection to an autopilot which one it was."""
    try:
        yield
    except (OSError, ValueError) as error:
        raise MiddlewareError(f"MAVLink by {connection}: {error}") from error


def _stream(told: Told, over: threading.Event, path: str, *, publishes: bool) -> int:
    """Be one end of a stream."""
    what = Stream(**told["stream"])
    start = middleware.adapter(what.over)
    log = Log(path)
    log.origin(time.time_ns(), records.PUBLISHER if publishes else records.SUBSCRIBER, told["topic"]["name"])
    log.note(records.BEGUN, time.time_ns())
    begun = start(Network(**told["network"]))
    try:
        _say(f"up, {begun.version}")
        work = stream.publish if publishes else stream.subscribe
        work(begun, Topic.from_json(told["topic"]), what, log, over)
    finally:
        begun.close()
    log.end(time.time_ns())
    return 0


def _say(text: str) -> None:
    sys.stderr.write(f"{text}\n")
    sys.stderr.flush()


_WITH_LOG: Mapping[str, Callable[..., int]] = {
    "publish": partial(_stream, publishes=True),
    "subscribe": partial(_stream, publishes=False),
    "mavlink": _record,
    "drive": _drive,
}
_WITHOUT_LOG: Mapping[str, Callable[..., int]] = {
    "route": _route,
    "fly": _fly,
    "arming": _look,
    "survey": _survey,
    "link": _link,
}


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
