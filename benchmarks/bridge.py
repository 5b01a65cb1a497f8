"""What a bridge adds to a message: `python -m benchmarks.bridge [--json] [--rounds N]`, needs no root, but rosmaster.

Publishers and subscribers are programs of their own on loopback. Plain pairs use each middleware's binding as its
documentation does; `attached` is that with the attachment and the time stamp which samples of rmw_zenoh must have;
`agent` are fieldkit's adapters of the same library; a way by `fieldkit bridge` begins or ends at a plain
end of ROS 1, whose pair is its yardstick. All take turns in the same run: messages at a rate for their delay,
then as many as go for one second. A message has the time at which it was made in front, by the machine's clock.
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

from fieldkit.agent import middleware
from fieldkit.agent.middleware import Network, Topic
from fieldkit.agent.stream import HEAD, MAGIC
from fieldkit.ros import topics
from fieldkit.ros.qos import PROFILES
from fieldkit.ros.types import shipped

HOST: Final = "127.0.0.1"
DOMAIN: Final = 61
TYPE: Final = "std_msgs/msg/UInt8MultiArray"
SIZE: Final = 1000
COUNT: Final = 200
RATE_HZ: Final = 100.0
BURST_S: Final = 1.0
SETTLES_S: Final = 1.0
_CDR: Final = bytes((0, 1, 0, 0)) + bytes(8) + SIZE.to_bytes(4, "little")

Write = Callable[[bytes], Any]
"""Sends; what it returns only keeps alive what it names."""
Deliver = Callable[[bytes], None]


@dataclass(frozen=True)
class Way:
    """A publisher, a subscriber, and what may be between.

    Attributes:
        name: As it is printed.
        publisher: Kind of the one end.
        subscriber: Kind of the other.
        beside: The way that is its yardstick.
    """

    name: str
    publisher: str
    subscriber: str
    beside: str = ""


WAYS: Final = (
    Way("dds plain", "dds plain", "dds plain"),
    Way("dds agent", "dds agent", "dds agent", "dds plain"),
    Way("zenoh plain", "zenoh plain", "zenoh plain"),
    Way("zenoh attached", "zenoh attached", "zenoh attached", "zenoh plain"),
    Way("zenoh agent", "zenoh agent", "zenoh agent", "zenoh plain"),
    Way("ros1 plain", "ros1 plain", "ros1 plain"),
    Way("ros1 bridged to dds", "ros1 plain", "dds agent", "ros1 plain"),
    Way("ros1 bridged to zenoh", "ros1 plain", "zenoh agent", "ros1 plain"),
    Way("dds bridged to ros1", "dds agent", "ros1 plain", "ros1 plain"),
    Way("zenoh bridged to ros1", "zenoh agent", "ros1 plain", "ros1 plain"),
)


def dds_plain(name: str, deliver: Deliver | None) -> Write:
    """Begin an end of a topic by CycloneDDS' binding, with a type of its own."""
    from cyclonedds.domain import Domain, DomainParticipant  # noqa: PLC0415
    from cyclonedds.idl import make_idl_struct, types  # noqa: PLC0415
    from cyclonedds.pub import DataWriter  # noqa: PLC0415
    from cyclonedds.qos import Policy, Qos  # noqa: PLC0415
    from cyclonedds.sub import DataReader  # noqa: PLC0415
    from cyclonedds.topic import Topic as DdsTopic  # noqa: PLC0415
    from cyclonedds.util import duration  # noqa: PLC0415

    from fieldkit.agent import dds  # noqa: PLC0415

    kind = make_idl_struct("Plain", "Plain", {"data": types.sequence[types.uint8]})
    domain = Domain(DOMAIN, dds.configuration(Network(HOST, discovery="peers", peers=(HOST,))))
    participant = DomainParticipant(DOMAIN)
    topic = DdsTopic(participant, name.strip("/"), kind)
    qos = Qos(Policy.Reliability.Reliable(10**9), Policy.History.KeepLast(10))
    if deliver is None:
        writer = DataWriter(participant, topic, qos=qos)
        return lambda data: (domain, writer.write(kind(data=data)))
    reader = DataReader(participant, topic, qos=qos)

    def take() -> None:
        while True:
            for sample in reader.take_iter(timeout=duration(seconds=1)):
                deliver(bytes(sample.data[: HEAD.size]))

    threading.Thread(target=take, daemon=True).start()
    return lambda _: domain


