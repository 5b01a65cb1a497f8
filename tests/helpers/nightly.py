"""Selects which values of a parametrized test, and how many examples of a property test, CI runs."""

from collections.abc import Collection, Iterable
from typing import TypeVar

import pytest
from _pytest.mark import ParameterSet
from hypothesis import settings

T = TypeVar("T")


def mark_nightly(values: Iterable[T], *, in_ci: Collection[T] = ()) -> list[T | ParameterSet]:
    """Values for `pytest.mark.parametrize`; those that CI skips are marked `nightly` and run with `make nightly`.

    Args:
        values: All values of the parameter.
        in_ci: The values that CI also runs; if empty, the first of `values`.
    """
    all_values = list(values)
    ci_values = in_ci or all_values[:1]
    return [value if value in ci_values else pytest.param(value, marks=pytest.mark.nightly) for value in all_values]


def examples(count: int) -> int:
    """The `max_examples` of a property test: `count`, but in CI at most the number in the profile of CI."""
    if settings.get_current_profile_name() != "ci":
        return count
    return min(count, settings.get_profile("ci").max_examples)
