"""A ROS 1 node that publishes and subscribes to serialized messages, without ROS's libraries.

Sources: wiki.ros.org/ROS/Master_API, wiki.ros.org/ROS/Slave_API, wiki.ros.org/ROS/TCPROS.
"""

import os
import queue
import select
import socket
import threading
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, Final
from urllib.parse import urlsplit

from sim_backends.ros1.framing import PacketSplitter, pack, pack_header, unpack_header
from sim_backends.ros1.node_calls import CALL_S, FAILURE, SUCCESS, MasterError, RosNodeRequests, RosNodeServer, call

_RETRY_S: Final = 0.1
"""Time between two calls of a master that does not answer."""
_CHUNK_BYTES: Final = 1 << 16


@dataclass(frozen=True)
class RosMessageType:
    """A message type.

    Attributes:
        name: Its name, `package/Name`.
        md5: MD5 sum of its definition.
        definition: Its definition, with the definitions of all nested types.
    """

    name: str
    md5: str
    definition: str


class RosPublisher:
    """A publisher of a topic.

    Args:
        topic: The topic.
        kind: Its type.
        caller: Name of the node.
    """

    def __init__(self, topic: str, kind: RosMessageType, caller: str) -> None:
        self._kind = kind
        self._header = {
            "callerid": caller,
            "latching": "0",
            "md5sum": kind.md5,
            "message_definition": kind.definition,
            "topic": topic,
            "type": kind.name,
        }
        self._lock = threading.Lock()
        self._streams: list[socket.socket] = []

    @property
    def connections(self) -> int:
        """Number of connected subscribers."""
        return len(self._streams)

    def accept(self, stream: socket.socket, header: Mapping[str, str]) -> None:
        """Answer the connection header of a subscriber, and send it all later messages until it disconnects.

        Raises:
            OSError: The connection failed.
            ValueError: The subscriber expects another type.
        """
        if header.get("md5sum") not in {"*", self._kind.md5}:
            raise ValueError(f"the type of {header.get('topic')} is {self._kind.name}, not {header.get('type')}")
        with self._lock:  # after the header, a subscriber must receive every message that is published
            stream.sendall(pack(pack_header(self._header)))
            self._streams.append(stream)
        # Subscribers send nothing more, so only the end of the stream can be read.
        poller = select.poll()
        poller.register(stream, select.POLLIN)
        poller.poll()
        self._disconnect(stream)

    def publish(self, message: bytes, deadline_s: float | None) -> int:
        """Send a message to all subscribers; return the number of subscribers to which it was sent.

        A subscriber that does not read until `deadline_s` (on the clock of `time.monotonic`; None for no limit) is
        disconnected.

        Raises:
            TimeoutError: No subscriber has received the message, because they did not read in time.
        """
        packet = pack(message)
        sent_count, was_late = 0, False
        with self._lock:
            streams = tuple(self._streams)
        for stream in streams:
            try:
                stream.settimeout(None if deadline_s is None else max(deadline_s - time.monotonic(), 0.001))
                stream.sendall(packet)
                sent_count += 1
            except OSError as error:
                was_late |= isinstance(error, TimeoutError)
                self._disconnect(stream)
        if was_late and not sent_count:
            raise TimeoutError("the subscriber does not read")
        return sent_count

    def _disconnect(self, stream: socket.socket) -> None:
        """Stop sending to a subscriber; the thread of `accept` closes its socket."""
        with self._lock, suppress(ValueError):
            self._streams.remove(stream)
        with suppress(OSError):
            stream.shutdown(socket.SHUT_RDWR)

    def close(self) -> None:
        """Disconnect all subscribers."""
        for stream in tuple(self._streams):
            self._disconnect(stream)


