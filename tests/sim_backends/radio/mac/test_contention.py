"""Events run at their scheduled times, and a rescheduled start leaves no earlier event behind."""

from hypothesis import given
from hypothesis import strategies as st

from sim_backends.radio.mac.contention import EventQueue


class EventLog:
    def __init__(self) -> None:
        self.events: list[tuple[int, object]] = []

    def record(self, at_ns: int, name: object) -> None:
        self.events.append((at_ns, name))


def test_simultaneous_events_run_in_the_order_of_scheduling() -> None:
    event_log = EventLog()
    events = EventQueue(event_log.record)
    events.schedule(10, event_log.record, "first")
    events.schedule_start(10, 1)
    events.schedule(10, event_log.record, "third")
    events.schedule_start(10, 2)
    events.schedule_start(10, 1)
    events.advance(10)
    assert event_log.events == [(10, "first"), (10, "third"), (10, 2), (10, 1)], "a rescheduled start runs last"


def test_a_rescheduled_start_happens_once() -> None:
    event_log = EventLog()
    events = EventQueue(event_log.record)
    for at_ns in (5, 30, 20):
        events.schedule_start(at_ns, 7)
        assert (events.starts[7][0], events.next_ns()) == (at_ns, at_ns)
    events.advance(19)
    assert event_log.events == []
    events.advance(100)
    assert event_log.events == [(20, 7)]
    assert (events.starts, events.next_ns()) == ({}, None)


def test_an_event_may_schedule_another_event_for_the_same_time() -> None:
    event_log = EventLog()
    events = EventQueue(lambda at_ns, index: events.schedule(at_ns, event_log.record, index))
    events.schedule_start(10, 3)
    events.advance(10)
    assert event_log.events == [(10, 3)]


@given(st.lists(st.tuples(st.integers(0, 20), st.booleans(), st.integers(0, 4))), st.integers(1, 7))
def test_events_run_in_order_of_time_and_then_of_scheduling(
    requests: list[tuple[int, bool, int]], step_ns: int
) -> None:
    event_log = EventLog()
    events = EventQueue(event_log.record)
    expected: dict[object, tuple[int, int]] = {}
    for order, (at_ns, is_start, index) in enumerate(requests):
        if is_start:
            events.schedule_start(at_ns, index)
            expected[index] = at_ns, order
        else:
            events.schedule(at_ns, event_log.record, f"event {order}")
            expected[f"event {order}"] = at_ns, order
    for now_ns in range(0, 20 + step_ns, step_ns):
        events.advance(now_ns)
        next_ns = events.next_ns()
        assert next_ns is None or next_ns > now_ns
    assert [name for _, name in event_log.events] == sorted(expected, key=lambda name: expected[name])
    assert [at_ns for at_ns, _ in event_log.events] == sorted(at_ns for at_ns, _ in expected.values())
