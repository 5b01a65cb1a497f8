"""Tables of `fieldkit compare`."""

import argparse
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Final

from fieldkit.analysis import tables, wording
from fieldkit.analysis.cells import Estimate
from fieldkit.analysis.comparable import VARIED, Concern
from fieldkit.analysis.compare import Comparison, Difference, Pair, compare
from fieldkit.analysis.quantities import Quantity, parse_amount, symbols
from fieldkit.cli.display import show_note, table
from fieldkit.core.errors import ConfigurationError, nearest, typed
from fieldkit.core.printing import say
from fieldkit.trial import sources

MISSED: Final = 1

_VARIED: Final = "A and B differ in this, which may be why figures differ"

_EXAMPLES: Final = MappingProxyType({"share": "2%", "s": "5ms", "bit/s": "100kbit/s"})
_DELTA: Final = (
    "delta (Cliff's): of all pairs of a repeat of A and one of B, the share in which B is the larger less that in "
    "which it is the smaller; +1 or -1: the two do not overlap; 0: each is the larger as often"
)
_HEAD: Final = ("quantity", "A", "B", "delta", "verdict")


def show(arguments: argparse.Namespace) -> int:
    """Print the comparison."""
    _demand_two([arguments.a, arguments.b, *arguments.more])
    a, b = sources.find_each([[arguments.a], [arguments.b]], show_note, rebuild=arguments.rebuild)
    by = a.condition(arguments.by)
    thresholds = dict(_threshold(text, a.quantities) for text in arguments.threshold)
    found = compare(a.read(also=by), b.read(also=by), by, thresholds=thresholds)
    _demand_common(found, arguments)
    _demand_measured(found, thresholds)
    if found.refusals and not arguments.force:
        raise ConfigurationError(
            "A and B are not comparable:" + "".join(f"\n  {refusal}" for refusal in found.refusals),
            remedy="run both alike (what a name means: fieldkit columns show NAME); "
            "or, to compare them all the same, add --force",
        )
    for concern in found.concerns:
        show_note(f"{_weight(found, concern)}: {concern}")
    if arguments.format == "table":
        _table(found)
    else:
        say(_FORMATS[arguments.format](found), end="")
    return MISSED if found.missed else 0


def _demand_two(paths: Sequence[Path]) -> None:
    if len(paths) > 2:
        beside = typed("fieldkit", "aggregate", *paths, "--by", "trial,protocol")
        raise ConfigurationError(
            f"two runs are compared, A and B, and {len(paths)} are named",
            remedy="a run of several trials is the folder that they are in, or their table by fieldkit export; "
            f"to see all of these side by side: {beside}",
        )


def _threshold(text: str, known: Mapping[str, Quantity]) -> tuple[str, float]:
    name, _, value = text.partition("=")
    if name not in known:
        raise ConfigurationError(
            f"--threshold: there is no quantity {name!r}",
            remedy=nearest(name, known, f"write for example ip_loss=2%; quantities are {', '.join(known)}"),
        )
    unit = known[name].unit
    if not value:
        remedy = f"write for example {name}={_EXAMPLES.get(unit, f'2{symbols(unit)[-1]}')}"
        raise ConfigurationError(f"--threshold: {text!r} has no value", remedy=remedy)
    limit = parse_amount(value, unit, "threshold")
    if limit == 0:
        raise ConfigurationError(
            f"--threshold: no difference is ever shown to be within {text}", remedy="give what would not matter"
        )
    return name, limit


def _weight(found: Comparison, concern: Concern) -> str:
    """Return what something comes to in which A and B differ."""
    if concern.refuses:
        return "not comparable"
    return _VARIED if concern in found.varied else "may matter"


def _demand_common(found: Comparison, arguments: argparse.Namespace) -> None:
    if all(pair.missing_in for pair in found.pairs):
        has_a, has_b = (
            "; ".join(pair.name for pair in found.pairs if pair.missing_in == other) or "nothing" for other in "BA"
        )
        raise ConfigurationError(
            f"A and B have no condition in common:\n  A has {has_a}\n  B has {has_b}",
            remedy=_other_way(found, arguments),
        )


