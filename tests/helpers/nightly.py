"""Which values of a parametrized test CI runs."""

from collections.abc import Collection, Iterable
from typing import TypeVar

import pytest
from _pytest.mark import ParameterSet

T = TypeVar("T")


def others_at_night(values: Iterable[T], *, in_ci: Collection[T] = ()) -> list[T | ParameterSet]:
    """Return values for `parametrize`, all but some of which are left to `make nightly`.

    Args:
        values: The values.
        in_ci: Those that CI runs, too; without any, the first of the values.
    """
    every = list(values)
    kept = in_ci or every[:1]
    return [value if value in kept else pytest.param(value, marks=pytest.mark.nightly) for value in every]
