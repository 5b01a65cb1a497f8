"""`fieldkit bridge`: carry topics between middlewares until a signal, then tell what was carried."""

import argparse
import ipaddress
import json
import os
import re
import signal
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from itertools import chain
from pathlib import Path
from typing import Final
from urllib.parse import urlsplit

from fieldkit.agent.middleware import Network
from fieldkit.cli import shared_arguments as shared
from fieldkit.cli.display import show_error, show_note, table
from fieldkit.cli.parser import Parser
from fieldkit.core.errors import ConfigurationError
from fieldkit.core.model import BRIDGE_IS_UP, ROS_MASTER_PORT
from fieldkit.core.printing import say
from fieldkit.core.text import json_text
from fieldkit.core.units import format_bytes
from fieldkit.ros import bridge
from fieldkit.ros.bridge import Carrier, Side
from fieldkit.ros.crossings import Crossed, Crossing
from fieldkit.ros.ports import MOST_DOMAIN
from fieldkit.ros.types import Distribution, MessageTypes

MIDDLEWARES: Final = ("ros1", "dds", "zenoh")
"""`agent.middleware.ADAPTERS`, which a test compares, without `ros2`: that needs the Python of a robot's ROS 2."""


def add(parser: Parser) -> None:
    """Declare what `fieldkit bridge` takes."""
    parser.description = (
        "Carry topics from one middleware to another until Ctrl-C or SIGTERM, then report how many messages and how "
        "late. TOPIC is NAME:TYPE, or NAME:TYPE:QOS. QOS is a profile of ROS 2 (default, sensor_data, "
        "services_default, parameters, parameter_events, system_default), or policies (reliable, best_effort, "
        "keep_all, transient_local, depth=N), or a profile and then policies, separated by commas."
    )
    parser.epilog = (
        "example: fieldkit bridge --from ros1 --to dds /scan:sensor_msgs/LaserScan:sensor_data "
        "--back /cmd_vel:geometry_msgs/Twist"
    )
    parser.add_choice("--from", MIDDLEWARES, dest="near", required=True, help=f"one of: {', '.join(MIDDLEWARES)}")
    parser.add_choice("--to", MIDDLEWARES, dest="far", required=True, help="another of them")
    parser.add_argument("topics", metavar="TOPIC", nargs="*", help="goes from the first to the second")
    for option, what in (("--back", "goes the other way"), ("--both", "goes both ways")):
        parser.add_argument(
            option, metavar="TOPIC", action="append", default=[], help=f"{what}; may be given more than once"
        )
    parser.add_argument(
        "--address",
        metavar="IP",
        default="127.0.0.1",
        help="address of this machine where the others are (default: 127.0.0.1)",
    )
    parser.add_argument(
        "--master", metavar="HOST[:PORT]", help="master of ROS 1 (default: ROS_MASTER_URI, or this address and 11311)"
    )
    parser.add_argument(
        "--patience", type=shared.natural, default=3, metavar="S", help="seconds to wait for the master (default: 3)"
    )
    parser.add_argument("--router", metavar="HOST[:PORT]", help="router of Zenoh, port 7447 (default: scouting)")
    parser.add_argument(
        "--peer",
        metavar="IP",
        action="append",
        default=[],
        help="who is asked over DDS or Zenoh in place of multicast; may be given more than once",
    )
    parser.add_argument(
        "--domain", type=shared.natural, metavar="N", help="domain of ROS 2 (default: ROS_DOMAIN_ID, or 0)"
    )
    parser.add_argument(
        "--node",
        metavar="NAME",
        default="fieldkit_bridge",
        help="name of the bridge's node; a second bridge on a master needs another (default: fieldkit_bridge)",
    )
    parser.add_choice(
        "--distribution",
        ("humble", "jazzy"),
        default="jazzy",
        help="distribution of ROS 2 whose types are used, with their hashes (default: jazzy)",
    )
    parser.add_argument(
        "--type",
        metavar="NAME=FILE",
        action="append",
        default=[],
        help="a message type of your own and its .msg file; may be given more than once",
    )
    parser.add_argument(
        "--json",
        action="store_true",
        help="print a list with an object per topic and direction in place of the table",
    )
    parser.set_defaults(run=run)


_LOOKS_S: Final = 1.0
_ROUTER_PORT: Final = 7447
_NODE: Final = re.compile(r"[A-Za-z]\w*", re.ASCII)


def run(arguments: argparse.Namespace) -> int:
    """Carry topics until SIGINT or SIGTERM."""
    crossings = _crossings(arguments)
    types = MessageTypes(Distribution(arguments.distribution), dict(map(_definition, arguments.type)))
    near, far = (Side(over, _network(over, arguments)) for over in (arguments.near, arguments.far))
    with _until_signal() as over, bridge.bridged(near, far, crossings, types) as carriers:
        show_note(f"{BRIDGE_IS_UP}, {arguments.near} to {arguments.far}; Ctrl-C ends it")
        _watch(carriers, over)
        told = [carrier.told() for carrier in carriers]
    if arguments.json:
        say(json_text([asdict(crossed) for crossed in told]))
    else:
        _show(told)
    return 0


