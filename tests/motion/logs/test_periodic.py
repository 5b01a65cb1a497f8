"""Lost messages of periodic streams, compared with given losses."""

import random
from collections import Counter
from itertools import accumulate, cycle, islice

import pytest

from fieldkit.motion.logs import periodic
from fieldkit.motion.logs.periodic import StreamMessage

SENT = 1000
REQUESTED = {"ATTITUDE": 50_000, "LOCAL_POSITION_NED": 50_000}


@pytest.mark.parametrize("steps_ms", [(50,), (40, 60), (40, 60, 40, 60, 50), (48, 52)], ids=str)
@pytest.mark.parametrize("share", [0.0, 0.05, 0.2, 0.4])
def test_each_lost_message_is_counted_once_even_if_the_sender_has_a_loop_period(
    steps_ms: tuple[int, ...], share: float
) -> None:
    """An autopilot whose loop takes 20 ms sends 20 messages a second at intervals of 40 and 60 ms."""
    random_generator = random.Random(7)
    times_ms = list(accumulate(islice(cycle(steps_ms), SENT - 1), initial=0))
    arrived_numbers = [
        number for number in range(SENT) if number in {0, SENT - 1} or random_generator.random() >= share
    ]
    numbers = [(times_ms[number] * 1000, number % 256) for number in arrived_numbers]
    stream = [
        StreamMessage(times_ms[number] * 1000, times_ms[number], index)
        for index, number in enumerate(arrived_numbers)
    ]
    ended_us = times_ms[-1] * 1000
    assert periodic.count_messages(numbers, {"ATTITUDE": stream}, ended_us, REQUESTED) == (
        len(arrived_numbers),
        SENT - len(arrived_numbers),
    )


def test_a_sequence_number_filtered_by_a_router_is_not_a_loss() -> None:
    numbers = [(50_000 * index, 2 * index % 256) for index in range(100)]
    stream = [StreamMessage(50_000 * index, 50 * index, index) for index in range(100)]
    assert periodic.count_messages(numbers, {"ATTITUDE": stream}, 0, REQUESTED) == (100, 0)


def late_messages(
    lost_share: float, seed: int, rate_hz: int
) -> tuple[list[tuple[int, int]], dict[str, list[StreamMessage]], int]:
    """Return sequence numbers and streams of an autopilot that sends up to 30 ms late, and the number of losses.

    The mean period is exact, and a router withholds 4 answers per second.
    """
    random_generator = random.Random(seed)
    period_ms = 1000 / rate_hz
    events = [
        (period_ms * (slot + phase) + random_generator.choice((0, 0, 0, 10, 20, 30)), name)
        for slot in range(200)
        for phase, name in ((0, "ATTITUDE"), (0.15, "LOCAL_POSITION_NED"))
    ]
    events += [(250.0 * index + random_generator.uniform(0, 200), "") for index in range(800 // rate_hz)]
    numbers, streams, true_losses, lost_by_stream = (
        list[tuple[int, int]](),
        dict[str, list[StreamMessage]](),
        0,
        Counter[str](),
    )
    for number, (at_ms, name) in enumerate(sorted(events)):
        if name and (name not in streams or random_generator.random() >= lost_share):
            true_losses += lost_by_stream.pop(name, 0)
            numbers.append((round(at_ms * 1e3), number % 256))
            streams.setdefault(name, []).append(StreamMessage(round(at_ms * 1e3), round(at_ms), len(numbers) - 1))
        elif name:
            lost_by_stream[name] += 1
    return numbers, streams, true_losses


@pytest.mark.parametrize("rate_hz", [5, 20])
@pytest.mark.parametrize("share", [0.0, 0.02, 0.2])
def test_late_messages_and_withheld_answers_are_not_counted_as_lost(share: float, rate_hz: int) -> None:
    for seed in range(20):
        numbers, streams, true_losses = late_messages(share, seed, rate_hz)
        n_received, n_lost = periodic.count_messages(numbers, streams, 0, REQUESTED if rate_hz == 20 else None)
        assert n_received == len(numbers)
        assert abs(n_lost - true_losses) <= 1 + 0.02 * true_losses, seed


def test_a_stream_whose_period_is_unknown_is_not_counted() -> None:
    numbers, streams, _ = late_messages(0.2, 1, 20)
    assert periodic.count_messages(numbers, streams, 0) == (0, 0)


def test_the_requested_period_shows_losses_in_every_interval() -> None:
    stream = [StreamMessage(100_000 * index, 100 * index, index) for index in range(50)]
    numbers = [(100_000 * index, 2 * index) for index in range(50)]
    assert periodic.count_messages(numbers, {"ATTITUDE": stream}, 0, REQUESTED) == (50, 49)
    assert periodic.count_messages(numbers, {"ATTITUDE": stream}, 0) == (50, 0)
