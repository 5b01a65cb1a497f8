"""ROS 1 nodes: messages with a real master and Debian's tools, nodes that have exited, and wrong types."""

import socket
import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import closing

import pytest
from typing_extensions import Buffer

from fieldkit.core.deadline import Deadline
from sim_backends.federates.transports.ros1 import MESSAGE
from sim_backends.ros1.framing import pack, pack_header
from sim_backends.ros1.node import RosMessageType, RosNode, RosPublisher
from sim_backends.ros1.node_calls import MasterError, call
from tests.helpers.federate_transports import ros_master
from tests.helpers.sshd import wait_until

OTHER = RosMessageType("std_msgs/String", "992ce8a1687cec8c8bd883ec73ca41d1", "string data\n")


@pytest.fixture(scope="module")
def master() -> Iterator[str]:
    with ros_master() as uri:
        yield uri


def deadline_after(duration_s: float) -> float:
    return time.monotonic() + duration_s


def wait_for(condition: Callable[[], bool]) -> None:
    wait_until(condition, Deadline.after(30))


def test_messages_pass_between_nodes_and_to_ros(master: str) -> None:
    with closing(RosNode("/a", master)) as a, closing(RosNode("/b", master)) as b:
        subscriber = b.subscribe("/data", MESSAGE, deadline_after(30))
        publisher = a.publish("/data", MESSAGE, deadline_after(30))
        wait_for(lambda: publisher.connections == 1 and subscriber.connections == 1)
        for body in (b"", b"\0" * 12, bytes(200_000)):
            assert publisher.publish(body, deadline_after(30)) == 1
            assert subscriber.receive(deadline_after(30)) == body
        subscriber.close()
        wait_for(lambda: publisher.connections == 0)
        result = subprocess.run(("rostopic", "info", "/data"), capture_output=True, text=True, timeout=60, check=True)
        assert "Type: std_msgs/UInt8MultiArray" in result.stdout
        assert " * /a (http://127.0.0.1:" in result.stdout
        assert publisher.publish(b"", deadline_after(30)) == 0
        with pytest.raises(TimeoutError):
            subscriber.receive(deadline_after(0.01))


def test_another_type_and_a_node_that_has_exited_are_ignored(master: str) -> None:
    with closing(RosNode("/a", master)) as a, closing(RosNode("/b", master)) as b:
        with socket.create_server(("127.0.0.1", 0)) as server:
            closed_address = f"http://127.0.0.1:{server.getsockname()[1]}/"
        call(master, "registerPublisher", "/gone", "/data2", MESSAGE.name, closed_address)
        string_subscriber = b.subscribe("/data2", OTHER, deadline_after(30))
        byte_subscriber = b.subscribe("/data3", MESSAGE, deadline_after(30))
        publishers = [a.publish(f"/data{number}", MESSAGE, deadline_after(30)) for number in (2, 3)]
        wait_for(lambda: publishers[1].connections == 1 and byte_subscriber.connections == 1)
        assert string_subscriber.connections == publishers[0].connections == 0


def test_invalid_data_disconnect_only_their_sender(master: str) -> None:
    with closing(RosNode("/a", master)) as a:
        publisher = a.publish("/data4", MESSAGE, deadline_after(30))
        port = a._stream_server.getsockname()[1]
        for data in (b"\xff" * 8, pack(b"no header"), pack(pack_header({"topic": "/other"}))):
            with socket.create_connection(("127.0.0.1", port)) as stream:
                stream.sendall(data)
                assert stream.recv(1) == b""
        assert publisher.connections == 0


class _StreamWithCallback(socket.socket):
    """A socket that calls a function after its first data were sent."""

    on_sent: Callable[[], object] | None = None

    def sendall(self, data: Buffer, flags: int = 0, /) -> None:
        super().sendall(data, flags)
        callback, self.on_sent = self.on_sent, None
        if callback is not None:
            callback()


def test_a_subscriber_that_has_received_the_header_receives_every_message() -> None:
    """From then on the subscriber counts as connected, and may request an answer that is published immediately."""
    near_socket, far_socket = socket.socketpair()
    stream = _StreamWithCallback(fileno=near_socket.detach())
    publisher = RosPublisher("/data", MESSAGE, "/a")
    counts: list[int] = []
    publishing = threading.Thread(target=lambda: counts.append(publisher.publish(b"answer", deadline_after(30))))

    def publish() -> None:
        publishing.start()
        publishing.join(0.1)

    stream.on_sent = publish
    accepting = threading.Thread(target=publisher.accept, args=(stream, {"md5sum": "*"}))
    accepting.start()
    wait_for(lambda: publishing.ident is not None)
    publishing.join(30)
    far_socket.close()
    accepting.join(30)
    stream.close()
    assert counts == [1]


def test_a_missing_master_and_a_refused_call_are_errors(master: str) -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        uri = f"http://127.0.0.1:{server.getsockname()[1]}"
    with (
        closing(RosNode("/a", uri)) as a,
        pytest.raises(TimeoutError, match=f"no ROS master answers at {uri}"),
    ):
        a.publish("/data", MESSAGE, deadline_after(0.2))
    with pytest.raises(MasterError, match="refused registerPublisher"):
        call(master, "registerPublisher", "/a", "", "", "")
