"""Delivers packets of robots that are stations of access points, and management frames of all stations.

The access points share an ideal wired network: it takes no time and has no losses. A packet goes from a robot to its
access point, over the wired network to the access point of its destination, and to the destination. Packets from or
to a robot without an access point, and packets to a robot that changes its access point, are lost.
"""

from collections import defaultdict, deque
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass
from typing import Final, Protocol

from typing_extensions import override

from sim_backends.radio.core.links import NOT_ASSOCIATED, RADIO_OFF, Payload
from sim_backends.radio.mac.channel import RadioChannel
from sim_backends.radio.mac.contention import EventQueue
from sim_backends.radio.mac.frames import HEADER_BYTES, Frame
from sim_backends.radio.mac.packet_delivery import PacketDelivery
from sim_backends.radio.mac.stations import Peer, Station

# Expedited forwarding: access category voice or video.
_HIGHEST_DSCP: Final = 46


@dataclass(frozen=True, slots=True)
class ManagementFrame:
    """The content of a frame that is not a packet of a robot: a management frame, or a frame of a neighbour.

    Attributes:
        kind: For example `beacon`.
        number: Number of the exchange to which it belongs; 0 if it belongs to none.
    """

    kind: str
    number: int = 0


class ManagementHandler(Protocol):
    """An object that processes management frames."""

    def on_management(self, now_ns: int, transmitter: int, receiver: int, frame: ManagementFrame) -> None:
        """Process a frame that a station has received; `transmitter` and `receiver` are indices of stations."""
        ...

    def on_management_lost(self, now_ns: int, transmitter: int, frame: ManagementFrame) -> None:
        """Process a frame that the station with this index could not send."""
        ...


