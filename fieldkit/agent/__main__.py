"""The program on a robot: `agent.pyz VERB JSON [LOG]`.

The verb selects the task (`_USAGE` lists the verbs), the JSON object contains its parameters, and some verbs write a
log file. The programs that publish, subscribe, receive, record, drive or route write `up` to standard error when they
are ready. SIGINT and SIGTERM set an event, and each task then ends in an orderly way.
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

from fieldkit.agent.driving import drive
from fieldkit.agent.messaging import middleware, records, stream
from fieldkit.agent.messaging.middleware import MiddlewareError, Network, Topic
from fieldkit.agent.messaging.records import Log, LogError
from fieldkit.agent.messaging.stream import Stream
from fieldkit.agent.orders import CANCELLED

_USAGE = (
    "usage: agent.pyz publish|subscribe|send-video|receive-video|mavlink|drive JSON LOG, "
    "or agent.pyz route|fly|arming|survey|link|datagrams JSON"
)

Arguments = Mapping[str, Any]


class StopRequest(threading.Event):
    """An event that stops the program.

    After a signal, `is_set` returns True from the next statement of the main thread on. Therefore, a program that was
    suspended (SIGSTOP) when the signal arrived sends nothing after it is resumed.
    """

    _is_signalled = False

    def set_from_signal(self) -> None:
        """Set the event from a signal handler."""
        self._is_signalled = True
        # In a separate thread: the main thread may be inside `wait` and hold the lock that `set` needs.
        threading.Thread(target=self.set).start()

    def is_set(self) -> bool:
        """Return True if the program must stop."""
        return self._is_signalled or super().is_set()


def main(argv: Sequence[str]) -> int:
    """Run a command line and return its exit code."""
    if len(argv) == 3 and argv[0] in _TASKS_WITH_LOG:
        run = partial(_TASKS_WITH_LOG[argv[0]], path=argv[2])
    elif len(argv) == 2 and argv[0] in _TASKS_WITHOUT_LOG:
        run = partial(_TASKS_WITHOUT_LOG[argv[0]])
    else:
        sys.stderr.write(f"{_USAGE}\n")
        return 2
    stop_event = StopRequest()
    for signal_number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(signal_number, lambda *_: stop_event.set_from_signal())
    try:
        return run(json.loads(argv[1]), stop_event)
    except (MiddlewareError, LogError) as error:
        sys.stderr.write(f"error: {error}\n")
        return 3


def _route(arguments: Arguments, stop_event: threading.Event) -> int:
    """Run a Zenoh router until `stop_event` is set."""
    from fieldkit.agent.messaging import zenoh  # noqa: PLC0415 (each subcommand loads only its modules)

    router = zenoh.route(Network(**arguments["network"]))
    _report(f"up, {router.version}")
    while not stop_event.wait(stream.WAIT_S):
        pass
    router.close()
    return 0


def _record(arguments: Arguments, stop_event: threading.Event, path: str) -> int:
    """Record MAVLink messages until `stop_event` is set."""
    from fieldkit.agent.autopilots import mavlink  # noqa: PLC0415 (each subcommand loads only its modules)

    with _add_connection_to_errors(arguments["connection"]):
        try:
            mavlink.record(mavlink.FlightRecording(**arguments), path, stop_event)
        except mavlink.MissingMessageError as error:
            raise MiddlewareError(str(error)) from error
    return 0


def _drive(arguments: Arguments, stop_event: threading.Event, path: str) -> int:
    """Drive a robot along its path; return the exit code.

    It is 0 if the robot is back at its origin, 4 if it stopped earlier, and `CANCELLED` if a signal arrived before it
    started.
    """
    session = middleware.adapter(arguments["over"])(Network(**arguments["network"]))
    try:
        _report(f"up, {session.version}")
        stop_reason = drive.drive(session, arguments, Path(path), stop_event)
    except drive.DriveCancelledError:
        _report("cancelled before the start")
        return CANCELLED
    except OSError as error:
        raise MiddlewareError(f"the robot was stopped, because {path} cannot be written: {error.strerror}") from error
    finally:
        session.close()
    if stop_reason:
        _report(f"stopped: {stop_reason}")
    return 4 if stop_reason else 0


def _fly(arguments: Arguments, stop_event: threading.Event) -> int:
    """Run the pilot, the guard or the rescue program of a flight; return the exit code."""
    from fieldkit.agent.flying import flight, flight_plan  # noqa: PLC0415 (each subcommand loads only its modules)

    with _add_connection_to_errors(arguments["connection"]):
        return flight.fly(flight_plan.FlightPlan(**arguments), stop_event)


def _check_arming(arguments: Arguments, stop_event: threading.Event) -> int:
    """Print the faults that an arming check finds; return the exit code."""
    from fieldkit.agent.flying import arming, flight_plan  # noqa: PLC0415 (each subcommand loads only its modules)

    with _add_connection_to_errors(arguments["connection"]):
        return arming.check_arming(arguments["connection"], flight_plan.FlightNeeds(**arguments["needs"]), stop_event)


def _survey(arguments: Arguments, stop_event: threading.Event) -> int:
    """Test a connection; print the result and other possible connections; return the exit code."""
    from fieldkit.agent.links import survey  # noqa: PLC0415 (each subcommand loads only its modules)

    with _add_connection_to_errors(arguments["connection"]):
        return survey.survey(arguments["connection"], stop_event)


def _link(arguments: Arguments, stop_event: threading.Event) -> int:
    """Start a link server, which shares a connection to an autopilot between the programs on this computer."""
    from fieldkit.agent.links import server  # noqa: PLC0415 (each subcommand loads only its modules)

    with _add_connection_to_errors(arguments["connection"]):
        server.serve(arguments["connection"], stop_event)
    return 0


def _datagrams(arguments: Arguments, stop_event: threading.Event) -> int:
    """Send test datagrams to other robots, or count received ones; return the exit code."""
    from fieldkit.agent import datagrams  # noqa: PLC0415 (each subcommand loads only its modules)

    return datagrams.run(arguments, stop_event)


@contextmanager
def _add_connection_to_errors(connection: str) -> Iterator[None]:
    """Raise errors of the connection to an autopilot as `MiddlewareError`, with the name of the connection."""
    try:
        yield
    except (OSError, ValueError) as error:
        raise MiddlewareError(f"MAVLink over {connection}: {error}") from error


def _stream(arguments: Arguments, stop_event: threading.Event, path: str, *, publishes: bool) -> int:
    """Publish a stream of samples, or subscribe to it."""
    settings = Stream(**arguments["stream"])
    start_middleware = middleware.adapter(settings.over)
    log = Log(path)
    log.write_role(time.time_ns(), records.PUBLISHER if publishes else records.SUBSCRIBER, arguments["topic"]["name"])
    log.note(records.DISCOVERY_STARTED, time.time_ns())
    session = start_middleware(Network(**arguments["network"]))
    try:
        _report(f"up, {session.version}")
        run_stream = stream.publish if publishes else stream.subscribe
        run_stream(session, Topic.from_json(arguments["topic"]), settings, log, stop_event)
    finally:
        session.close()
    log.end(time.time_ns())
    return 0


def _stream_video(arguments: Arguments, stop_event: threading.Event, path: str, *, sends: bool) -> int:
    """Send a video over RTP, or receive it."""
    from fieldkit.agent.messaging import rtp_stream  # noqa: PLC0415 (loaded only if needed)

    log = Log(path)
    log.write_role(time.time_ns(), records.PUBLISHER if sends else records.SUBSCRIBER, rtp_stream.NAME)
    log.note(records.DISCOVERY_STARTED, time.time_ns())
    transfer = rtp_stream.send if sends else rtp_stream.receive
    transfer(rtp_stream.Video(**arguments), log, stop_event)
    log.end(time.time_ns())
    return 0


def _report(text: str) -> None:
    sys.stderr.write(f"{text}\n")
    sys.stderr.flush()


_TASKS_WITH_LOG: Mapping[str, Callable[..., int]] = {
    "publish": partial(_stream, publishes=True),
    "subscribe": partial(_stream, publishes=False),
    "send-video": partial(_stream_video, sends=True),
    "receive-video": partial(_stream_video, sends=False),
    "mavlink": _record,
    "drive": _drive,
}
_TASKS_WITHOUT_LOG: Mapping[str, Callable[..., int]] = {
    "route": _route,
    "fly": _fly,
    "arming": _check_arming,
    "survey": _survey,
    "link": _link,
    "datagrams": _datagrams,
}


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
