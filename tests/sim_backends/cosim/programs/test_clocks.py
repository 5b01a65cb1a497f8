"""Clocks that are wrong during an interval, and programs that read only such a clock."""

from collections.abc import Sequence
from fractions import Fraction

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fieldkit.core.errors import ConfigurationError
from sim_backends.cosim.federates import Action, Program
from sim_backends.cosim.programs.senders import Periodic
from sim_backends.cosim.programs.wrappers import AgentClock, ProgramWithClock
from sim_backends.network.packets import Datagram, ReceivedDatagram
from sim_backends.world.motion import State

ORIGIN = State((0.0, 0.0, 0.0))
MS = 1_000_000
TIMES = st.integers(0, 10**11)
CLOCKS = st.builds(
    lambda begin_ns, duration_ns, offset_ns, rate_ppb: AgentClock(
        begin_ns, None if duration_ns is None else begin_ns + duration_ns, offset_ns, rate_ppb
    ),
    TIMES,
    st.none() | st.integers(1, 10**11),
    st.integers(-(10**10), 10**10),
    st.integers(-500_000_000, 500_000_000),
)


@given(CLOCKS, TIMES)
def test_the_reading_of_a_clock_follows_from_offset_and_rate(clock: AgentClock, now_ns: int) -> None:
    is_wrong = clock.begin_ns <= now_ns and (clock.end_ns is None or now_ns < clock.end_ns)
    exact_ns = now_ns + is_wrong * (clock.offset_ns + Fraction(clock.rate_ppb, 10**9) * (now_ns - clock.begin_ns))
    assert 0 <= exact_ns - clock.reading_ns(now_ns) < 1


@given(CLOCKS, TIMES)
def test_first_ns_is_the_first_time_at_which_the_clock_shows_a_reading(
    clock: AgentClock, shown_reading_ns: int
) -> None:
    first_ns = clock.first_ns(shown_reading_ns)
    assert clock.reading_ns(first_ns) >= shown_reading_ns
    # Within an interval the reading never decreases, so only the last nanosecond before `first_ns` and before each
    # border of an interval needs a check.
    borders_ns = [at_ns for at_ns in (clock.begin_ns, clock.end_ns) if at_ns is not None]
    last_times_ns = [at_ns - 1 for at_ns in (first_ns, *borders_ns) if 0 < at_ns <= first_ns]
    assert all(clock.reading_ns(at_ns) < shown_reading_ns for at_ns in last_times_ns)


@pytest.mark.parametrize("rate_ppb", [-(10**9), -2 * 10**9])
def test_a_clock_that_stops_or_runs_backwards_is_refused(rate_ppb: int) -> None:
    with pytest.raises(ConfigurationError, match="stops or runs backwards"):
        AgentClock(rate_ppb=rate_ppb)
    assert AgentClock(rate_ppb=1 - 10**9).first_ns(1) == 10**9


class Listener:
    """Records received datagrams with the readings of its clock."""

    def __init__(self) -> None:
        self.received: list[tuple[int, ReceivedDatagram]] = []

    def next_wake_ns(self) -> None:
        return None

    def wake(self, now_ns: int, own_state: State, received: Sequence[ReceivedDatagram]) -> Action:
        self.received += [(now_ns, datagram) for datagram in received]
        return Action()


def sent_datagrams(program: Program, to_ns: int) -> list[tuple[int, Datagram]]:
    """Run a program alone, and return the datagrams that it sends, each with the true time."""
    datagrams = []
    while (wake_ns := program.next_wake_ns()) is not None and wake_ns <= to_ns:
        datagrams += [(wake_ns, datagram) for datagram in program.wake(wake_ns, ORIGIN, ()).datagrams]
    return datagrams


def test_a_program_with_a_fast_clock_sends_more_often_and_stamps_the_reading() -> None:
    fast = AgentClock(rate_ppb=100_000_000)
    packets = sent_datagrams(ProgramWithClock(Periodic("a", "b", period_ns=11 * MS), fast), 100 * MS)
    assert [at_ns for at_ns, _ in packets] == [number * 10 * MS for number in range(11)]
    listener = Listener()
    slow = AgentClock(offset_ns=-5 * MS)
    program = ProgramWithClock(listener, slow)
    for at_ns, datagram in packets[:2]:
        program.wake(at_ns + 7 * MS, ORIGIN, [ReceivedDatagram("a", datagram.payload, at_ns, at_ns + 6 * MS)])
    assert listener.received == [
        (2 * MS, ReceivedDatagram("a", ORIGIN, 0, 1 * MS)),
        (12 * MS, ReceivedDatagram("a", ORIGIN, 11 * MS, 11 * MS)),
    ]


def test_the_correction_of_a_clock_neither_repeats_nor_delays_a_datagram() -> None:
    fast_clock = AgentClock(begin_ns=20 * MS, end_ns=50 * MS, offset_ns=15 * MS)
    times_ns = [
        at_ns
        for at_ns, _ in sent_datagrams(ProgramWithClock(Periodic("a", "b", period_ns=10 * MS), fast_clock), 100 * MS)
    ]
    # The reading is 35 ms at 20 ms, and 60 ms at 45 ms. At 50 ms it falls from 65 ms to 50 ms, so the datagram after
    # the one at the reading 60 ms is sent at 70 ms.
    assert times_ns == [0, 10 * MS, 20 * MS, 25 * MS, 35 * MS, 45 * MS, 70 * MS, 80 * MS, 90 * MS, 100 * MS]
    slow_clock = AgentClock(end_ns=10_000 * MS, offset_ns=-9_000 * MS)
    packets = sent_datagrams(ProgramWithClock(Periodic("a", "b", period_ns=MS), slow_clock), 10_001 * MS)
    assert [at_ns for at_ns, _ in packets[-3:]] == [9_999 * MS, 10_000 * MS, 10_001 * MS]
    assert [datagram.number for _, datagram in packets] == list(range(len(packets)))
