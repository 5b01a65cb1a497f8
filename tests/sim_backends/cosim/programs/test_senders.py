"""Programs that play bags, send files and send pings; combined programs, and programs on a computer that is off."""

from collections.abc import Sequence

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from rosbags.typesys import Stores, get_typestore

from sim_backends.cosim.federates import Action, Program
from sim_backends.cosim.programs.senders import (
    BagMessage,
    EchoRequester,
    EchoResponder,
    Periodic,
    PingRequest,
    Playback,
    file_pieces,
    generated_bag,
)
from sim_backends.cosim.programs.wrappers import CombinedProgram, Outage
from sim_backends.cosim.scenario.agent_plans import BagTraffic
from sim_backends.network.packets import Datagram, ReceivedDatagram
from sim_backends.radio.core.random_streams import RandomStream
from sim_backends.world.motion import State

ORIGIN = State((0.0, 0.0, 0.0))
MS = 1_000_000


def sent_datagrams(program: Program, to_ns: int) -> list[tuple[int, Datagram]]:
    """Run a program alone, and return the datagrams that it sends, each with its time."""
    datagrams = []
    while (wake_ns := program.next_wake_ns()) is not None and wake_ns <= to_ns:
        datagrams += [(wake_ns, datagram) for datagram in program.wake(wake_ns, ORIGIN, ()).datagrams]
    return datagrams


@given(st.integers(0, 10 * MS), st.floats(1, 1000), st.integers(0, 2**32))
def test_a_generated_bag_has_the_message_count_of_its_rate_and_delays_up_to_its_jitter(
    jitter_ns: int, rate_hz: float, seed: int
) -> None:
    bag = generated_bag(
        RandomStream(seed, "bag"), length_ns=500 * MS, rate_hz=rate_hz, size_bytes=320, jitter_ns=jitter_ns
    )
    assert len(bag) == round(0.5 * rate_hz)
    assert bag == sorted(bag, key=lambda message: message.at_ns)
    # Messages keep their order, so a message may have the delay of an earlier one.
    delays_ns = [message.at_ns - round(number / rate_hz * 1e9) for number, message in enumerate(bag)]
    assert all(0 <= delay_ns <= jitter_ns for delay_ns in delays_ns)
    assert len(set(delays_ns)) > 1 or len(bag) < 2 or jitter_ns < 1000


def test_a_message_of_the_papers_bag_has_the_size_of_a_serialized_ros_message() -> None:
    store = get_typestore(Stores.ROS1_NOETIC)
    types = store.types
    vector = types["geometry_msgs/msg/Vector3"](x=0.0, y=0.0, z=9.8)
    imu = types["sensor_msgs/msg/Imu"](
        header=types["std_msgs/msg/Header"](
            seq=0, stamp=types["builtin_interfaces/msg/Time"](sec=0, nanosec=0), frame_id="imu_link"
        ),
        orientation=types["geometry_msgs/msg/Quaternion"](x=0.0, y=0.0, z=0.0, w=1.0),
        orientation_covariance=np.zeros(9),
        angular_velocity=vector,
        angular_velocity_covariance=np.zeros(9),
        linear_acceleration=vector,
        linear_acceleration_covariance=np.zeros(9),
    )
    traffic = BagTraffic.model_validate({"kind": "bag", "from": "a", "to": "b"})
    assert traffic.size_bytes == len(store.serialize_ros1(imu, "sensor_msgs/msg/Imu"))
    assert traffic.packets(60.0) == 500


def test_playback_sends_each_message_at_its_time() -> None:
    bag = [BagMessage(0, 10), BagMessage(3 * MS, 20), BagMessage(3 * MS, 30), BagMessage(9 * MS, 40)]
    packets = sent_datagrams(Playback("f", "b", bag, begin_ns=5 * MS, protocol="tcp"), 100 * MS)
    assert [(at_ns, datagram.size_bytes, datagram.number) for at_ns, datagram in packets] == [
        (5 * MS, 10, 0),
        (8 * MS, 20, 1),
        (8 * MS, 30, 2),
        (14 * MS, 40, 3),
    ]
    assert {(datagram.flow, datagram.destination, datagram.protocol) for _, datagram in packets} == {
        ("f", "b", "tcp")
    }


@given(st.integers(1, 10**6), st.integers(500, 65_000))
def test_a_file_in_pieces_is_complete(size_bytes: int, piece_bytes: int) -> None:
    sizes = [piece.size_bytes for piece in file_pieces(size_bytes, piece_bytes)]
    assert sum(sizes) == size_bytes
    assert set(sizes[:-1]) <= {piece_bytes}
    assert 0 < sizes[-1] <= piece_bytes


