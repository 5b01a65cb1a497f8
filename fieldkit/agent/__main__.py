"""The program on a robot: `agent.pyz publish|subscribe|mavlink|drive|route|fly|arming`, told what to do as JSON.

Arguments: the verb, the JSON, and for all but a router, a flight and its checks a log. It says `up` on standard error
when it is, and ends well on SIGINT and SIGTERM.
"""

from __future__ import annotations

import json
import signal
import sys
import threading
import time
from pathlib import Path
from typing import Any, Mapping, Sequence

from fieldkit.agent import drive, middleware, records, stream
from fieldkit.agent.middleware import MiddlewareError, Network, Topic
from fieldkit.agent.records import Log, LogError
from fieldkit.agent.stream import Stream

_ENDS = {"publish": stream.publish, "subscribe": stream.subscribe}
_USAGE = "usage: agent.pyz publish|subscribe|mavlink|drive JSON LOG, or agent.pyz route|fly|arming JSON"


def main(argv: Sequence[str]) -> int:
    """Run a command line; return its exit code."""
    words = {**dict.fromkeys((*_ENDS, "mavlink", "drive"), 3), "route": 2, "fly": 2, "arming": 2}
    if not argv or words.get(argv[0]) != len(argv):
        sys.stderr.write(f"{_USAGE}\n")
        return 2
    over = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        # In a thread of its own: this one may be inside `over.wait` and have the lock that `set` waits for.
        signal.signal(number, lambda *_: threading.Thread(target=over.set).start())
    try:
        told = json.loads(argv[1])
        if argv[0] == "route":
            _route(Network(**told["network"]), over)
        elif argv[0] == "fly":
            return _fly(told, over)
        elif argv[0] == "arming":
            return _look(told, over)
        elif argv[0] == "mavlink":
            _record(told, argv[2], over)
        elif argv[0] == "drive":
            return _drive(told, argv[2], over)
        else:
            _stream(argv[0], told, argv[2], over)
    except (MiddlewareError, LogError) as error:
        sys.stderr.write(f"error: {error}\n")
        return 3
    return 0


def _route(network: Network, over: threading.Event) -> None:
    """Route for other Zenoh sessions until `over` is set."""
    from fieldkit.agent import zenoh  # noqa: PLC0415 (only where it is asked for)

    router = zenoh.route(network)
    _say(f"up, {router.version}")
    while not over.wait(stream.WAKES_S):
        pass
    router.close()


def _record(told: Mapping[str, Any], path: str, over: threading.Event) -> None:
    """Record MAVLink until `over` is set."""
    from fieldkit.agent import mavlink  # noqa: PLC0415 (only where it is asked for)

    try:
        mavlink.record(mavlink.FlightRecording(**told), path, over)
    except (OSError, ValueError) as error:
        raise MiddlewareError(f"MAVLink by {told['connection']}: {error}") from error


def _drive(told: Mapping[str, Any], path: str, over: threading.Event) -> int:
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


def _fly(told: Mapping[str, Any], over: threading.Event) -> int:
    """Fly a drone, or watch one that others fly; return the exit code."""
    from fieldkit.agent import flight, flight_plan  # noqa: PLC0415 (only where it is asked for)

    try:
        return flight.fly(flight_plan.FlightPlan(**told), over)
    except (OSError, ValueError) as error:
        raise MiddlewareError(f"MAVLink by {told['connection']}: {error}") from error


def _look(told: Mapping[str, Any], over: threading.Event) -> int:
    """Say what speaks against a flight; return the exit code."""
    from fieldkit.agent import arming, flight_plan  # noqa: PLC0415 (only where it is asked for)

    try:
        return arming.look(told["connection"], flight_plan.FlightNeeds(**told["needs"]), over)
    except (OSError, ValueError) as error:
        raise MiddlewareError(f"MAVLink by {told['connection']}: {error}") from error


def _stream(verb: str, told: Mapping[str, Any], path: str, over: threading.Event) -> None:
    """Be one end of a stream."""
    what = Stream(**told["stream"])
    start = middleware.adapter(what.over)
    log = Log(path)
    log.note(records.BEGUN, time.time_ns())
    begun = start(Network(**told["network"]))
    try:
        _say(f"up, {begun.version}")
        _ENDS[verb](begun, Topic.from_json(told["topic"]), what, log, over)
    finally:
        begun.close()
    log.end(time.time_ns())


def _say(text: str) -> None:
    sys.stderr.write(f"{text}\n")
    sys.stderr.flush()


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
