"""Lost messages of periodic streams, compared with known losses."""

import random
from itertools import accumulate, cycle, islice

import pytest

from fieldkit.measure.motion import periodic
from fieldkit.measure.motion.periodic import StreamMessage

SENT = 1000


@pytest.mark.parametrize("steps_ms", [(50,), (40, 60), (40, 60, 40, 60, 50), (48, 52)], ids=str)
@pytest.mark.parametrize("share", [0.0, 0.05, 0.2, 0.4])
def test_each_lost_message_is_counted_once_even_if_the_sender_has_a_loop_period(
    steps_ms: tuple[int, ...], share: float
) -> None:
    """An autopilot whose loop takes 20 ms sends 20 messages a second at intervals of 40 and 60 ms."""
    chance = random.Random(7)
    times_ms = list(accumulate(islice(cycle(steps_ms), SENT - 1), initial=0))
    came = [number for number in range(SENT) if number in {0, SENT - 1} or chance.random() >= share]
    numbers = [(times_ms[number] * 1000, number % 256) for number in came]
    stream = [StreamMessage(times_ms[number] * 1000, times_ms[number], at) for at, number in enumerate(came)]
    ended_us = times_ms[-1] * 1000
    assert periodic.lost(numbers, {"ATTITUDE": stream}, ended_us) == (len(came), SENT - len(came))


def test_a_number_that_a_router_filtered_is_no_loss() -> None:
    numbers = [(50_000 * at, 2 * at % 256) for at in range(100)]
    stream = [StreamMessage(50_000 * at, 50 * at, at) for at in range(100)]
    assert periodic.lost(numbers, {"ATTITUDE": stream}, 0) == (100, 0)