def zenoh_plain(name: str, deliver: Deliver | None, where: str, *, attached: bool) -> Write:
    """Begin an end of a topic by Zenoh's binding, with the attachment and the time stamp of rmw_zenoh or not."""
    import zenoh  # noqa: PLC0415

    from fieldkit.agent.zenoh import ATTACHMENT, GID_BYTES  # noqa: PLC0415

    config = zenoh.Config()
    config.insert_json5("scouting/multicast/enabled", "false")
    config.insert_json5(*endpoint(where))
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
    """Begin an end of a topic by rospy."""
    sys.path.append("/usr/lib/python3/dist-packages")  # Debian's
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


def endpoint(where: str) -> tuple[str, str]:
    """Return a setting of Zenoh for `listen:PORT` or `connect:PORT`."""
    verb, _, port = where.partition(":")
    return f"{verb}/endpoints", json.dumps([f"tcp/{HOST}:{port}"])


def agent(over: str, name: str, deliver: Deliver | None, where: str) -> Write:
    """Begin an end of a topic by fieldkit's adapter."""
    settings = dict([endpoint(where)]) if over == "zenoh" else {}
    running = middleware.adapter(over)(
        Network(HOST, discovery="peers", peers=(HOST,), domain=DOMAIN, settings=settings)
    )
    topic = Topic.from_json(topics.describe(shipped(), name, TYPE, PROFILES["default"], domain=DOMAIN, node="end"))
    if deliver is None:
        publisher = running.publisher(topic)
        return lambda data: (running, publisher.write(_CDR + data))
    running.subscribe(topic, lambda data, _: deliver(data[len(_CDR) :]))
    return lambda _: running


def end(kind: str, name: str, where: str, *, hears: bool) -> int:
    """Be an end: a line `COUNT RATE` has it send, any line has it print what came."""
    came: list[tuple[int, int]] = []

    def deliver(data: bytes) -> None:
        at_ns = time.time_ns()
        came.append((at_ns, at_ns - HEAD.unpack_from(data)[2]))

    over, how = kind.split()
    told = deliver if hears else None
    if how == "agent":
        write = agent(over, name, told, where)
    elif over == "zenoh":
        write = zenoh_plain(name, told, where, attached=how == "attached")
    else:
        write = {"dds": dds_plain, "ros1": ros1_plain}[over](name, told)
    print("up", flush=True)
    for line in sys.stdin:
        if hears:
            print(json.dumps(came), flush=True)
            came.clear()
        else:
            print(_send(write, *map(float, line.split())), flush=True)
    os._exit(0)  # threads of the middleware may wait


def _send(write: Write, lasts_s: float, rate_hz: float) -> int:
    """Send for so long, at a rate or, where that is 0, one after the other; return how many."""
    filling = random.Random(1).randbytes(SIZE - HEAD.size)
    begun_s, number = time.monotonic(), 0
    while (now_s := time.monotonic() - begun_s) < lasts_s:
        if rate_hz and (early_s := number / rate_hz - now_s) > 0:
            time.sleep(early_s)
        write(HEAD.pack(MAGIC, number, time.time_ns()) + filling)
        number += 1
    return number


class Running:
    """A way whose ends are up."""

    def __init__(self, stack: ExitStack, way: Way, environment: dict[str, str]) -> None:
        self.way, port = way, free_port()
        name = "/" + way.name.replace(" ", "_")
        source, target = way.publisher.split()[0], way.subscriber.split()[0]

        def begun(verb: str, place: str = "listen") -> "subprocess.Popen[str]":
            kind = way.subscriber if verb == "hear" else way.publisher
            return stack.enter_context(_program(("--end", kind, name, f"{place}:{port}", verb), environment))

        if source == target:
            self.hears, self.says = begun("hear"), begun("say", "connect")
            return
        # First the end that is not of ROS 1: to that the bridge connects.
        verbs = ("hear", "say") if source == "ros1" else ("say", "hear")
        over = target if source == "ros1" else source
        to = ("--router", f"{HOST}:{port}") if over == "zenoh" else ("--peer", HOST)
        line = ("bridge", "--from", source, "--to", target, f"{name}:{TYPE}", "--domain", str(DOMAIN), *to)
        ends = {verbs[0]: begun(verbs[0])}
        stack.enter_context(_bridge((*line, "--node", f"bridge_{source}_{target}"), environment))
        ends[verbs[1]] = begun(verbs[1])
        self.hears, self.says = ends["hear"], ends["say"]

    def run(self, lasts_s: float, rate_hz: float) -> tuple[int, list[tuple[int, int]]]:
        """Send; return how many, and when each arrived and how late, in ns."""
        sent = int(_ask(self.says, f"{lasts_s} {rate_hz}"))
        time.sleep(SETTLES_S)
        return sent, json.loads(_ask(self.hears, "report"))


