"""Draws of random streams depend on name and number, and not on the order of use."""

import math
import subprocess
import sys
from random import Random

from hypothesis import given
from hypothesis import strategies as st

from sim_backends.radio.core.random_streams import RandomStream, first_draws

NUMBERS = st.lists(st.integers(0, 10_000), min_size=1, max_size=20)


@given(numbers=NUMBERS, seed=st.integers(0, 2**64), order=st.randoms(use_true_random=False))
def test_draws_do_not_depend_on_order(numbers: list[int], seed: int, order: Random) -> None:
    in_order = {number: RandomStream(seed, "a", "b", "loss").draw(number) for number in numbers}
    shuffled = list(numbers)
    order.shuffle(shuffled)
    stream = RandomStream(seed, "a", "b", "loss")
    assert {number: stream.draw(number) for number in shuffled} == in_order


@given(number=st.integers(0, 2**40))
def test_draws_are_in_the_half_open_unit_interval(number: int) -> None:
    assert 0.0 <= RandomStream(1, "x").draw(number) < 1.0


def test_blocks_neither_repeat_nor_overlap() -> None:
    stream = RandomStream(1, "a", "b", "loss")
    draws = [stream.draw(number) for number in range(5000)]
    assert len(set(draws)) == 5000


def test_seed_link_direction_and_purpose_identify_the_stream() -> None:
    names = [
        (1, "a", "b", "loss"),
        (2, "a", "b", "loss"),
        (1, "b", "a", "loss"),
        (1, "a", "b", "jitter"),
        (1, "ab", "", "loss"),
    ]
    assert len({RandomStream(seed, *name).draw(0) for seed, *name in names}) == len(names)


def test_streams_of_the_two_directions_are_uncorrelated() -> None:
    forward, reverse = RandomStream(3, "a", "b", "loss"), RandomStream(3, "b", "a", "loss")
    n = 20_000
    products = math.fsum((forward.draw(i) - 0.5) * (reverse.draw(i) - 0.5) for i in range(n)) / n
    # Standard error of the mean product of two independent uniforms is (1/12) / sqrt(n).
    assert abs(products) < 4 / 12 / math.sqrt(n)


def test_draws_are_the_same_in_every_version() -> None:
    # A recorded value: a change here would change the results of every packet for every seed.
    assert RandomStream(7, "a", "b", "loss").draw(0) == 0.3134544202867149


@given(seed=st.integers(0, 2**64), names=st.lists(st.tuples(st.text(), st.text())), count=st.integers(1, 200))
def test_first_draws_equal_the_draws_of_the_streams(seed: int, names: list[tuple[str, str]], count: int) -> None:
    draws = first_draws(seed, names, count)
    assert draws.tolist() == [RandomStream(seed, *name).first(count).tolist() for name in names]


def test_the_first_draw_imports_no_module() -> None:
    """An import at the first draw would delay the first packet by 7 ms."""
    program = (
        "import sys; from sim_backends.radio.core.random_streams import RandomStream; before = set(sys.modules); "
        "RandomStream(1, 'a').draw(0); print(sorted(set(sys.modules) - before))"
    )
    process = subprocess.run((sys.executable, "-c", program), stdout=subprocess.PIPE, text=True, check=True)
    assert process.stdout == "[]\n"