def _crossings(arguments: argparse.Namespace) -> list[Crossing]:
    there = [Crossing.parse(text) for text in (*arguments.topics, *arguments.both)]
    back = [Crossing.parse(text, back=True) for text in (*arguments.back, *arguments.both)]
    if not there and not back:
        raise ConfigurationError("no topic is named", remedy="for example /scan:sensor_msgs/LaserScan")
    return there + back


def _definition(text: str) -> tuple[str, str]:
    name, _, path = text.partition("=")
    if "/" not in name or not path:
        raise ConfigurationError(f"{text!r} is no type and its file", remedy="write it as lab_msgs/Radio=Radio.msg")
    try:
        return name, Path(path).read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        why = error.strerror if isinstance(error, OSError) else "it is no UTF-8"
        raise ConfigurationError(f"cannot be read: {why}", where=path, remedy="name a .msg file of ROS") from error


def _network(over: str, arguments: argparse.Namespace) -> Network:
    """Return how the bridge takes part in a middleware."""
    if not _NODE.fullmatch(arguments.node):
        raise ConfigurationError(f"{arguments.node!r} is no name of a node", remedy="letters, digits and underscores")
    common = {"address": _address(arguments.address), "domain": _domain(arguments.domain), "node": arguments.node}
    if over == "ros1":
        uri = os.environ.get("ROS_MASTER_URI", "")
        host, port = _host(arguments.master or urlsplit(uri).netloc or arguments.address, ROS_MASTER_PORT)
        settings = {"patience_s": str(arguments.patience), "tcp_nodelay": "1"}
        return Network(discovery="master", server=host, port=port, settings=settings, **common)
    if over == "zenoh" and arguments.router:
        host, port = _host(arguments.router, _ROUTER_PORT)
        return Network(discovery="router", server=host, port=port, **common)
    peers = tuple(map(_address, arguments.peer))
    # Another Zenoh of this machine may have the usual port.
    own = {"listen/endpoints": json.dumps([f"tcp/{common['address']}:0"])} if over == "zenoh" else {}
    return Network(discovery="peers" if peers else "multicast", peers=peers, settings=own, **common)


def _address(text: str) -> str:
    try:
        return str(ipaddress.IPv4Address(text))
    except ValueError:
        raise ConfigurationError(f"{text!r} is no IPv4 address", remedy="for example 10.42.0.1") from None


def _host(text: str, usual_port: int) -> tuple[str, int]:
    try:
        parts = urlsplit(f"//{text}")
        if parts.hostname and parts.netloc == text:
            return parts.hostname, parts.port or usual_port
    except ValueError:
        pass
    raise ConfigurationError(f"{text!r} is no host and port", remedy=f"write it as 10.42.0.1:{usual_port}")


def _domain(given: int | None) -> int:
    text = os.environ.get("ROS_DOMAIN_ID") or "0"
    number = given if given is not None else int(text) if text.isascii() and text.isdigit() else -1
    if 0 <= number <= MOST_DOMAIN:
        return number
    raise ConfigurationError(
        f"{text if given is None else given} is no domain of ROS 2", remedy=f"0 to {MOST_DOMAIN}"
    )


@contextmanager
def _until_signal() -> Iterator[threading.Event]:
    """Give what SIGINT and SIGTERM set while the body runs."""
    over = threading.Event()
    before = {number: signal.signal(number, lambda *_: over.set()) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield over
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _watch(carriers: Sequence[Carrier], over: threading.Event) -> None:
    """Wait for the end; tell once of each topic that others have with another type."""
    known: set[str] = set()
    while not over.wait(_LOOKS_S):
        for sentence in chain.from_iterable(carrier.other_types() for carrier in carriers):
            if sentence not in known:
                known.add(sentence)
                show_error(f"{sentence}\n  remedy: name the topic with its own type; nothing of the other is carried")


def _show(told: Sequence[Crossed]) -> None:
    head = ("topic", "way", "messages", "a second", "bytes", "refused", "unreadable", "median", "99 %")
    rows = [
        (
            crossed.topic,
            f"{crossed.source} to {crossed.target}",
            str(crossed.messages),
            "" if crossed.per_s is None else f"{crossed.per_s:.4g}",
            format_bytes(crossed.bytes),
            str(crossed.refused),
            str(crossed.unreadable),
            _milliseconds(crossed.delay_median_s),
            _milliseconds(crossed.delay_p99_s),
        )
        for crossed in told
    ]
    table(head, rows, right=range(2, len(head)))


def _milliseconds(delay_s: float | None) -> str:
    return "" if delay_s is None else f"{1e3 * delay_s:.3g} ms"
