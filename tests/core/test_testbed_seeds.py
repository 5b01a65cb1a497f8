"""A resumed trial draws other random numbers at the same place."""

from fieldkit.core import seeds


def test_a_testbed_that_is_opened_again_has_another_seed_at_the_same_place() -> None:
    assert seeds.testbed_seed(7, 0) == 7
    opened = [seeds.testbed_seed(seed, attempts) for seed in (0, 7, 10**15 - 1) for attempts in range(4)]
    assert len(set(opened)) == len(opened)
    assert max(seeds.testbed_seed(10**15 - 1, attempts) for attempts in (17_999, 18_000, 10**6)) < 2**64
    assert {seeds.place_seed(seeds.testbed_seed(7, attempts)) for attempts in range(4)} == {7}
