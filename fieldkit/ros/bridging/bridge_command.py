"""`fieldkit bridge`: forward topics between middlewares until a signal arrives, then report the counts."""

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

from fieldkit.agent.messaging.middleware import Network
from fieldkit.cli import shared_arguments as shared
from fieldkit.cli.display import print_table, show_error, show_note
from fieldkit.cli.parser import Parser
from fieldkit.core.errors import ConfigurationError
from fieldkit.core.model import BRIDGE_IS_UP, ROS_MASTER_PORT
from fieldkit.core.text import json_text, print_text
from fieldkit.core.units import format_bytes
from fieldkit.ros.bridging import bridge
from fieldkit.ros.bridging.bridge import Forwarder, Side
from fieldkit.ros.bridging.crossings import Crossing, CrossingCounts
from fieldkit.ros.interfaces.types import Distribution, MessageTypes
from fieldkit.ros.middlewares.ports import MAX_DOMAIN

MIDDLEWARES: Final = ("ros1", "dds", "zenoh")
"""The adapters of `agent.messaging.middleware` except `ros2`, which needs the Python of a robot's ROS 2. A test
compares the two lists."""


def add(parser: Parser) -> None:
    """Declare the arguments of `fieldkit bridge`."""
    parser.description = (
        "Forward topics from one middleware to another until Ctrl-C or SIGTERM, then report the number of messages "
        "and their delay. TOPIC is NAME:TYPE, or NAME:TYPE:QOS. QOS is a profile of ROS 2 (default, sensor_data, "
        "services_default, parameters, parameter_events, system_default), or policies (reliable, best_effort, "
        "keep_all, transient_local, depth=N), or a profile and then policies, separated by commas."
    )
    parser.epilog = (
        "example: fieldkit bridge --from ros1 --to dds /scan:sensor_msgs/LaserScan:sensor_data "
        "--back /cmd_vel:geometry_msgs/Twist"
    )
    parser.add_choice("--from", MIDDLEWARES, dest="near", required=True, help=f"one of: {', '.join(MIDDLEWARES)}")
    parser.add_choice("--to", MIDDLEWARES, dest="far", required=True, help="another one of these")
    parser.add_argument("topics", metavar="TOPIC", nargs="*", help="topic from the first middleware to the second")
    for option, text in (("--back", "topic in the other direction"), ("--both", "topic in both directions")):
        parser.add_argument(
            option, metavar="TOPIC", action="append", default=[], help=f"{text}; may be given more than once"
        )
    parser.add_argument(
        "--address",
        metavar="IP",
        default="127.0.0.1",
        help="address of this machine in the network of the other nodes (default: 127.0.0.1)",
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
        help="peer over DDS or Zenoh, contacted instead of multicast discovery; may be given more than once",
    )
    parser.add_argument(
        "--domain", type=shared.natural, metavar="N", help="domain of ROS 2 (default: ROS_DOMAIN_ID, or 0)"
    )
    parser.add_argument(
        "--node",
        metavar="NAME",
        default="fieldkit_bridge",
        help="name of the bridge's node, different for each bridge on the same master (default: fieldkit_bridge)",
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
        help="an additional message type and its .msg file; may be given more than once",
    )
    parser.add_argument(
        "--json",
        action="store_true",
        help="print a list with an object per topic and direction instead of the table",
    )
    parser.set_defaults(run=f"{__name__}:run")


_POLL_S: Final = 1.0
"""Interval at which the bridge checks for nodes that use a topic with another type."""
_ROUTER_PORT: Final = 7447
_NODE: Final = re.compile(r"[A-Za-z]\w*", re.ASCII)


def run(arguments: argparse.Namespace) -> int:
    """Forward topics until SIGINT or SIGTERM."""
    crossings = _crossings(arguments)
    types = MessageTypes(Distribution(arguments.distribution), dict(map(_definition, arguments.type)))
    near, far = (Side(middleware, _network(middleware, arguments)) for middleware in (arguments.near, arguments.far))
    with _until_signal() as stop_event, bridge.bridge_topics(near, far, crossings, types) as forwarders:
        show_note(f"{BRIDGE_IS_UP}, {arguments.near} to {arguments.far}; Ctrl-C stops it")
        _watch(forwarders, stop_event)
        counts = [forwarder.counts() for forwarder in forwarders]
    if arguments.json:
        print_text(json_text([asdict(topic_counts) for topic_counts in counts]))
    else:
        _show(counts)
    return 0


def _crossings(arguments: argparse.Namespace) -> list[Crossing]:
    forward = [Crossing.parse(text) for text in (*arguments.topics, *arguments.both)]
    back = [Crossing.parse(text, back=True) for text in (*arguments.back, *arguments.both)]
    if not forward and not back:
        raise ConfigurationError("no topic is given", remedy="for example /scan:sensor_msgs/LaserScan")
    return forward + back


