"""Delay that a bridge adds to a message: `python -m benchmarks.bridge [--json] [--rounds N]`; needs rosmaster.

Publishers and subscribers are separate programs on loopback. Plain pairs use the binding of each middleware as its
documentation shows; `attached` adds the attachment and the time stamp that rmw_zenoh requires; `agent` uses
fieldkit's adapters of the same library. Each path over `fieldkit bridge` has a plain publisher or subscriber of ROS
1, and the plain pair of ROS 1 is its reference. The paths are measured in sequence. Each first carries messages at a
fixed rate, to measure the delay, and then as many messages as possible for one second. Each message starts with the
time of its creation on the machine's clock.
"""

import argparse
import itertools
import json
import os
import random
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any, Final

from fieldkit.agent.messaging import middleware
from fieldkit.agent.messaging.middleware import Network, Topic
from fieldkit.agent.messaging.stream import HEAD, MAGIC
from fieldkit.ros.interfaces import topics
from fieldkit.ros.interfaces.qos import PROFILES
from fieldkit.ros.interfaces.types import standard_types

HOST: Final = "127.0.0.1"
DOMAIN: Final = 61
TYPE: Final = "std_msgs/msg/UInt8MultiArray"
SIZE: Final = 1000
COUNT: Final = 200
"""Messages in a measurement of the delay, sent at `RATE_HZ`."""
RATE_HZ: Final = 100.0
BURST_S: Final = 1.0
SETTLING_S: Final = 1.0  # for discovery, and for the last messages of a stream
_CDR: Final = bytes((0, 1, 0, 0)) + bytes(8) + SIZE.to_bytes(4, "little")
"""Bytes of a serialized message before its data: encapsulation header, empty layout, number of data bytes."""

Write = Callable[[bytes], Any]
"""Function of a publisher that sends data. The function of a subscriber sends nothing, and only keeps the objects of
the middleware alive."""
Deliver = Callable[[bytes], None]
"""Function of a subscriber that is called with the data of each message, or with its first `HEAD.size` bytes."""


@dataclass(frozen=True)
class MessagePath:
    """A path of messages: a publisher, a subscriber, and optionally a bridge between them.

    Attributes:
        name: Name in the output.
        publisher: Kind of the publisher.
        subscriber: Kind of the subscriber.
        reference: Name of the path with which this path is compared; empty if there is none.
    """

    name: str
    publisher: str
    subscriber: str
    reference: str = ""


PATHS: Final = (
    MessagePath("dds plain", "dds plain", "dds plain"),
    MessagePath("dds agent", "dds agent", "dds agent", "dds plain"),
    MessagePath("zenoh plain", "zenoh plain", "zenoh plain"),
    MessagePath("zenoh attached", "zenoh attached", "zenoh attached", "zenoh plain"),
    MessagePath("zenoh agent", "zenoh agent", "zenoh agent", "zenoh plain"),
    MessagePath("ros1 plain", "ros1 plain", "ros1 plain"),
    MessagePath("ros1 bridged to dds", "ros1 plain", "dds agent", "ros1 plain"),
    MessagePath("ros1 bridged to zenoh", "ros1 plain", "zenoh agent", "ros1 plain"),
    MessagePath("dds bridged to ros1", "dds agent", "ros1 plain", "ros1 plain"),
    MessagePath("zenoh bridged to ros1", "zenoh agent", "ros1 plain", "ros1 plain"),
)


def dds_plain(name: str, deliver: Deliver | None) -> Write:
    """Start a publisher, or a subscriber if `deliver` is given, with the binding of CycloneDDS and a plain type."""
    from cyclonedds.domain import Domain, DomainParticipant  # noqa: PLC0415
    from cyclonedds.idl import make_idl_struct, types  # noqa: PLC0415
    from cyclonedds.pub import DataWriter  # noqa: PLC0415
    from cyclonedds.qos import Policy, Qos  # noqa: PLC0415
    from cyclonedds.sub import DataReader  # noqa: PLC0415
    from cyclonedds.topic import Topic as DdsTopic  # noqa: PLC0415
    from cyclonedds.util import duration  # noqa: PLC0415

    from fieldkit.agent.messaging import dds  # noqa: PLC0415

    kind = make_idl_struct("Plain", "Plain", {"data": types.sequence[types.uint8]})
    domain = Domain(DOMAIN, dds.configuration(Network(HOST, discovery="peers", peers=(HOST,))))
    participant = DomainParticipant(DOMAIN)
    topic = DdsTopic(participant, name.strip("/"), kind)
    qos = Qos(Policy.Reliability.Reliable(10**9), Policy.History.KeepLast(10))
    if deliver is None:
        writer = DataWriter(participant, topic, qos=qos)
        return lambda data: (domain, writer.write(kind(data=data)))
    reader = DataReader(participant, topic, qos=qos)

    def read() -> None:
        while True:
            for sample in reader.take_iter(timeout=duration(seconds=1)):
                deliver(bytes(sample.data[: HEAD.size]))

    threading.Thread(target=read, daemon=True).start()
    return lambda _: domain