class ManagedDelivery(PacketDelivery[Payload]):
    """Packets of robots that may be stations of access points. The arguments are those of the base class.

    Attributes:
        robots: Indices of the robots; other stations are access points and neighbours.
        access_points: Indices of the access points; without any, packets go directly or over a relay.
        serving_access_point: Access point to which the wired network sends the packets for each robot; None for a
            robot that is not associated.
        handler: Processes management frames; None if they are ignored.
    """

    def __init__(
        self,
        channel: RadioChannel,
        stations: Sequence[Station[Payload]],
        events: EventQueue,
        queue_packets: int,
    ) -> None:
        super().__init__(channel, stations, events, queue_packets)
        self.robots: Sequence[int] = ()
        self.access_points: Sequence[int] = ()
        self.serving_access_point: dict[int, int | None] = {}
        self.handler: ManagementHandler | None = None
        # Packets from and to a robot that is not on the channel; during a handover only packets from the robot.
        self._held_packets: dict[int, list[tuple[Station[Payload], Frame[Payload]]]] = {}
        self._in_handover: set[int] = set()
        # The robots for which each broadcast of an access point is intended.
        self._broadcast_receivers: dict[Frame[Payload], frozenset[int]] = {}
        self._management_counts: defaultdict[int, int] = defaultdict(int)

    def send_management(
        self, now_ns: int, transmitter: int, receiver: int | None, content: ManagementFrame, size_bytes: int
    ) -> None:
        """Send a management frame, or a frame of a neighbour, before the packets of the station.

        Args:
            now_ns: Current time.
            transmitter: Index of the sending station.
            receiver: Index of the receiver; None for a broadcast.
            content: Its content.
            size_bytes: Its size with MAC header and FCS.
        """
        station = self._stations[transmitter]
        name = f"{self._channel.names[transmitter]} management"
        packet = name, self._management_counts[transmitter]
        self._management_counts[transmitter] += 1
        frame: Frame[Payload] = Frame(
            content,  # type: ignore[arg-type]  # a management frame has no payload of a program
            size_bytes - HEADER_BYTES,
            self._channel.names[transmitter],
            receiver,
            (),
            True,
            packet,
            now_ns,
        )
        frame.dscp = _HIGHEST_DSCP
        super().enqueue_now(now_ns, station, frame)
        self._put_first(station, frame)

    def count_waiting_management(self, transmitter: int) -> int:
        """Return the number of management frames in the queues of a station, including one that is being sent."""
        return sum(_is_management(frame) for queue in _queues(self._stations[transmitter]) for frame in queue)

    def _put_first(self, station: Station[Payload], frame: Frame[Payload]) -> None:
        """Move the last frame of a queue before all frames that were not sent yet.

        A frame that was already sent stays first, so that its receiver can detect a repetition.
        """
        queue = station.queue if station.categories is None else station.categories.queue_of(frame)
        if not queue or queue[-1] is not frame:
            return  # dropped
        queue.pop()
        position = max((number + 1 for number, other in enumerate(queue) if other.attempts), default=0)
        queue.insert(position, frame)

    @override
    def enqueue(self, now_ns: int, station: Station[Payload], frame: Frame[Payload]) -> None:
        if not self.access_points:
            super().enqueue(now_ns, station, frame)
        elif station.index in self.access_points:
            self._distribute(now_ns, frame)
        else:
            self._send_to_access_point(now_ns, station, frame)

    def _send_to_access_point(self, now_ns: int, station: Station[Payload], frame: Frame[Payload]) -> None:
        frame.forward_to, frame.is_for_receiver = (frame.receiver,), False
        held_packets = self._held_packets.get(station.index)
        if held_packets is not None:
            held_packets.append((station, frame))
            return
        frame.receiver = self.serving_access_point.get(station.index)
        if frame.receiver is None:
            self.lose(now_ns, station.index, frame, NOT_ASSOCIATED)
        else:
            super().enqueue(now_ns, station, frame)

    def _distribute(self, now_ns: int, frame: Frame[Payload]) -> None:
        """Pass a packet to the access point of its destination, or to all that have associated robots."""
        robot = frame.receiver
        if robot is None:
            self._distribute_broadcast(now_ns, frame)
            return
        access_point = self.serving_access_point.get(robot)
        if access_point is None or robot in self._in_handover:
            self.lose(now_ns, self.access_points[0], frame, NOT_ASSOCIATED)
            return
        transmitter = self._stations[access_point]
        held_packets = self._held_packets.get(robot)
        if held_packets is not None:
            held_packets.append((transmitter, frame))
        else:
            super().enqueue(now_ns, transmitter, frame)

    def _distribute_broadcast(self, now_ns: int, frame: Frame[Payload]) -> None:
        """Pass a broadcast to each access point that has associated robots; it is lost for other robots."""
        members: dict[int, set[int]] = {}
        for robot in self.robots:
            access_point = self.serving_access_point.get(robot)
            if access_point is not None:
                members.setdefault(access_point, set()).add(robot)
            elif self.log_loss is not None and self._channel.names[robot] != frame.source:
                self.log_loss(now_ns, frame.payload, self._channel.names[robot], NOT_ASSOCIATED)
        for access_point, robots in members.items():
            copy = Frame(
                frame.payload,
                frame.size_bytes,
                frame.source,
                None,
                (),
                True,
                frame.packet,
                frame.queued_ns,
                frame.before,
                dscp=frame.dscp,
            )
            self._broadcast_receivers[copy] = frozenset(robots)
            super().enqueue(now_ns, self._stations[access_point], copy)

    @override
    def pass_up(self, now_ns: int, transmitter: int, peer: Peer[Payload], frames: Iterable[Frame[Payload]]) -> None:
        packets = []
        for frame in frames:
            if isinstance(frame.payload, ManagementFrame):
                if self.handler is not None and not self._is_off_channel(peer.receiver):
                    self.handler.on_management(now_ns, transmitter, peer.receiver, frame.payload)
            elif self._accepts(peer.receiver, frame):
                packets.append(frame)
        super().pass_up(now_ns, transmitter, peer, packets)

    def _is_off_channel(self, robot: int) -> bool:
        return robot in self._held_packets and robot not in self._in_handover

    def _accepts(self, receiver: int, frame: Frame[Payload]) -> bool:
        """Return False if the frame is a broadcast for other stations, or a broadcast to a robot off the channel."""
        if frame.receiver is not None:
            return True
        if not self.access_points:
            return receiver in self.robots
        return receiver in self._broadcast_receivers.get(frame, ()) and receiver not in self._held_packets

    @override
    def count_broadcast(self, now_ns: int, transmitter: int, frame: Frame[Payload], received: list[int]) -> None:
        if isinstance(frame.payload, ManagementFrame):
            return
        accepting_robots = [index for index in received if self._accepts(index, frame)]
        self.count_receptions(
            now_ns, transmitter, frame, accepting_robots, self._broadcast_receivers.pop(frame, self.robots)
        )

    @override
    def lose(self, now_ns: int, transmitter: int, frame: Frame[Payload], reason: str) -> None:
        if not isinstance(frame.payload, ManagementFrame):
            super().lose(now_ns, transmitter, frame, reason)
            self._broadcast_receivers.pop(frame, None)
        elif self.handler is not None:
            self.handler.on_management_lost(now_ns, transmitter, frame.payload)

    @override
    def _intended_receivers(self, transmitter: int, frame: Frame[Payload]) -> Iterable[str]:
        names = self._channel.names
        robot_names = {names[robot] for robot in self._broadcast_receivers.get(frame, self.robots)}
        return [name for name in super()._intended_receivers(transmitter, frame) if name in robot_names]

    @override
    def discard_queue(self, now_ns: int, station: Station[Payload]) -> None:
        super().discard_queue(now_ns, station)
        held_packets = self._held_packets.get(station.index)
        if held_packets is not None:
            for _, frame in held_packets:
                self.lose(now_ns, station.index, frame, RADIO_OFF)
            held_packets.clear()

    def hold(self, now_ns: int, robot: int) -> None:
        """Keep the packets from and to a robot that leaves the channel, until `release`."""
        station = self._stations[robot]
        held_packets = self._held_packets.setdefault(robot, [])
        held_packets += [
            (station, frame) for frame in self._withdraw(now_ns, station, self.serving_access_point.get(robot))
        ]
        access_point = self.serving_access_point.get(robot)
        if access_point is not None:
            transmitter = self._stations[access_point]
            held_packets += [(transmitter, frame) for frame in self._withdraw(now_ns, transmitter, robot)]

    def start_handover(self, now_ns: int, robot: int) -> None:
        """Keep the packets from a robot that leaves its access point; packets to it are lost until `associate`."""
        self.hold(now_ns, robot)
        self._in_handover.add(robot)
        station = self._stations[robot]
        packets_from_robot = []
        for transmitter, frame in self._held_packets[robot]:
            self._end_session(now_ns, transmitter, frame)
            if transmitter is station:
                packets_from_robot.append((station, frame))
            else:
                self.lose(now_ns, transmitter.index, frame, NOT_ASSOCIATED)
        self._held_packets[robot] = packets_from_robot
        if self.power_save is not None:
            for transmitter, frame in self.power_save.withdraw(robot):
                self.lose(now_ns, transmitter.index, frame, NOT_ASSOCIATED)

    def associate(self, now_ns: int, robot: int, access_point: int | None) -> None:
        """Set the access point of a robot, and send its waiting packets; without an access point they are lost."""
        self._in_handover.discard(robot)
        self.serving_access_point[robot] = access_point
        self.release(now_ns, robot)

    def release(self, now_ns: int, robot: int) -> None:
        """Send the packets from and to a robot that is on the channel again."""
        for transmitter, frame in self._held_packets.pop(robot, ()):
            if transmitter.index == robot:
                frame.receiver = self.serving_access_point.get(robot)
            if frame.receiver is None or self.serving_access_point.get(robot) is None:
                self.lose(now_ns, transmitter.index, frame, NOT_ASSOCIATED)
            else:
                super().enqueue(now_ns, transmitter, frame)

    def _withdraw(self, now_ns: int, station: Station[Payload], receiver: int | None) -> list[Frame[Payload]]:
        """Remove the packets of a station to a receiver from its queues, except those in its current exchange.

        Packets that the receiver has already decoded are removed and not returned.
        """
        frames_in_exchange = _frames_in_exchange(station)
        withdrawn_frames: list[Frame[Payload]] = []
        for queue in _queues(station):
            remaining_frames = [
                frame
                for frame in queue
                if frame.receiver != receiver or frame in frames_in_exchange or _is_management(frame)
            ]
            if len(remaining_frames) < len(queue):
                frames_to_keep = set(remaining_frames)
                withdrawn_frames += [frame for frame in queue if frame not in frames_to_keep]
                queue.clear()
                queue.extend(remaining_frames)
        if withdrawn_frames and station.index in self._events.starts:
            if any(_queues(station)):
                self._events.schedule_start(station.contention.earliest_start_ns(now_ns), station.index)
            else:
                self._events.cancel_start(station.index)
        return [frame for frame in withdrawn_frames if not self._is_received(station, frame)]

    def _is_received(self, station: Station[Payload], frame: Frame[Payload]) -> bool:
        receiver = frame.receiver
        return receiver is not None and self.peer(station.index, receiver, frame.category).has_received(frame)

    def _end_session(self, now_ns: int, station: Station[Payload], frame: Frame[Payload]) -> None:
        """Remove a frame from the Block Ack session with its receiver, and set its number of attempts to 0."""
        receiver = frame.receiver
        if receiver is not None and frame.sequence >= 0:
            peer = self.peer(station.index, receiver, frame.category)
            if peer.session is not None:
                self.pass_up(now_ns, station.index, peer, peer.session.skip([frame]))
            frame.sequence = -1
        frame.attempts = 0


def _is_management(frame: Frame[Payload]) -> bool:
    return isinstance(frame.payload, ManagementFrame)


def _queues(station: Station[Payload]) -> Iterable[deque[Frame[Payload]]]:
    return (station.queue,) if station.categories is None else station.categories.queues


def _frames_in_exchange(station: Station[Payload]) -> Collection[Frame[Payload]]:
    """Return the frames of a station's current exchange; empty if there is none."""
    if not station.is_in_exchange:
        return ()
    if station.aggregate is not None:
        return set(station.aggregate.frames)
    return {station.queue[0]} if station.queue else ()
