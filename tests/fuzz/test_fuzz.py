"""A short hunt with the same inputs each time, what earlier hunts found, and a proof that a hunt finds."""

import random
import re
from collections.abc import Callable
from pathlib import Path

import pytest

from fieldkit.core.errors import EvidenceError
from tests.fuzz import harness, targets
from tests.fuzz.harness import Defect, Target
from tests.fuzz.mutate import MOST_BYTES, mutated
from tests.helpers.nightly import mark_nightly

KEPT = Path(__file__).parent / "kept"


@pytest.mark.parametrize("inputs", mark_nightly([100, 3000]))
def test_a_short_hunt_finds_nothing(inputs: int, tmp_path: Path) -> None:
    *defects, tried = harness.hunted("", 10, inputs, tmp_path)
    assert defects == []
    assert tried == inputs


@pytest.mark.parametrize("path", sorted(KEPT.glob("*.*")), ids=lambda path: path.name)
def test_what_a_hunt_once_found_breaks_nothing_any_more(path: Path) -> None:
    assert harness.replayed(path) is None


def test_every_seed_is_read_or_refused(tmp_path: Path) -> None:
    for target in targets.named(""):
        for seed in target.seeds[:3]:
            assert harness.tried(target, seed, tmp_path / "place") is None, target.name


def _refuses(data: bytes, _: Path) -> None:
    raise EvidenceError("is damaged")


def _recurses(data: bytes, place: Path) -> None:
    _recurses(data, place)


def _fills(data: bytes, _: Path) -> None:
    bytearray(2 * harness.MEMORY_BYTES)


@pytest.mark.parametrize(
    ("read", "what"),
    [
        (_refuses, None),
        (_recurses, "RecursionError at"),
        (_fills, "MemoryError at"),
        (lambda *_: 1 / 0, "ZeroDivision"),
    ],
)
def test_whatever_is_raised_but_our_own_errors_is_told(
    read: Callable[[bytes, Path], object], what: str | None, tmp_path: Path
) -> None:
    found = harness.tried(Target("any", [b""], read), b"x", tmp_path / "place")
    assert found is None if what is None else found is not None and found.startswith(what)


def test_a_pattern_that_takes_the_square_of_its_text_is_found_and_its_input_kept(tmp_path: Path) -> None:
    found, tried = harness.hunted(targets.PLANTED.name, 3, 1, tmp_path)
    assert isinstance(found, Defect)
    assert tried == 1
    assert found.what == "ended by SIGPROF"
    assert harness.replayed(found.input) == "ended by SIGPROF"
    assert re.fullmatch(r"planted\.[0-9a-f]{12}", found.input.name)


def test_the_same_seed_makes_the_same_inputs_and_another_makes_others() -> None:
    seeds = [b"one 12 two\n" * 20, b"other"]
    made = [mutated(seeds[0], seeds, random.Random(number)) for number in (1, 1, *range(2, 200))]
    assert made[0] == made[1]
    assert len(set(made)) > 150
    assert max(map(len, made)) <= MOST_BYTES
