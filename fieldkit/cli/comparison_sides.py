"""The two sides of `fieldkit compare`: two runs, or two values of a column."""

import argparse
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from fieldkit.analysis.compare import PAIRED_BY
from fieldkit.analysis.repeats import Repeats
from fieldkit.cli.display import show_note
from fieldkit.core.columns import cell_text
from fieldkit.core.errors import ConfigurationError, did_you_mean, shell_command
from fieldkit.trial.stored import sources
from fieldkit.trial.stored.sources import Sources

_DISTANCE: Final = frozenset({"distance", "distance_m"})
_SETTINGS_HASHES: Final = frozenset({"procedure_sha256", "profiles_sha256"})
"""Columns with hashes that depend on the settings of a sweep."""
_EXAMPLE: Final = "write for example --between policy=sliding_window,scheduled"


@dataclass(frozen=True)
class Sides:
    """The attempts that are compared.

    Attributes:
        a: Attempts of A.
        b: Attempts of B.
        by: Columns that identify a condition.
        sources: The tables of A. They declare the columns and quantities of both runs.
        varied: Columns that may differ, because they are the variable of the comparison.
    """

    a: Repeats
    b: Repeats
    by: tuple[str, ...]
    sources: Sources
    varied: frozenset[str]


def read(arguments: argparse.Namespace) -> Sides:
    """Return the attempts of both sides.

    Raises:
        ConfigurationError: The number of paths is wrong, or a path contains no measurements; see `sources.find`.
    """
    paths = [arguments.a, *([] if arguments.b is None else [arguments.b]), *arguments.more]
    if len(paths) == 1 and arguments.between:
        paths *= 2
    _require_two(paths)
    runs = sources.find_each(
        [[path] for path in paths], show_note, rebuild=arguments.rebuild, use_index=arguments.use_index
    )
    a, b = (run.with_filter(arguments.where) for run in runs)
    by = a.condition(arguments.by)
    is_default = arguments.by == ",".join(PAIRED_BY)
    if is_default and a.sweep_condition:  # two sweeps are paired by the factors that both have
        by = tuple(name for name in a.sweep_condition if name in b.sweep_condition) or by
    if not arguments.between:
        return Sides(a.read(also=by), b.read(also=by), by, a, frozenset())
    column, _, values = arguments.between.partition("=")
    (name,) = a.condition(column, option="--between")
    varied = next((names for names in (_DISTANCE, *_columns_by_factor(a)) if name in names), frozenset({name}))
    if is_default:
        by = tuple(condition_column for condition_column in by if condition_column not in varied)
    rows = [run.read(also=(*by, name)) for run in (a, b)]
    value_a, value_b = _parse_two_values(rows, name, values)
    is_sweep = bool(a.sweep_condition) and paths[0] == paths[1]
    return Sides(
        _with_value(rows[0], name, value_a),
        _with_value(rows[1], name, value_b),
        by,
        a,
        varied | (_SETTINGS_HASHES if is_sweep else frozenset()),
    )


def _columns_by_factor(run: Sources) -> list[frozenset[str]]:
    """Return the columns of each factor (a setting that a sweep varies).

    One has the values as text, as written in the command. If they are numbers, another column has them as numbers.
    """
    return [frozenset(names) for names in run.sweep_columns.items()]


def _require_two(paths: Sequence[Path]) -> None:
    if len(paths) == 1:
        raise ConfigurationError(
            "compare needs two runs, A and B, and one is given",
            remedy=f"name another run; or, to compare two values of a column in this run, {_EXAMPLE}",
        )
    if len(paths) > 2:
        command = shell_command("fieldkit", "aggregate", *paths, "--by", "trial,protocol")
        raise ConfigurationError(
            f"compare needs two runs, A and B, and {len(paths)} are given",
            remedy="for a run of several trials give their folder, or their table from fieldkit export; "
            f"to show all of these in one table: {command}",
        )


def _texts(rows: Repeats, name: str) -> list[str]:
    return [cell_text(value) for value in rows.column(name)]


def _parse_two_values(sides: Sequence[Repeats], name: str, text: str) -> tuple[str, str]:
    """Return the values of A and B; a value may contain commas.

    Raises:
        ConfigurationError: The text does not contain two different values that occur in the data.
    """
    values_a, values_b = (dict.fromkeys(_texts(side, name)) for side in sides)
    parts = text.split(",")
    splits = [(",".join(parts[:count]), ",".join(parts[count:])) for count in range(1, len(parts))]
    if not splits:
        raise ConfigurationError(f"--between: {name}={text}: write two values, separated by a comma", remedy=_EXAMPLE)
    for first, second in splits:
        if first in values_a and second in values_b:
            if first == second:
                raise ConfigurationError(f"--between: {name}={text}: write two different values", remedy=_EXAMPLE)
            return first, second
    first, second = splits[0]
    missing, values = (first, values_a) if first not in values_a else (second, values_b)
    raise ConfigurationError(
        f"--between: no attempt has {name} {missing!r}",
        remedy=did_you_mean(missing, values, f"it is one of: {', '.join(values)}"),
    )


def _with_value(rows: Repeats, name: str, value: str) -> Repeats:
    return rows.where(np.array([text == value for text in _texts(rows, name)]))