class RosSubscriber:
    """A subscriber to a topic, which connects to each of its publishers.

    Args:
        topic: The topic.
        kind: Its type.
        caller: Name of the node.
    """

    def __init__(self, topic: str, kind: RosMessageType, caller: str) -> None:
        self._topic = topic
        self._kind = kind
        self._caller = caller
        self._messages: queue.SimpleQueue[bytes] = queue.SimpleQueue()
        self._lock = threading.Lock()
        self._publishers: set[str] = set()
        self._streams: list[socket.socket] = []
        self._is_closed = False

    @property
    def connections(self) -> int:
        """Number of connected publishers."""
        return len(self._streams)

    def update(self, publishers: Sequence[str]) -> None:
        """Connect to the new publishers in a list of URIs."""
        with self._lock:
            new_uris, self._publishers = set(publishers) - self._publishers, set(publishers)
        for uri in new_uris:
            threading.Thread(target=self._receive, args=(uri,), daemon=True).start()

    def receive(self, deadline_s: float | None) -> bytes:
        """Return the next message.

        Raises:
            TimeoutError: No message arrived until `deadline_s`, on the clock of `time.monotonic`. None has no limit.
        """
        try:
            return self._messages.get(timeout=None if deadline_s is None else max(deadline_s - time.monotonic(), 0))
        except queue.Empty:
            raise TimeoutError(f"no message on {self._topic}") from None

    def _receive(self, uri: str) -> None:
        """Receive the messages of a publisher until it disconnects; does nothing if it no longer exists."""
        with suppress(OSError, ValueError):
            protocol = call(uri, "requestTopic", self._caller, self._topic, [["TCPROS"]])
            _, host, port = protocol
            with socket.create_connection((host, port), timeout=CALL_S) as stream:
                self._read(stream)
        with self._lock:
            self._publishers.discard(uri)

    def _read(self, stream: socket.socket) -> None:
        """Exchange headers, then store each message.

        A publisher of another type is disconnected, and none of its messages is stored.

        Raises:
            OSError: The connection failed.
            ValueError: The publisher violates TCPROS.
        """
        stream.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        fields = {
            "callerid": self._caller,
            "md5sum": self._kind.md5,
            "message_definition": self._kind.definition,
            "tcp_nodelay": "1",
            "topic": self._topic,
            "type": self._kind.name,
        }
        stream.sendall(pack(pack_header(fields)))
        packets, has_header = PacketSplitter(), False
        try:
            while data := stream.recv(_CHUNK_BYTES):
                packets.feed(data)
                for packet in packets:
                    if has_header:
                        self._messages.put(packet)
                    elif unpack_header(packet).get("md5sum") != self._kind.md5:
                        return
                    else:
                        has_header = True
                        stream.settimeout(None)
                        self._add(stream)
        finally:
            with self._lock, suppress(ValueError):
                self._streams.remove(stream)

    def _add(self, stream: socket.socket) -> None:
        """Register the connection to a publisher; close it if the subscriber was closed meanwhile."""
        with self._lock:
            self._streams.append(stream)
        if self._is_closed:
            stream.shutdown(socket.SHUT_RDWR)

    def close(self) -> None:
        """Disconnect from all publishers."""
        self._is_closed = True
        with self._lock:
            streams = tuple(self._streams)
        for stream in streams:
            with suppress(OSError):
                stream.shutdown(socket.SHUT_RDWR)