def zenoh_plain(name: str, deliver: Deliver | None, endpoint_spec: str, *, attached: bool) -> Write:
    """Start a publisher or subscriber with the binding of Zenoh.

    `attached` adds the attachment and the time stamp of rmw_zenoh.
    """
    import zenoh  # noqa: PLC0415

    from fieldkit.agent.messaging.zenoh import ATTACHMENT, GID_BYTES  # noqa: PLC0415

    config = zenoh.Config()
    config.insert_json5("scouting/multicast/enabled", "false")
    config.insert_json5(*endpoint(endpoint_spec))
    config.insert_json5("timestamping/enabled", json.dumps(attached))
    session = zenoh.open(config)
    if deliver is None:
        publisher, numbers, gid = session.declare_publisher(name.strip("/")), itertools.count(), bytes(GID_BYTES)
        if not attached:
            return lambda data: (session, publisher.put(data))

        def put(data: bytes) -> object:
            packed = ATTACHMENT.pack(next(numbers), time.time_ns(), GID_BYTES, gid)
            return session, publisher.put(data, attachment=packed)

        return put
    subscriber = session.declare_subscriber(name.strip("/"), lambda sample: deliver(sample.payload.to_bytes()))
    return lambda _: (session, subscriber)


def ros1_plain(name: str, deliver: Deliver | None) -> Write:
    """Start a publisher or subscriber with rospy."""
    sys.path.append("/usr/lib/python3/dist-packages")  # the packages of Debian's Python
    import rospy  # noqa: PLC0415
    from std_msgs.msg import UInt8MultiArray  # noqa: PLC0415

    rospy.init_node("end", anonymous=True, disable_signals=True)
    if deliver is None:
        publisher = rospy.Publisher(name, UInt8MultiArray, queue_size=10, tcp_nodelay=True)
        return lambda data: publisher.publish(UInt8MultiArray(data=data))
    subscriber = rospy.Subscriber(
        name, UInt8MultiArray, lambda message: deliver(message.data), queue_size=10, tcp_nodelay=True
    )
    return lambda _: subscriber


def endpoint(endpoint_spec: str) -> tuple[str, str]:
    """Return the name and value of Zenoh's setting for `listen:PORT` or `connect:PORT`."""
    verb, _, port = endpoint_spec.partition(":")
    return f"{verb}/endpoints", json.dumps([f"tcp/{HOST}:{port}"])


def agent(middleware_name: str, name: str, deliver: Deliver | None, endpoint_spec: str) -> Write:
    """Start a publisher or subscriber with fieldkit's adapter."""
    settings = dict([endpoint(endpoint_spec)]) if middleware_name == "zenoh" else {}
    running = middleware.adapter(middleware_name)(
        Network(HOST, discovery="peers", peers=(HOST,), domain=DOMAIN, settings=settings)
    )
    topic = Topic.from_json(
        topics.describe(standard_types(), name, TYPE, PROFILES["default"], domain=DOMAIN, node="end")
    )
    if deliver is None:
        publisher = running.publisher(topic)
        return lambda data: (running, publisher.write(_CDR + data))
    running.subscribe(topic, lambda data, _: deliver(data[len(_CDR) :]))
    return lambda _: running


