"""TCP while nodes are off and while a jammer passes: times computed by hand, and each message delivered once."""

from itertools import pairwise

from sim_backends.network.disturbances import Jammer, NodeLoss
from sim_backends.network.ip import Fragment
from sim_backends.network.packets import Packet
from sim_backends.network.radio import RadioNetwork
from sim_backends.network.tcp.connection import Tcp
from sim_backends.radio.phy.modes import ENERGY_DETECTION_DBM
from tests.helpers.radio_networks import MS, fixed, packets, standing, wifi

SECOND = 1000 * MS
DELAY_NS = 10 * MS
AT_ORIGIN = standing(dict.fromkeys("ab", (0.0, 0.0, 1.0)))


class DisturbedTransfer:
    """A transfer of messages of 100 bytes from a to b over a delay of 10 ms, while one host is off for a time.

    Attributes:
        sent: Times of the packets that each host sent.
        arrived_ns: Times of arrival of the messages.
    """

    def __init__(self, sent_ns: list[int], loss: NodeLoss) -> None:
        self.sent: dict[str, list[int]] = {"a": [], "b": []}
        self.net = RadioNetwork(fixed(delay="10ms"), "ab", transports={"tcp": Tcp}, disturbances=[loss])
        self.net.log_ip(self._log)
        messages = packets([(at_ns, "a", "b", 100) for at_ns in sent_ns], protocol="tcp", flow="f")
        arrivals, drops = self.net.advance(3600 * SECOND, messages, AT_ORIGIN)
        assert not drops
        self.arrived_ns = [arrival.at_ns for arrival in arrivals]

    def _log(self, at_ns: int, host: str, fragment: Fragment) -> None:
        if fragment.packet.source == host:
            self.sent[host].append(at_ns)


def test_the_timers_of_a_sender_that_is_off_fire_when_it_is_on_again() -> None:
    # The second message arrives while the sender is off, so its ACK is lost; the timeout at 1.2 s waits until 5 s.
    transfer = DisturbedTransfer([0, SECOND], NodeLoss("a", SECOND + 5 * MS, 5 * SECOND))
    assert transfer.arrived_ns == [30 * MS, SECOND + DELAY_NS]
    assert [at_ns for at_ns in transfer.sent["a"] if at_ns > SECOND] == [5 * SECOND]


def test_the_timers_of_a_sender_that_stays_off_never_fire() -> None:
    transfer = DisturbedTransfer([0, SECOND], NodeLoss("a", SECOND + 5 * MS))
    assert max(transfer.sent["a"]) == SECOND
    assert transfer.net.next_event_ns() is None


def test_a_delayed_ack_of_a_receiver_that_is_off_is_sent_when_it_is_on_again() -> None:
    # The ACK would have been sent at 1.05 s. The retransmission at 1.2 s is lost.
    transfer = DisturbedTransfer([0, SECOND], NodeLoss("b", SECOND + 20 * MS, SECOND + 500 * MS))
    assert [at_ns for at_ns in transfer.sent["a"] if at_ns > SECOND] == [SECOND + 200 * MS]
    assert [at_ns for at_ns in transfer.sent["b"] if at_ns > SECOND] == [SECOND + 500 * MS]


def test_a_sender_reaches_its_receiver_again_with_exponential_backoff() -> None:
    """The message is sent at 2 s, and again after 0.2, 0.4, 0.8 and 1.6 s; the last copy, at 5 s, arrives."""
    transfer = DisturbedTransfer([0, 2 * SECOND], NodeLoss("b", SECOND, 5 * SECOND))
    assert [at_ns for at_ns in transfer.sent["a"] if at_ns > SECOND] == [
        2 * SECOND + tenths * 100 * MS for tenths in (0, 2, 6, 14, 30)
    ]
    assert transfer.arrived_ns[1] == 5 * SECOND + DELAY_NS


def test_a_stream_pauses_while_a_jammer_passes_and_then_continues() -> None:
    """An agent with a jammer passes the sender, which detects a busy channel within 10 m and does not send."""
    jamming_range_m = 10.0
    power_dbm = ENERGY_DETECTION_DBM + 40.18 + 30.0
    net = RadioNetwork(wifi("ab"), "ab", transports={"tcp": Tcp}, disturbances=[Jammer(power_dbm, 0, agent="j")])
    messages = [Packet(number, "a", "b", 1000, ("f", number), 0, 0, "tcp") for number in range(6000)]
    arrived_ns: list[int] = []
    numbers: list[int] = []
    arrivals_while_jammed: list[int] = []
    # At 10 m/s, in steps of 100 ms: from 35 m on one side to 35 m on the other, within 10 m from 2.5 to 4.5 s.
    for step in range(71):
        east_m = step - 35.0
        states = standing({"a": (0.0, 0.0, 1.0), "b": (0.0, 20.0, 1.0), "j": (east_m, 0.0, 1.0)})
        now_ns = (step + 1) * 100 * MS
        arrivals, drops = net.advance(now_ns, messages if step == 0 else [], states)
        assert not drops
        if abs(east_m) < jamming_range_m:
            arrivals_while_jammed.append(len(arrivals))
        numbers += [arrival.packet_id for arrival in arrivals]
        arrived_ns += [arrival.at_ns for arrival in arrivals]
    # A frame that the radio had started when the jammer came near still arrives.
    assert sum(arrivals_while_jammed) <= 1
    before, after = (
        len([at_ns for at_ns in arrived_ns if low <= at_ns < high])
        for low, high in ((0, 2_500 * MS), (4_600 * MS, 7_100 * MS))
    )
    assert before > 500
    assert after > 500
    assert numbers == list(range(len(numbers)))
    assert all(earlier <= later for earlier, later in pairwise(arrived_ns))