def test_a_ping_sends_its_requests_and_every_request_gets_an_equal_reply() -> None:
    requests = sent_datagrams(
        EchoRequester("p/b", "b", count=3, interval_ns=100 * MS, size_bytes=56, first_ns=MS, protocol="tcp"), 10**12
    )
    assert [at_ns for at_ns, _ in requests] == [MS, 101 * MS, 201 * MS]
    received_requests = [ReceivedDatagram("a", request.payload, at_ns, at_ns + MS) for at_ns, request in requests]
    other_datagram = ReceivedDatagram("a", ORIGIN, 0, MS)
    replies = EchoResponder().wake(202 * MS, ORIGIN, [*received_requests, other_datagram]).datagrams
    assert replies == [Datagram("a", 56, "p/b/reply", number, None, "tcp") for number in range(3)]
    assert all(isinstance(request.payload, PingRequest) for _, request in requests)


def test_a_periodic_program_stops_at_its_stop_time() -> None:
    packets = sent_datagrams(
        Periodic("f", "b", period_ns=10 * MS, first_ns=5 * MS, stop_ns=25 * MS, protocol="tcp"), 10**12
    )
    assert [at_ns for at_ns, _ in packets] == [5 * MS, 15 * MS]


class CommandingProgram:
    """Returns a command at each planned wake time, and records received datagrams."""

    def __init__(self, command: str, *wakes_ns: int) -> None:
        self._command = command
        self._wakes_ns = list(wakes_ns)
        self.received: list[ReceivedDatagram] = []

    def next_wake_ns(self) -> int | None:
        return self._wakes_ns[0] if self._wakes_ns else None

    def wake(self, now_ns: int, own_state: State, received: Sequence[ReceivedDatagram]) -> Action:
        self.received += received
        if self._wakes_ns and self._wakes_ns[0] <= now_ns:
            self._wakes_ns.pop(0)
            return Action(command=self._command)
        return Action()


def test_combined_programs_wake_at_their_own_times_and_receive_all_datagrams() -> None:
    first, second = CommandingProgram("first", 3, 7), CommandingProgram("second", 5, 7)
    program = CombinedProgram([first, second])
    commands = []
    while (wake_ns := program.next_wake_ns()) is not None:
        commands.append((wake_ns, program.wake(wake_ns, ORIGIN, ()).command))
    assert commands == [(3, "first"), (5, "second"), (7, "second")]
    received_datagrams = [ReceivedDatagram("a", None, 0, 9)]
    assert program.wake(9, ORIGIN, received_datagrams) == Action()
    assert first.received == second.received == received_datagrams
    # With a fast clock a program may wake later than planned.
    assert (
        CombinedProgram([CommandingProgram("first", 3), CommandingProgram("second", 5)]).wake(4, ORIGIN, ()).command
        == "first"
    )


def test_a_computer_that_is_off_receives_and_sends_nothing_and_stops_its_body() -> None:
    sender, driver = Periodic("f", "b", period_ns=10), CommandingProgram("go", 5, 15, 35)
    program = Outage(CombinedProgram([sender, driver]), 12, 31, "stop")
    actions = []
    while (wake_ns := program.next_wake_ns()) is not None and wake_ns <= 50:
        action = program.wake(wake_ns, ORIGIN, ())
        actions.append((wake_ns, [datagram.number for datagram in action.datagrams], action.command))
    assert actions == [
        (0, [0], None),
        (5, [], "go"),
        (10, [1], None),
        (12, [], "stop"),
        (15, [], None),
        (20, [], None),
        (30, [], None),
        (35, [], "go"),
        (40, [4], None),
        (50, [5], None),
    ]
    datagram_while_off, datagram_when_on = ReceivedDatagram("a", 1, 0, 29), ReceivedDatagram("a", 2, 0, 31)
    outage = Outage(driver, 12, 31)
    assert outage.wake(29, ORIGIN, [datagram_while_off]) == Action()
    outage.wake(31, ORIGIN, [datagram_when_on])
    assert driver.received == [datagram_when_on]


def test_a_computer_whose_outage_has_no_end_stays_off() -> None:
    assert [at_ns for at_ns, _ in sent_datagrams(Outage(Periodic("f", "b", period_ns=10), 12, None), 100)] == [0, 10]
