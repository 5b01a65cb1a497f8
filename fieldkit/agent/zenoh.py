"""Zenoh by Eclipse's binding, which its package calls `eclipse-zenoh`, as rmw_zenoh uses it. Its only importer.

docs/design.md of github.com/ros2/rmw_zenoh: the key expression has the type's name and hash, each sample an
attachment, each node and endpoint a liveliness token. What the key expressions are, the laptop says
(`fieldkit.ros.names`).
"""

from __future__ import annotations

import hashlib
import json
import struct
import time
from typing import Any, Callable

import zenoh
import zenoh.ext

from fieldkit.agent.middleware import Deliver, MiddlewareError, Network, Topic, version_of

PORT = 7447
"""Zenoh's own."""

GID_BYTES = 16
ATTACHMENT = struct.Struct(f"<qqB{GID_BYTES}s")
"""Sequence number, time in nanoseconds since 1970 UTC, and identifier of the publisher, as zenoh::ext::Serializer
writes them: integers little-endian, bytes behind their number (attachment_helpers.cpp, from rmw_zenoh 0.6 on)."""


def start(network: Network) -> ZenohMiddleware:
    """Open a session; see `middleware.start`."""
    return ZenohMiddleware(network, "client" if network.discovery == "router" else "peer")


def route(network: Network) -> ZenohMiddleware:
    """Open a session that routes for others."""
    return ZenohMiddleware(network, "router")


def configuration(network: Network, mode: str) -> dict[str, Any]:
    """Return Zenoh's configuration by paths: one address, and how others are found."""
    port = network.port or PORT
    to = {"peers": network.peers, "router": (network.server,)}.get(network.discovery, ())
    found: dict[str, Any] = {
        "mode": mode,
        "scouting/multicast/enabled": network.discovery == "multicast",
        "scouting/multicast/interface": network.address,
        "listen/endpoints": [f"{network.transport}/{network.address}:{port}"],
        "timestamping/enabled": True,
    }
    if mode == "client":
        del found["listen/endpoints"]
    if mode != "router":
        found["connect/endpoints"] = [f"{network.transport}/{address}:{port}" for address in to]
        # The other end may not be up yet.
        found["connect/timeout_ms"] = -1
        found["connect/exit_on_failure"] = False
    return {**found, **{path: _value(text) for path, text in network.settings.items()}}


def _value(text: str) -> Any:  # noqa: ANN401 (of JSON)
    try:
        return json.loads(text)
    except ValueError:
        return text


def gid(token: str) -> bytes:
    """Return an identifier of a publisher, made of its token.

    rmw_zenoh takes XXH3 of it, which no standard library has; nobody compares the two, only who sent with who sent
    before.
    """
    return hashlib.md5(token.encode()).digest()  # noqa: S324 (no secret)


class ZenohMiddleware:
    """A session.

    Args:
        network: How this robot takes part.
        mode: `peer`, `client` or `router`.
    """

    def __init__(self, network: Network, mode: str) -> None:
        self.version = version_of("eclipse-zenoh")
        config = zenoh.Config()
        try:
            for path, value in configuration(network, mode).items():
                config.insert_json5(path, json.dumps(value))
            self._session: Any = zenoh.open(config)
        except zenoh.ZError as error:
            raise MiddlewareError(f"Zenoh does not start: {error}") from error
        self._declared: list[Any] = []

    def publisher(self, topic: Topic) -> ZenohPublisher:
        """See `Middleware.publisher`."""
        quality = topic.quality
        reliable = quality.reliability != "best_effort"
        blocks = reliable and quality.history == "keep_all"
        options: Any = {
            "reliability": zenoh.Reliability.RELIABLE if reliable else zenoh.Reliability.BEST_EFFORT,
            "congestion_control": zenoh.CongestionControl.BLOCK if blocks else zenoh.CongestionControl.DROP,
        }
        if quality.durability == "transient_local":
            cache = zenoh.ext.CacheConfig(max_samples=quality.depth or 1)
            made: Any = zenoh.ext.declare_advanced_publisher(
                self._session, topic.key, cache=cache, publisher_detection=True, **options
            )
            # An advanced publisher does not report whether a subscription matches it; a plain one with its key does.
            matching: Any = self._session.declare_publisher(topic.key, **options)
        else:
            made = matching = self._session.declare_publisher(topic.key, **options)
        return ZenohPublisher(made, matching, gid(self._tell(topic, "publisher")))

    def subscribe(self, topic: Topic, deliver: Deliver) -> Callable[[], int]:
        """See `Middleware.subscribe`."""

        def take(sample: Any) -> None:  # noqa: ANN401 (untyped)
            at_ns = time.time_ns()
            deliver(sample.payload.to_bytes(), at_ns)

        origin = zenoh.Locality.REMOTE
        if topic.quality.durability == "transient_local":
            history = zenoh.ext.HistoryConfig(detect_late_publishers=True)
            made: Any = zenoh.ext.declare_advanced_subscriber(
                self._session, topic.key, take, history=history, allowed_origin=origin
            )
        else:
            made = self._session.declare_subscriber(topic.key, take, allowed_origin=origin)
        self._declared.append(made)
        self._tell(topic, "subscription")
        return lambda: -1

    def other_types(self, topic: Topic) -> set[str]:
        """See `Middleware.other_types`: by liveliness tokens, whose last parts are topic, type, hash and quality."""
        domain, kind, rihs01 = topic.key.split("/")[0], *topic.key.split("/")[-2:]
        ends = f"@ros2_lv/{domain}/**/{topic.name.replace('/', '%')}/*/*/*"
        found = (
            str(reply.ok.key_expr).split("/")[-3:-1] for reply in self._session.liveliness().get(ends) if reply.ok
        )
        return {name for name, other in found if (name, other) != (kind, rihs01)}

    def _tell(self, topic: Topic, end: str) -> str:
        """Declare the tokens of an end of a topic; return the last, which is its own."""
        token = topic.key
        for template in topic.tokens.get(end, ()):
            token = template.replace("{zid}", str(self._session.zid()))
            self._declared.append(self._session.liveliness().declare_token(token))
        return token

    def close(self) -> None:
        """See `Middleware.close`."""
        self._declared.clear()
        self._session.close()


class ZenohPublisher:
    """A publisher whose samples have attachments."""

    def __init__(self, publisher: Any, matching: Any, identifier: bytes) -> None:  # noqa: ANN401 (untyped)
        self._publisher = publisher
        self._matching = matching
        self._gid = identifier
        self._sequence = 0

    def write(self, data: bytes) -> bool:
        """See `Publisher.write`."""
        self._sequence += 1
        attachment = ATTACHMENT.pack(self._sequence, time.time_ns(), GID_BYTES, self._gid)
        self._publisher.put(data, attachment=attachment)
        return True

    def matched(self) -> int:
        """See `Publisher.matched`."""
        return int(self._matching.matching_status.matching)

    def drain(self, limit_s: float) -> None:
        """See `Publisher.drain`: Zenoh tells nobody."""