def _definition(text: str) -> tuple[str, str]:
    name, _, path = text.partition("=")
    if "/" not in name or not path:
        raise ConfigurationError(
            f"{text!r} is not a message type and its file", remedy="write it as lab_msgs/Radio=Radio.msg"
        )
    try:
        return name, Path(path).read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "it is not UTF-8"
        raise ConfigurationError(f"cannot be read: {reason}", where=path, remedy="name a .msg file of ROS") from error


def _network(middleware: str, arguments: argparse.Namespace) -> Network:
    """Return the settings with which the bridge joins a middleware."""
    if not _NODE.fullmatch(arguments.node):
        raise ConfigurationError(
            f"{arguments.node!r} is not a valid node name", remedy="use letters, digits and underscores"
        )
    common = {"address": _address(arguments.address), "domain": _domain(arguments.domain), "node": arguments.node}
    if middleware == "ros1":
        uri = os.environ.get("ROS_MASTER_URI", "")
        host, port = _host(arguments.master or urlsplit(uri).netloc or arguments.address, ROS_MASTER_PORT)
        settings = {"patience_s": str(arguments.patience), "tcp_nodelay": "1"}
        return Network(discovery="master", server=host, port=port, settings=settings, **common)
    if middleware == "zenoh" and arguments.router:
        host, port = _host(arguments.router, _ROUTER_PORT)
        return Network(discovery="router", server=host, port=port, **common)
    peers = tuple(map(_address, arguments.peer))
    # Another Zenoh program of this machine may use the default port.
    settings = {"listen/endpoints": json.dumps([f"tcp/{common['address']}:0"])} if middleware == "zenoh" else {}
    return Network(discovery="peers" if peers else "multicast", peers=peers, settings=settings, **common)


def _address(text: str) -> str:
    try:
        return str(ipaddress.IPv4Address(text))
    except ValueError:
        raise ConfigurationError(f"{text!r} is not an IPv4 address", remedy="for example 10.42.0.1") from None


def _host(text: str, default_port: int) -> tuple[str, int]:
    try:
        parts = urlsplit(f"//{text}")
        if parts.hostname and parts.netloc == text:
            return parts.hostname, parts.port or default_port
    except ValueError:
        pass
    raise ConfigurationError(f"{text!r} is not a host and port", remedy=f"write it as 10.42.0.1:{default_port}")


def _domain(option_value: int | None) -> int:
    text = os.environ.get("ROS_DOMAIN_ID") or "0"
    number = option_value if option_value is not None else int(text) if text.isascii() and text.isdigit() else -1
    if 0 <= number <= MAX_DOMAIN:
        return number
    raise ConfigurationError(
        f"{text if option_value is None else option_value} is not a domain of ROS 2", remedy=f"use 0 to {MAX_DOMAIN}"
    )


@contextmanager
def _until_signal() -> Iterator[threading.Event]:
    """Yield an event that SIGINT and SIGTERM set while the body runs."""
    stop_event = threading.Event()
    previous_handlers = {
        number: signal.signal(number, lambda *_: stop_event.set()) for number in (signal.SIGINT, signal.SIGTERM)
    }
    try:
        yield stop_event
    finally:
        for number, handler in previous_handlers.items():
            signal.signal(number, handler)


def _watch(forwarders: Sequence[Forwarder], stop_event: threading.Event) -> None:
    """Wait for `stop_event`. If other nodes use a topic with another type, report this once."""
    reported: set[str] = set()
    while not stop_event.wait(_POLL_S):
        for message in chain.from_iterable(forwarder.type_conflicts() for forwarder in forwarders):
            if message not in reported:
                reported.add(message)
                show_error(
                    f"{message}\n  remedy: give the topic with the type of its publishers; messages of another type "
                    "are not forwarded"
                )


def _show(counts: Sequence[CrossingCounts]) -> None:
    counters = ("messages", "per second", "bytes", "refused", "unreadable")
    header = ("topic", "direction", *counters, "delay, median", "delay, 99 %")
    rows = [
        (
            topic_counts.topic,
            f"{topic_counts.source} to {topic_counts.target}",
            str(topic_counts.messages),
            "" if topic_counts.per_s is None else f"{topic_counts.per_s:.4g}",
            format_bytes(topic_counts.bytes),
            str(topic_counts.refused),
            str(topic_counts.unreadable),
            _milliseconds(topic_counts.delay_median_s),
            _milliseconds(topic_counts.delay_p99_s),
        )
        for topic_counts in counts
    ]
    print_table(header, rows, right=range(2, len(header)))


def _milliseconds(delay_s: float | None) -> str:
    return "" if delay_s is None else f"{1e3 * delay_s:.3g} ms"
