"""ROS 1: publishers and subscribers find each other by a master, and then talk without it."""

from collections.abc import Callable, Mapping
from functools import partial

from fieldkit.core.errors import ConfigurationError, did_you_mean
from sim_backends.network.packets import Packet
from sim_backends.network.ros1 import options as sizes
from sim_backends.network.ros1.calls import CallAnswer, RemoteCalls
from sim_backends.network.ros1.links import TRANSPORT, Block, Probe, TcprosLink, UdprosLink
from sim_backends.network.ros1.options import Ros1Flow, Ros1Options
from sim_backends.network.ros1.streams import TcpStreams
from sim_backends.network.wire import IpPacket, Wire


class Ros1:
    """The transport of packets that go by ROS 1.

    Publisher and subscriber of a flow register at the master, each when its node starts. The master tells the
    subscriber of the publisher, in its answer or by a call of its own. The subscriber asks the publisher how to
    connect, and does: by TCPROS, or by UDPROS, for which the question is enough. Before its first connection by
    TCPROS it asks the master whether connections are to be kept alive, as rospy does. What is published before goes
    nowhere. If the master cannot be reached no new connection comes up, and those that are go on.

    An agent keeps its connection to the master, as rospy does, while each question to a publisher has its own. So
    between hosts d apart, with a connection to the master, 12 d pass from registering to the first message: 2 for the
    answer, 4 for the publisher's, 2 for the master's, 4 for connection and headers. That is what rospy 1.15.15 takes,
    for messages that fill a segment or subscribers that ask for `tcp_nodelay`; smaller ones wait for an ACK (Nagle),
    2 d more.

    Every flow is registered by itself, as if it were a topic with one publisher and one subscriber. What nodes do
    beside (other parameters, services, `/rosout`) is left out.

    Args:
        wire: What it stands on.
        flows: Every flow of the scenario that goes by ROS 1, by its name.
        master: On which agent the master runs.
        options: Of nodes and their TCP; None is as in ROS.
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
        self._published: set[str] = set()
        self._subscribed: set[str] = set()
        self._asked: set[str] = set()
        self._know_keepalive: set[str] = set()
        for name, flow in self._flows.items():
            self._at_start(flow.publisher, partial(self._register_publisher, name))
            self._at_start(flow.subscriber, partial(self._register_subscriber, name))

    def send(self, packet: Packet) -> None:
        """See `Transport.send`.

        Raises:
            ConfigurationError: The packet is of no flow that is known.
        """
        name, _ = packet.identity
        if name not in self._links:
            raise ConfigurationError(
                f"{packet.source} publishes in a flow {name!r} that is none of ROS 1",
                remedy=did_you_mean(name, self._links, "flows: " + ", ".join(self._links)),
            )
        self._links[name].publish(packet)

    def receive(self, host: str, packet: IpPacket) -> None:
        """See `Transport.receive`."""
        if isinstance(packet.body, Probe | Block):
            self._links[packet.body.flow].receive(packet)
        else:
            self._streams.receive(host, packet)

    def lost(self, packet: IpPacket, reason: str) -> None:
        """See `Transport.lost`."""
        if isinstance(packet.body, Probe | Block):
            self._links[packet.body.flow].lost(packet, reason)

    def _at_start(self, agent: str, call: Callable[[], None]) -> None:
        starts_ns = self._options.starts_ns.get(agent, 0)
        self._wire.at(max(starts_ns, self._wire.now_ns), agent, call)

    def _register_publisher(self, name: str) -> None:
        def serve() -> CallAnswer:
            self._published.add(name)
            if name in self._subscribed:
                self._update(name)
            return CallAnswer(sizes.PUBLISHER_REGISTERED_BYTES, _nothing)

        publisher = self._flows[name].publisher
        self._calls.call(publisher, self._master, sizes.REGISTER_PUBLISHER_BYTES, serve, self._options.register)

    def _register_subscriber(self, name: str) -> None:
        def serve() -> CallAnswer:
            self._subscribed.add(name)
            if name not in self._published:
                return CallAnswer(sizes.SUBSCRIBER_REGISTERED_BYTES, _nothing)
            size_bytes = sizes.SUBSCRIBER_REGISTERED_BYTES + sizes.PUBLISHER_BYTES
            return CallAnswer(size_bytes, partial(self._request_topic, name))

        subscriber = self._flows[name].subscriber
        self._calls.call(subscriber, self._master, sizes.REGISTER_SUBSCRIBER_BYTES, serve, self._options.register)

    def _update(self, name: str) -> None:
        """Tell a subscriber of its publisher, at the master."""

        def serve() -> CallAnswer:
            self._request_topic(name)
            return CallAnswer(sizes.PUBLISHER_UPDATED_BYTES, _nothing)

        size_bytes = sizes.PUBLISHER_UPDATE_BYTES + sizes.PUBLISHER_BYTES
        self._calls.call(self._master, self._flows[name].subscriber, size_bytes, serve, self._options.update)

    def _request_topic(self, name: str) -> None:
        """Ask a publisher how to connect, at the subscriber, unless that is asked already."""
        if name in self._asked:
            return
        self._asked.add(name)
        flow, link = self._flows[name], self._links[name]
        udp = flow.protocol == "udpros"

        def serve() -> CallAnswer:
            link.accept()
            if udp:
                return CallAnswer(sizes.UDPROS_REQUESTED_BYTES, link.begin)
            return CallAnswer(sizes.TOPIC_REQUESTED_BYTES, partial(self._connect, name))

        size_bytes = sizes.REQUEST_UDPROS_BYTES if udp else sizes.REQUEST_TOPIC_BYTES
        request = self._options.request
        self._calls.call(flow.subscriber, flow.publisher, size_bytes, serve, request, about=name)

    def _connect(self, name: str) -> None:
        """Open a connection, at a subscriber, which asks the master before its first one how."""
        subscriber, link = self._flows[name].subscriber, self._links[name]
        if subscriber in self._know_keepalive:
            link.begin()
            return

        def know() -> None:
            self._know_keepalive.add(subscriber)
            link.begin()

        def serve() -> CallAnswer:
            return CallAnswer(sizes.KEEPALIVE_BYTES, know)

        self._calls.call(subscriber, self._master, sizes.GET_KEEPALIVE_BYTES, serve, self._options.request)


def _nothing() -> None:
    """Do nothing with an answer."""
