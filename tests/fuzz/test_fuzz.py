"""A short reproducible search, the inputs that earlier searches found, and a test that a search finds defects."""

import random
import re
from collections.abc import Callable
from pathlib import Path

import pytest

from fieldkit.core.errors import EvidenceError
from tests.fuzz import harness, targets
from tests.fuzz.harness import Defect, Target
from tests.fuzz.mutate import MAX_BYTES, mutate
from tests.helpers.nightly import mark_nightly

SAVED_INPUTS = Path(__file__).parent / "kept"


@pytest.mark.parametrize("inputs", mark_nightly([100, 3000]))
def test_a_short_search_finds_no_defect(inputs: int, tmp_path: Path) -> None:
    *defects, input_count = harness.search("", 10, inputs, tmp_path)
    assert defects == []
    assert input_count == inputs


def test_inputs_of_earlier_searches_break_no_reader() -> None:
    """All inputs are read in one process, because each process imports all readers."""
    paths = sorted(SAVED_INPUTS.glob("*.*"))
    assert paths
    failures = zip(paths, harness.replay(paths), strict=True)
    assert [(path.name, failure) for path, failure in failures if failure is not None] == []


def test_every_seed_is_read_or_rejected(tmp_path: Path) -> None:
    for target in targets.select_targets(""):
        for seed in target.seeds[:3]:
            assert harness.try_input(target, seed, tmp_path / "place") is None, target.name


def _raise_evidence_error(data: bytes, _: Path) -> None:
    raise EvidenceError("is damaged")


def _recurse(data: bytes, place: Path) -> None:
    _recurse(data, place)


def _exhaust_memory(data: bytes, _: Path) -> None:
    bytearray(2 * harness.MEMORY_BYTES)


@pytest.mark.parametrize(
    ("read", "failure"),
    [
        (_raise_evidence_error, None),
        (_recurse, "RecursionError at"),
        (_exhaust_memory, "MemoryError at"),
        (lambda *_: 1 / 0, "ZeroDivision"),
    ],
)
def test_all_exceptions_except_errors_of_fieldkit_are_reported(
    read: Callable[[bytes, Path], object], failure: str | None, tmp_path: Path
) -> None:
    result = harness.try_input(Target("any", [b""], read), b"x", tmp_path / "place")
    assert result is None if failure is None else result is not None and result.startswith(failure)


def test_a_pattern_with_quadratic_time_is_found_and_its_input_is_stored(tmp_path: Path) -> None:
    result, input_count = harness.search(targets.PLANTED.name, 3, 1, tmp_path)
    assert isinstance(result, Defect)
    assert input_count == 1
    assert result.failure == "ended by SIGPROF"
    assert harness.replay([result.input]) == ["ended by SIGPROF"]
    assert re.fullmatch(r"planted\.[0-9a-f]{12}", result.input.name)


def test_equal_seeds_give_equal_inputs() -> None:
    seeds = [b"one 12 two\n" * 20, b"other"]
    inputs = [mutate(seeds[0], seeds, random.Random(number)) for number in (1, 1, *range(2, 200))]
    assert inputs[0] == inputs[1]
    assert len(set(inputs)) > 150
    assert max(map(len, inputs)) <= MAX_BYTES