class RosNode:
    """A node that publishes topics and subscribes to topics.

    Args:
        name: Its name.
        master: URI of the master.
        host: Address or name of this machine for other nodes; empty for the address from which the master is reached.

    Raises:
        OSError: The address cannot be used.
    """

    def __init__(self, name: str, master: str, host: str = "") -> None:
        self._name = name
        self._master = master
        self._host = host or _address_towards(master)
        self._publishers: dict[str, RosPublisher] = {}
        self._subscribers: dict[str, RosSubscriber] = {}
        self._is_closed = False
        self._stream_server = socket.create_server((self._host, 0))
        try:
            self._server = RosNodeServer((self._host, 0), RosNodeRequests, logRequests=False, allow_none=True)
        except OSError:
            self._stream_server.close()
            raise
        self._uri = f"http://{self._host}:{self._server.server_address[1]}/"
        functions: Mapping[str, Any] = {
            "requestTopic": self._request_topic,
            "publisherUpdate": self._publisher_update,
            "getPid": self._get_pid,
        }
        for method, function in functions.items():
            self._server.register_function(function, method)
        threading.Thread(target=self._server.serve_forever, kwargs={"poll_interval": 0.05}, daemon=True).start()
        threading.Thread(target=self._accept, daemon=True).start()

    def publish(self, topic: str, kind: RosMessageType, deadline_s: float) -> RosPublisher:
        """Return a publisher of a topic.

        Args:
            topic: The topic.
            kind: Its type.
            deadline_s: Time on the clock of `time.monotonic` until which calls of a master that does not answer are
                repeated.

        Raises:
            TimeoutError: No master answers.
            MasterError: The master refuses the publisher.
        """
        publisher = self._publishers[topic] = RosPublisher(topic, kind, self._name)
        self._register("registerPublisher", topic, kind, deadline_s)
        return publisher

    def subscribe(self, topic: str, kind: RosMessageType, deadline_s: float) -> RosSubscriber:
        """Return a subscriber to a topic; see `publish` for the arguments and errors."""
        subscriber = self._subscribers[topic] = RosSubscriber(topic, kind, self._name)
        subscriber.update(self._register("registerSubscriber", topic, kind, deadline_s))
        return subscriber

    def _register(self, method: str, topic: str, kind: RosMessageType, deadline_s: float) -> list[str]:
        """Call a registration method of the master; return the URIs in its answer."""
        while True:
            try:
                uris = call(self._master, method, self._name, topic, kind.name, self._uri)
            except MasterError:
                raise
            except OSError as error:
                if time.monotonic() + _RETRY_S >= deadline_s:
                    raise TimeoutError(f"no ROS master answers at {self._master}: {error}") from error
                time.sleep(_RETRY_S)
                continue
            return [str(uri) for uri in uris]

    def _accept(self) -> None:
        """Serve each subscriber that connects, in its own thread, until the node is closed."""
        while not self._is_closed:
            try:
                stream, _ = self._stream_server.accept()
            except OSError:
                return
            threading.Thread(target=self._serve, args=(stream,), daemon=True).start()

    def _serve(self, stream: socket.socket) -> None:
        """Serve the connection of a subscriber; a subscriber that violates TCPROS is disconnected."""
        with stream, suppress(OSError, ValueError):
            stream.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            stream.settimeout(CALL_S)
            packets = PacketSplitter()
            while data := stream.recv(_CHUNK_BYTES):
                packets.feed(data)
                for packet in packets:
                    header = unpack_header(packet)
                    publisher = self._publishers.get(header.get("topic", ""))
                    if publisher is not None:
                        publisher.accept(stream, header)
                    return

    def _request_topic(self, _caller: str, topic: str, protocols: Sequence[Any]) -> list[Any]:
        if topic not in self._publishers or not any(protocol[:1] == ["TCPROS"] for protocol in protocols):
            return [FAILURE, f"{topic} is not published here by TCPROS", 0]
        return [SUCCESS, "", ["TCPROS", self._host, self._stream_server.getsockname()[1]]]

    def _publisher_update(self, _caller: str, topic: str, publishers: Sequence[str]) -> list[Any]:
        if topic in self._subscribers:
            self._subscribers[topic].update(publishers)
        return [SUCCESS, "", 0]

    def _get_pid(self, _caller: str) -> list[Any]:
        return [SUCCESS, "", os.getpid()]

    def close(self) -> None:
        """Unregister the node and close its connections."""
        if self._is_closed:
            return
        self._is_closed = True
        for method, topics in (
            ("unregisterPublisher", tuple(self._publishers)),
            ("unregisterSubscriber", tuple(self._subscribers)),
        ):
            for topic in topics:
                with suppress(OSError):
                    call(self._master, method, self._name, topic, self._uri)
        for publisher in self._publishers.values():
            publisher.close()
        for subscriber in self._subscribers.values():
            subscriber.close()
        self._server.shutdown()
        self._server.server_close()
        with suppress(OSError):
            self._stream_server.shutdown(socket.SHUT_RDWR)  # so that `accept` returns
        self._stream_server.close()


def _address_towards(uri: str) -> str:
    """Return the address of this machine from which a URI is reached.

    Raises:
        OSError: The URI cannot be reached.
    """
    parts = urlsplit(uri)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.connect((parts.hostname, parts.port or 80))
        return str(probe.getsockname()[0])
