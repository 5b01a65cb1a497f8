"""Zenoh with the binding of the package `eclipse-zenoh`, compatible with rmw_zenoh. Only this module imports it.

According to docs/design.md of github.com/ros2/rmw_zenoh, a key expression contains the type's name and hash, each
sample has an attachment, and each node and endpoint has a liveliness token. The laptop computes the key expressions
(`fieldkit.ros.interfaces.names`).
"""

from __future__ import annotations

import hashlib
import json
import struct
import time
from typing import Any, Callable

import zenoh
import zenoh.ext

from fieldkit.agent.messaging.middleware import Deliver, MiddlewareError, Network, Topic, version_of

PORT = 7447
"""Default port of Zenoh."""

GID_BYTES = 16
ATTACHMENT = struct.Struct(f"<qqB{GID_BYTES}s")
"""Sequence number, time in nanoseconds since 1970 UTC, and identifier of the publisher, in the format of
zenoh::ext::Serializer: little-endian integers, and the length of the identifier before its bytes
(attachment_helpers.cpp, rmw_zenoh >= 0.6)."""


def start(network: Network) -> ZenohMiddleware:
    """Open a session; raises `MiddlewareError` if Zenoh does not start."""
    return ZenohMiddleware(network, "client" if network.discovery == "router" else "peer")


def route(network: Network) -> ZenohMiddleware:
    """Open a session that is the router of other sessions; raises `MiddlewareError` if Zenoh does not start."""
    return ZenohMiddleware(network, "router")


def configuration(network: Network, mode: str) -> dict[str, Any]:
    """Return the configuration of Zenoh by path: the addresses, discovery, and the settings of the network."""
    port = network.port or PORT
    addresses = {"peers": network.peers, "router": (network.server,)}.get(network.discovery, ())
    config: dict[str, Any] = {
        "mode": mode,
        "scouting/multicast/enabled": network.discovery == "multicast",
        "scouting/multicast/interface": network.address,
        "listen/endpoints": [f"{network.transport}/{network.address}:{port}"],
        "timestamping/enabled": True,
    }
    if mode == "client":
        del config["listen/endpoints"]
    if mode != "router":
        config["connect/endpoints"] = [f"{network.transport}/{address}:{port}" for address in addresses]
        # The other robot may not be ready yet.
        config["connect/timeout_ms"] = -1
        config["connect/exit_on_failure"] = False
    return {**config, **{path: _parse_setting(text) for path, text in network.settings.items()}}


def _parse_setting(text: str) -> Any:  # noqa: ANN401 (any JSON value)
    try:
        return json.loads(text)
    except ValueError:
        return text


def gid(token: str) -> bytes:
    """Return the identifier of a publisher, a hash of its token.

    rmw_zenoh uses XXH3, which the standard library lacks. Receivers use the identifier only to distinguish
    publishers, so another hash is compatible.
    """
    return hashlib.md5(token.encode()).digest()  # noqa: S324 (not used for security)


class ZenohMiddleware:
    """A Zenoh session.

    Args:
        network: The network settings.
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
        self._declarations: list[Any] = []

    def publisher(self, topic: Topic) -> ZenohPublisher:
        """Create a publisher of a topic."""
        quality = topic.quality
        is_reliable = quality.reliability != "best_effort"
        is_blocking = is_reliable and quality.history == "keep_all"
        options: Any = {
            "reliability": zenoh.Reliability.RELIABLE if is_reliable else zenoh.Reliability.BEST_EFFORT,
            "congestion_control": zenoh.CongestionControl.BLOCK if is_blocking else zenoh.CongestionControl.DROP,
        }
        if quality.durability == "transient_local":
            cache = zenoh.ext.CacheConfig(max_samples=quality.depth or 1)
            endpoint: Any = zenoh.ext.declare_advanced_publisher(
                self._session, topic.key, cache=cache, publisher_detection=True, **options
            )
            # Only a plain publisher reports whether a subscription matches; an advanced publisher does not.
            matching: Any = self._session.declare_publisher(topic.key, **options)
        else:
            endpoint = matching = self._session.declare_publisher(topic.key, **options)
        return ZenohPublisher(endpoint, matching, gid(self._declare_tokens(topic, "publisher")))

    def subscribe(self, topic: Topic, deliver: Deliver) -> Callable[[], int]:
        """Subscribe to a topic; return a function that returns -1, because Zenoh does not count publishers."""

        def on_sample(sample: Any) -> None:  # noqa: ANN401 (Zenoh declares no types)
            at_ns = time.time_ns()
            deliver(sample.payload.to_bytes(), at_ns)

        origin = zenoh.Locality.REMOTE
        if topic.quality.durability == "transient_local":
            history = zenoh.ext.HistoryConfig(detect_late_publishers=True)
            endpoint: Any = zenoh.ext.declare_advanced_subscriber(
                self._session, topic.key, on_sample, history=history, allowed_origin=origin
            )
        else:
            endpoint = self._session.declare_subscriber(topic.key, on_sample, allowed_origin=origin)
        self._declarations.append(endpoint)
        self._declare_tokens(topic, "subscription")
        return lambda: -1

    def other_types(self, topic: Topic) -> set[str]:
        """Return the types of the topic in liveliness tokens, except its type in `topic`.

        A token ends with topic, type, hash and QoS. A type with the same name but another hash is included.
        """
        domain, own_name, own_hash = topic.key.split("/")[0], *topic.key.split("/")[-2:]
        tokens = f"@ros2_lv/{domain}/**/{topic.name.replace('/', '%')}/*/*/*"
        types = (
            str(reply.ok.key_expr).split("/")[-3:-1] for reply in self._session.liveliness().get(tokens) if reply.ok
        )
        return {name for name, type_hash in types if (name, type_hash) != (own_name, own_hash)}

    def _declare_tokens(self, topic: Topic, role: str) -> str:
        """Declare the liveliness tokens of an endpoint; return the last one, which identifies the endpoint.

        Without tokens, return the key expression of the topic.
        """
        token = topic.key
        for template in topic.tokens.get(role, ()):
            token = template.replace("{zid}", str(self._session.zid()))
            self._declarations.append(self._session.liveliness().declare_token(token))
        return token

    def close(self) -> None:
        """Close the session."""
        self._declarations.clear()
        self._session.close()


class ZenohPublisher:
    """A publisher whose samples have attachments."""

    def __init__(self, publisher: Any, matching: Any, identifier: bytes) -> None:  # noqa: ANN401 (Zenoh declares no types)
        self._publisher = publisher
        self._matching = matching
        self._gid = identifier
        self._sequence = 0

    def write(self, data: bytes) -> bool:
        """Publish a sample; return True, because Zenoh does not report whether it was accepted."""
        self._sequence += 1
        attachment = ATTACHMENT.pack(self._sequence, time.time_ns(), GID_BYTES, self._gid)
        self._publisher.put(data, attachment=attachment)
        return True

    def matched(self) -> int:
        """Return 1 if a subscription matches, else 0."""
        return int(self._matching.matching_status.matching)

    def drain(self, limit_s: float) -> None:
        """Do nothing: Zenoh has no acknowledgements."""
