"""What is planned happens when it was planned for, and a beginning that moved leaves nothing behind."""

from hypothesis import given
from hypothesis import strategies as st

from sim_backends.radio.event_queue import EventQueue


class Diary:
    def __init__(self) -> None:
        self.seen: list[tuple[int, object]] = []

    def note(self, at_ns: int, what: object) -> None:
        self.seen.append((at_ns, what))


def test_what_comes_at_once_comes_as_it_was_planned() -> None:
    diary = Diary()
    events = EventQueue(diary.note)
    events.at(10, diary.note, "first")
    events.begin(10, 1)
    events.at(10, diary.note, "third")
    events.begin(10, 2)
    events.begin(10, 1)
    events.advance(10)
    assert diary.seen == [(10, "first"), (10, "third"), (10, 2), (10, 1)], "who is planned anew comes last"


def test_a_beginning_that_moved_happens_once() -> None:
    diary = Diary()
    events = EventQueue(diary.note)
    for at_ns in (5, 30, 20):
        events.begin(at_ns, 7)
        assert (events.beginnings[7][0], events.next_ns()) == (at_ns, at_ns)
    events.advance(19)
    assert diary.seen == []
    events.advance(100)
    assert diary.seen == [(20, 7)]
    assert (events.beginnings, events.next_ns()) == ({}, None)


def test_a_call_may_plan_for_the_same_time() -> None:
    diary = Diary()
    events = EventQueue(lambda at_ns, index: events.at(at_ns, diary.note, index))
    events.begin(10, 3)
    events.advance(10)
    assert diary.seen == [(10, 3)]


@given(st.lists(st.tuples(st.integers(0, 20), st.booleans(), st.integers(0, 4))), st.integers(1, 7))
def test_everything_happens_in_order_of_time_and_then_of_planning(
    plans: list[tuple[int, bool, int]], step_ns: int
) -> None:
    diary = Diary()
    events = EventQueue(diary.note)
    expected: dict[object, tuple[int, int]] = {}
    for order, (at_ns, begins, index) in enumerate(plans):
        if begins:
            events.begin(at_ns, index)
            expected[index] = at_ns, order
        else:
            events.at(at_ns, diary.note, f"event {order}")
            expected[f"event {order}"] = at_ns, order
    for now_ns in range(0, 20 + step_ns, step_ns):
        events.advance(now_ns)
        next_ns = events.next_ns()
        assert next_ns is None or next_ns > now_ns
    assert [what for _, what in diary.seen] == sorted(expected, key=lambda what: expected[what])
    assert [at_ns for at_ns, _ in diary.seen] == sorted(at_ns for at_ns, _ in expected.values())
