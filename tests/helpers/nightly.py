"""Selection of the values of a parametrized test, and of the number of examples of a property, that CI runs."""

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
        in_ci: The values that CI runs as well; if empty, the first of `values`.
    """
    all_values = list(values)
    ci_values = in_ci or all_values[:1]
    return [value if value in ci_values else pytest.param(value, marks=pytest.mark.nightly) for value in all_values]


def examples(count: int) -> int:
    """Number of examples of a property for `settings`: `count`, but in CI at most as many as in its profile."""
    if settings.get_current_profile_name() != "ci":
        return count
    return min(count, settings.get_profile("ci").max_examples)