def run_end(kind: str, name: str, endpoint_spec: str, *, is_subscriber: bool) -> int:
    """Run a publisher or subscriber, controlled by the lines of standard input.

    After a line `SECONDS RATE` a publisher sends, and prints the number of messages. After any line a subscriber
    prints arrival time and delay, in ns, of each message since the last line.
    """
    arrivals: list[tuple[int, int]] = []

    def deliver(data: bytes) -> None:
        at_ns = time.time_ns()
        arrivals.append((at_ns, at_ns - HEAD.unpack_from(data)[2]))

    middleware_name, binding = kind.split()
    callback = deliver if is_subscriber else None
    if binding == "agent":
        write = agent(middleware_name, name, callback, endpoint_spec)
    elif middleware_name == "zenoh":
        write = zenoh_plain(name, callback, endpoint_spec, attached=binding == "attached")
    else:
        write = {"dds": dds_plain, "ros1": ros1_plain}[middleware_name](name, callback)
    print("up", flush=True)
    for line in sys.stdin:
        if is_subscriber:
            print(json.dumps(arrivals), flush=True)
            arrivals.clear()
        else:
            print(_send(write, *map(float, line.split())), flush=True)
    os._exit(0)  # threads of the middleware may block a normal exit


def _send(write: Write, duration_s: float, rate_hz: float) -> int:
    """Send for `duration_s`, at a rate or, if it is 0, as fast as possible; return the number of messages."""
    padding = random.Random(1).randbytes(SIZE - HEAD.size)
    started_s, number = time.monotonic(), 0
    while (now_s := time.monotonic() - started_s) < duration_s:
        if rate_hz and (wait_s := number / rate_hz - now_s) > 0:
            time.sleep(wait_s)
        write(HEAD.pack(MAGIC, number, time.time_ns()) + padding)
        number += 1
    return number


class RunningPath:
    """A path whose publisher and subscriber are running."""

    def __init__(self, stack: ExitStack, message_path: MessagePath, environment: dict[str, str]) -> None:
        self.message_path, port = message_path, free_port()
        name = "/" + message_path.name.replace(" ", "_")
        source, target = message_path.publisher.split()[0], message_path.subscriber.split()[0]

        def start(verb: str, mode: str = "listen") -> "subprocess.Popen[str]":
            kind = message_path.subscriber if verb == "subscribe" else message_path.publisher
            return stack.enter_context(_program(("--end", kind, name, f"{mode}:{port}", verb), environment))

        if source == target:
            self.subscriber, self.publisher = start("subscribe"), start("publish", "connect")
            return
        # The program that does not use ROS 1 starts first, because the bridge connects to it.
        verbs = ("subscribe", "publish") if source == "ros1" else ("publish", "subscribe")
        other = target if source == "ros1" else source
        to = ("--router", f"{HOST}:{port}") if other == "zenoh" else ("--peer", HOST)
        line = ("bridge", "--from", source, "--to", target, f"{name}:{TYPE}", "--domain", str(DOMAIN), *to)
        ends = {verbs[0]: start(verbs[0])}
        stack.enter_context(_bridge((*line, "--node", f"bridge_{source}_{target}"), environment))
        ends[verbs[1]] = start(verbs[1])
        self.subscriber, self.publisher = ends["subscribe"], ends["publish"]

    def run(self, duration_s: float, rate_hz: float) -> tuple[int, list[tuple[int, int]]]:
        """Send; return the number of messages, and the arrival time and delay of each received one in ns."""
        sent_count = int(_query(self.publisher, f"{duration_s} {rate_hz}"))
        time.sleep(SETTLING_S)
        return sent_count, json.loads(_query(self.subscriber, "report"))


def _query(process: "subprocess.Popen[str]", line: str) -> str:
    assert process.stdin is not None
    assert process.stdout is not None
    process.stdin.write(f"{line}\n")
    process.stdin.flush()
    return process.stdout.readline()


@contextmanager
def _program(words: Sequence[str], environment: dict[str, str]) -> Iterator["subprocess.Popen[str]"]:
    """Run a publisher or subscriber while the body runs."""
    argv = (sys.executable, "-m", "benchmarks.bridge", *words)
    pipe = subprocess.PIPE
    with subprocess.Popen(argv, stdin=pipe, stdout=pipe, text=True, env=environment) as process:
        assert process.stdout is not None
        if process.stdout.readline() != "up\n":
            raise RuntimeError(f"{words} did not start")
        try:
            yield process
        finally:
            process.kill()