def _other_way(found: Comparison, arguments: argparse.Namespace) -> str:
    """Return how two runs without a condition in common can be compared: by what does not keep them apart."""
    sides = [[pair.key for pair in found.pairs if pair.missing_in == other] for other in "BA"]
    values = {name: [{key[name] for key in keys} for keys in sides] for name in found.by}
    apart = [name for name, (of_a, of_b) in values.items() if of_a.isdisjoint(of_b)]
    told = [name for name, (of_a, of_b) in values.items() if name not in apart and len(of_a | of_b) > 1]
    by = ("--by", ",".join(told) or "protocol")
    words = ("fieldkit", "compare", arguments.a, arguments.b, *by)
    if len(apart) == 1 and set(apart) <= VARIED and all(len(of) == 1 for of in values[apart[0]]):
        return f"only {apart[0]} differs; to compare one with the other: {typed(*words)}"
    differing = f"they differ in {', '.join(apart)}; " if apart else ""
    return f"{differing}name two runs of the same conditions; or, to compare these: {typed(*words, '--force')}"


def _demand_measured(found: Comparison, thresholds: Mapping[str, float]) -> None:
    measured = {difference.quantity.name for difference in found.differences}
    for name in thresholds:
        if name not in measured:
            raise ConfigurationError(
                f"--threshold: neither A nor B has {name}",
                remedy=nearest(name, measured, f"they have {', '.join(sorted(measured)) or 'no valid repeat'}"),
            )


def _table(found: Comparison) -> None:
    for pair in found.pairs:
        if not pair.missing_in:
            table(_HEAD, _lines(found, pair), title=f"{pair.name}: {_repeats(pair)}", right=(1, 2, 3))
    say(_DELTA)
    say("\n".join(wording.conclusions(found)))


def _markdown(found: Comparison) -> str:
    rows = [
        ("condition", *_HEAD),
        ("---", "---", "---:", "---:", "---:", "---"),
        *((pair.name, *line) for pair in found.pairs if not pair.missing_in for line in _lines(found, pair)),
    ]
    differing = (*found.refusals, *found.varied)
    said = [_DELTA, *wording.conclusions(found), *(f"{_weight(found, concern)}: {concern}" for concern in differing)]
    return (
        "".join(map(tables.markdown_line, rows))
        + "\n"
        + "".join(f"- {tables.markdown_escaped(line)}\n" for line in said)
    )


_FORMATS: Final[Mapping[str, Callable[[Comparison], str]]] = MappingProxyType(
    {"csv": tables.comparison_csv, "json": tables.comparison_json, "markdown": _markdown}
)


def _lines(found: Comparison, pair: Pair) -> list[tuple[str, ...]]:
    figures: list[tuple[str, ...]] = [
        (
            wording.label(difference.quantity),
            _value(difference, difference.a),
            _value(difference, difference.b),
            _delta(difference),
            wording.verdict(difference, found.made),
        )
        for difference in pair.differences
    ]
    words = [(a.label, wording.tallied(a), wording.tallied(b), "", wording.NOT_JUDGED) for a, b in pair.words]
    return figures + words or [("nothing measured", "", "", "", "")]


def _value(one: Difference, side: Estimate | None) -> str:
    if side is None:
        return ""
    of = wording.incomplete(side)
    return wording.amount(wording.comparison_scale(one), side) + (f" ({of})" if of else "")


def _delta(one: Difference) -> str:
    return "" if one.cliffs_delta is None else f"{one.cliffs_delta:+.2f}"


def _repeats(pair: Pair) -> str:
    return "; ".join(f"{name} {wording.counts(cell)}" for name, cell in (("A", pair.a), ("B", pair.b)) if cell)