def _ask(process: "subprocess.Popen[str]", line: str) -> str:
    assert process.stdin is not None
    assert process.stdout is not None
    process.stdin.write(f"{line}\n")
    process.stdin.flush()
    return process.stdout.readline()


@contextmanager
def _program(words: Sequence[str], environment: dict[str, str]) -> Iterator["subprocess.Popen[str]"]:
    """Run an end while the body runs."""
    argv = (sys.executable, "-m", "benchmarks.bridge", *words)
    pipe = subprocess.PIPE
    with subprocess.Popen(argv, stdin=pipe, stdout=pipe, text=True, env=environment) as process:
        assert process.stdout is not None
        if process.stdout.readline() != "up\n":
            raise RuntimeError(f"{words} does not start")
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
        if not (said := process.stderr.readline()).startswith(b"note: the bridge is up"):
            raise RuntimeError(f"{said!r}")
        try:
            yield
        finally:
            process.send_signal(signal.SIGINT)
            process.communicate()


def free_port() -> int:
    """Return a port of loopback that nobody had."""
    with socket.socket() as one:
        one.bind((HOST, 0))
        return int(one.getsockname()[1])


def measure(rounds: int) -> list[dict[str, Any]]:
    """Run all ways in turn, round by round; return what each measured in each."""
    found: list[dict[str, Any]] = []
    with ExitStack() as stack:
        folder = stack.enter_context(tempfile.TemporaryDirectory())
        port = free_port()
        environment = os.environ | {"ROS_MASTER_URI": f"http://{HOST}:{port}", "ROS_IP": HOST, "ROS_HOME": folder}
        log = stack.enter_context(Path(folder, "master").open("wb"))
        master = stack.enter_context(
            subprocess.Popen(("rosmaster", "--core", "-p", str(port)), stdout=log, stderr=log, env=environment)
        )
        stack.callback(master.terminate)
        ways = [Running(stack, way, environment) for way in WAYS]
        for one in ways:
            one.run(SETTLES_S, RATE_HZ)  # until the ends know each other
        for number in range(rounds):
            for one in ways if number % 2 else reversed(ways):
                sent, came = one.run(COUNT / RATE_HZ, RATE_HZ)
                burst, arrived = one.run(BURST_S, 0)
                lasted_s = (arrived[-1][0] - arrived[0][0]) / 1e9
                found.append(
                    {
                        "round": number,
                        "way": one.way.name,
                        "sent": sent,
                        "came": len(came),
                        "delay_ms": median(delay_ns for _, delay_ns in came) / 1e6,
                        "burst_sent": burst,
                        "burst_came": len(arrived),
                        "per_s": (len(arrived) - 1) / lasted_s,
                    }
                )
    return found


def main() -> int:
    """Print a line per way."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", action="store_true", help="single values")
    parser.add_argument("--rounds", type=int, default=5, help="how often each way is measured")
    parser.add_argument("--end", nargs=4, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.end:
        kind, name, where, verb = options.end
        return end(kind, name, where, hears=verb == "hear")
    found = measure(options.rounds)
    if options.json:
        print(json.dumps(found))
        return 0
    print(f"{'way':22} {'delay, ms':>24} {'of it more than the yardstick':>32} {'messages/s':>26} {'of a burst':>10}")
    yardsticks = {(one["way"], one["round"]): one["delay_ms"] for one in found}
    for way in WAYS:
        rows = [one for one in found if one["way"] == way.name]
        delays = [one["delay_ms"] for one in rows]
        more = [one["delay_ms"] - yardsticks[way.beside, one["round"]] for one in rows] if way.beside else []
        came = sum(one["burst_came"] for one in rows) / sum(one["burst_sent"] for one in rows)
        rates = [one["per_s"] for one in rows]
        print(f"{way.name:22} {spread(delays):>24} {spread(more):>32} {spread(rates):>26} {came:>10.0%}")
    return 0


def spread(values: Sequence[float]) -> str:
    """Return the median and, behind it, the smallest and the largest."""
    return f"{_figure(median(values))} ({_figure(min(values))} to {_figure(max(values))})" if values else ""


def _figure(value: float) -> str:
    return f"{value:.3f}" if abs(value) < 100 else f"{value:.0f}"


if __name__ == "__main__":
    sys.exit(main())
