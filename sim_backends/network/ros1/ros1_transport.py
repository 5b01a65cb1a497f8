"""ROS 1: publishers and subscribers find each other through a master, and then communicate without it."""

from collections.abc import Callable, Mapping
from functools import partial

from fieldkit.core.errors import ConfigurationError, did_you_mean
from sim_backends.network.packets import Packet
from sim_backends.network.ros1 import ros1_options as sizes
from sim_backends.network.ros1.links import TRANSPORT, Block, Probe, TcprosLink, UdprosLink
from sim_backends.network.ros1.ros1_options import Ros1Flow, Ros1Options
from sim_backends.network.ros1.streams import CallResponse, RemoteCalls, TcpStreams
from sim_backends.network.wire import IpPacket, Wire


class Ros1:
    """The transport of packets of ROS 1.

    The publisher and the subscriber of a flow register at the master when their nodes start. The master sends the
    publisher's address to the subscriber, in its response or by a separate call. The subscriber requests the
    connection parameters from the publisher and connects: by TCPROS, or by UDPROS, for which the request is
    sufficient. Before its first TCPROS connection it queries the master for the keep-alive setting, as rospy does.
    Messages that are published before the connection is open are dropped. If the master cannot be reached, no new
    connection is opened, and existing connections continue.

    An agent keeps its connection to the master, as rospy does, while each request to a publisher has a separate
    connection. Let d be the delay between hosts. If the connection to the master is open, the time from registration
    to first message is 12 d: 2 d for the response of the master, 4 d for the response of the publisher, 2 d for the
    keep-alive query, and 4 d for the connection and its headers. This is the time of rospy 1.15.15 for messages that
    fill a segment, or for subscribers that request `tcp_nodelay`. Smaller messages wait for an ACK (Nagle), which
    takes 2 d more.

    Every flow is registered separately, as a topic with one publisher and one subscriber. Other traffic of nodes
    (other parameters, services, `/rosout`) is not modelled.

    Args:
        wire: The network below.
        flows: All flows of the scenario that use ROS 1, by name.
        master: The agent on which the master runs.
        options: Options of nodes and their TCP; None for the defaults of ROS.
    """

    def __init__(
        self, wire: Wire, flows: Mapping[str, Ros1Flow], *, master: str, options: Ros1Options | None = None
    ) -> None:
        self._wire = wire
        self._master = master
        self._flows = dict(sorted(flows.items()))
        self._options = options = options or Ros1Options()
        self._streams = TcpStreams(wire, TRANSPORT, options.tcp)
        self._calls = RemoteCalls(wire, self._streams)
        self._links = {
            name: TcprosLink(wire, self._streams, name, flow, options)
            if flow.protocol == "tcpros"
            else UdprosLink(wire, name, flow, options)
            for name, flow in self._flows.items()
        }
        self._publisher_flows: set[str] = set()
        self._subscriber_flows: set[str] = set()
        self._requested_topics: set[str] = set()
        self._agents_with_keepalive: set[str] = set()
        for name, flow in self._flows.items():
            self._at_start(flow.publisher, partial(self._register_publisher, name))
            self._at_start(flow.subscriber, partial(self._register_subscriber, name))

    def send(self, packet: Packet) -> None:
        """Implement `Transport.send`.

        Raises:
            ConfigurationError: The packet belongs to an unknown flow.
        """
        name, _ = packet.identity
        if name not in self._links:
            raise ConfigurationError(
                f"{packet.source} publishes in the flow {name!r}, which does not use ROS 1",
                remedy=did_you_mean(name, self._links, "flows: " + ", ".join(self._links)),
            )
        self._links[name].publish(packet)

    def receive(self, host: str, packet: IpPacket) -> None:
        """Implement `Transport.receive`."""
        if isinstance(packet.body, Probe | Block):
            self._links[packet.body.flow].receive(packet)
        else:
            self._streams.receive(host, packet)

    def record_loss(self, packet: IpPacket, reason: str) -> None:
        """Implement `Transport.record_loss`."""
        if isinstance(packet.body, Probe | Block):
            self._links[packet.body.flow].record_loss(packet, reason)

    def _at_start(self, agent: str, call: Callable[[], None]) -> None:
        starts_ns = self._options.starts_ns.get(agent, 0)
        self._wire.at(max(starts_ns, self._wire.now_ns), agent, call)

    def _register_publisher(self, name: str) -> None:
        def serve() -> CallResponse:
            self._publisher_flows.add(name)
            if name in self._subscriber_flows:
                self._update(name)
            return CallResponse(sizes.PUBLISHER_REGISTERED_BYTES, _do_nothing)

        publisher = self._flows[name].publisher
        self._calls.call(publisher, self._master, sizes.REGISTER_PUBLISHER_BYTES, serve, self._options.register)

    def _register_subscriber(self, name: str) -> None:
        def serve() -> CallResponse:
            self._subscriber_flows.add(name)
            if name not in self._publisher_flows:
                return CallResponse(sizes.SUBSCRIBER_REGISTERED_BYTES, _do_nothing)
            size_bytes = sizes.SUBSCRIBER_REGISTERED_BYTES + sizes.PUBLISHER_BYTES
            return CallResponse(size_bytes, partial(self._request_topic, name))

        subscriber = self._flows[name].subscriber
        self._calls.call(subscriber, self._master, sizes.REGISTER_SUBSCRIBER_BYTES, serve, self._options.register)

    def _update(self, name: str) -> None:
        """Send the publisher's address from the master to a subscriber."""

        def serve() -> CallResponse:
            self._request_topic(name)
            return CallResponse(sizes.PUBLISHER_UPDATED_BYTES, _do_nothing)

        size_bytes = sizes.PUBLISHER_UPDATE_BYTES + sizes.PUBLISHER_BYTES
        self._calls.call(self._master, self._flows[name].subscriber, size_bytes, serve, self._options.update)

    def _request_topic(self, name: str) -> None:
        """Send the request for connection parameters from the subscriber to a publisher, once per flow."""
        if name in self._requested_topics:
            return
        self._requested_topics.add(name)
        flow, link = self._flows[name], self._links[name]
        is_udp = flow.protocol == "udpros"

        def serve() -> CallResponse:
            link.accept()
            if is_udp:
                return CallResponse(sizes.UDPROS_REQUESTED_BYTES, link.connect)
            return CallResponse(sizes.TOPIC_REQUESTED_BYTES, partial(self._connect, name))

        size_bytes = sizes.REQUEST_UDPROS_BYTES if is_udp else sizes.REQUEST_TOPIC_BYTES
        request = self._options.request
        self._calls.call(flow.subscriber, flow.publisher, size_bytes, serve, request, topic=name)

    def _connect(self, name: str) -> None:
        """Open a connection from a subscriber; before the first one, query the master for the keep-alive setting."""
        subscriber, link = self._flows[name].subscriber, self._links[name]
        if subscriber in self._agents_with_keepalive:
            link.connect()
            return

        def on_keepalive() -> None:
            self._agents_with_keepalive.add(subscriber)
            link.connect()

        def serve() -> CallResponse:
            return CallResponse(sizes.KEEPALIVE_BYTES, on_keepalive)

        self._calls.call(subscriber, self._master, sizes.GET_KEEPALIVE_BYTES, serve, self._options.request)


def _do_nothing() -> None:
    """Ignore a response."""