@contextmanager
def _bridge(words: Sequence[str], environment: dict[str, str]) -> Iterator[None]:
    """Run `fieldkit bridge` while the body runs."""
    argv = (sys.executable, "-m", "fieldkit", *words)
    with subprocess.Popen(argv, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, env=environment) as process:
        assert process.stderr is not None
        if not (first_line := process.stderr.readline()).startswith(b"note: the bridge is up"):
            raise RuntimeError(f"{first_line!r}")
        try:
            yield
        finally:
            process.send_signal(signal.SIGINT)
            process.communicate()


def free_port() -> int:
    """Return an unused port of loopback."""
    with socket.socket() as probe:
        probe.bind((HOST, 0))
        return int(probe.getsockname()[1])


def measure(rounds: int) -> list[dict[str, Any]]:
    """Run all paths in sequence in each round; return the measurements of each path."""
    measurements: list[dict[str, Any]] = []
    with ExitStack() as stack:
        folder = stack.enter_context(tempfile.TemporaryDirectory())
        port = free_port()
        environment = os.environ | {"ROS_MASTER_URI": f"http://{HOST}:{port}", "ROS_IP": HOST, "ROS_HOME": folder}
        log = stack.enter_context(Path(folder, "master").open("wb"))
        master = stack.enter_context(
            subprocess.Popen(("rosmaster", "--core", "-p", str(port)), stdout=log, stderr=log, env=environment)
        )
        stack.callback(master.terminate)
        paths = [RunningPath(stack, message_path, environment) for message_path in PATHS]
        for path in paths:
            path.run(SETTLING_S, RATE_HZ)  # in this time publisher and subscriber discover each other
        for number in range(rounds):
            for path in paths if number % 2 else reversed(paths):
                sent_count, arrivals = path.run(COUNT / RATE_HZ, RATE_HZ)
                burst_count, burst_arrivals = path.run(BURST_S, 0)
                burst_s = (burst_arrivals[-1][0] - burst_arrivals[0][0]) / 1e9
                measurements.append(
                    {
                        "round": number,
                        "path": path.message_path.name,
                        "sent": sent_count,
                        "received": len(arrivals),
                        "delay_ms": median(delay_ns for _, delay_ns in arrivals) / 1e6,
                        "burst_sent": burst_count,
                        "burst_received": len(burst_arrivals),
                        "per_s": (len(burst_arrivals) - 1) / burst_s,
                    }
                )
    return measurements


def main() -> int:
    """Measure; print a line per path, or the results as JSON. With `--end`, run a publisher or subscriber."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", action="store_true", help="print single values as JSON")
    parser.add_argument("--rounds", type=int, default=5, help="measurements of each path")
    parser.add_argument("--end", nargs=4, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.end:
        kind, name, endpoint_spec, verb = options.end
        return run_end(kind, name, endpoint_spec, is_subscriber=verb == "subscribe")
    measurements = measure(options.rounds)
    if options.json:
        print(json.dumps(measurements))
        return 0
    print(f"{'path':22} {'delay, ms':>24} {'above the reference, ms':>32} {'messages/s':>26} {'burst arrived':>14}")
    references = {(row["path"], row["round"]): row["delay_ms"] for row in measurements}
    for message_path in PATHS:
        rows = [row for row in measurements if row["path"] == message_path.name]
        delays = [row["delay_ms"] for row in rows]
        differences_ms = (
            [row["delay_ms"] - references[message_path.reference, row["round"]] for row in rows]
            if message_path.reference
            else []
        )
        received = sum(row["burst_received"] for row in rows) / sum(row["burst_sent"] for row in rows)
        rates = [row["per_s"] for row in rows]
        cells = f"{spread(delays):>24} {spread(differences_ms):>32} {spread(rates):>26} {received:>14.0%}"
        print(f"{message_path.name:22} {cells}")
    return 0


def spread(values: Sequence[float]) -> str:
    """Return the median, followed by the smallest and the largest value; empty without values."""
    return f"{_figure(median(values))} ({_figure(min(values))} to {_figure(max(values))})" if values else ""


def _figure(value: float) -> str:
    return f"{value:.3f}" if abs(value) < 100 else f"{value:.0f}"


if __name__ == "__main__":
    sys.exit(main())
