"""Tables of `fieldkit compare`."""

import argparse
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Final

from fieldkit.analysis import comparison_results, paper_tables, wording
from fieldkit.analysis.cells import Estimate
from fieldkit.analysis.comparable import MARKS, NO_MARKS, VARIED, Concern
from fieldkit.analysis.compare import Comparison, Difference, Pair, compare
from fieldkit.analysis.quantities import Quantity, parse_amount, symbols
from fieldkit.cli import comparison_sides
from fieldkit.cli.display import print_table, show_note
from fieldkit.core.errors import ConfigurationError, did_you_mean, shell_command
from fieldkit.core.text import print_text

THRESHOLD_MISSED: Final = 1

_VARIED_TEXT: Final = "A and B differ in this, which may explain differences between their figures"

_EXAMPLES: Final = MappingProxyType({"share": "2%", "s": "5ms", "bit/s": "100kbit/s"})
_DELTA: Final = (
    "delta (Cliff's): among all pairs of a repeat of A and a repeat of B, the share of pairs with the larger value "
    "in B minus the share with the smaller value in B; +1 or -1: no overlap; 0: both shares are equal"
)
_HEAD: Final = ("quantity", "A", "B", "delta", "verdict")


def show(arguments: argparse.Namespace) -> int:
    """Print the comparison."""
    sides = comparison_sides.read(arguments)
    thresholds = dict(_parse_threshold(text, sides.sources.quantities) for text in arguments.threshold)
    comparison = compare(sides.a, sides.b, sides.by, thresholds=thresholds, varied=sides.varied)
    _require_common_condition(comparison, arguments)
    _require_measured(comparison, thresholds)
    if comparison.refusals and not arguments.force:
        raise ConfigurationError(
            "A and B are not comparable:" + "".join(f"\n  {refusal}" for refusal in comparison.refusals),
            remedy=f"run both under the same conditions (to look up a name: fieldkit columns show NAME)"
            f"{_marks_remedy(comparison)}; or, to compare them anyway, add --force",
        )
    for concern in comparison.concerns:
        show_note(f"{_concern_text(comparison, concern)}: {concern}")
    if arguments.format == "table":
        _print_comparison(comparison)
    else:
        print_text(_FORMATS[arguments.format](comparison), end="")
    return THRESHOLD_MISSED if comparison.exceeds_threshold else 0


def _marks_remedy(comparison: Comparison) -> str:
    """Return the option that excludes repeats with marks (conditions that can explain a difference).

    Empty if marks are not a reason for the refusal.
    """
    has_marks = any(refusal.what.startswith(f"{MARKS}, ") for refusal in comparison.refusals)
    return f""", or exclude marked repeats: --where '{MARKS} == "{NO_MARKS}"'""" if has_marks else ""


def _parse_threshold(text: str, quantities: Mapping[str, Quantity]) -> tuple[str, float]:
    name, _, value = text.partition("=")
    if name not in quantities:
        raise ConfigurationError(
            f"--threshold: there is no quantity {name!r}",
            remedy=did_you_mean(
                name, quantities, f"write for example ip_loss=2%; quantities are {', '.join(quantities)}"
            ),
        )
    unit = quantities[name].unit
    if not value:
        remedy = f"write for example {name}={_EXAMPLES.get(unit, f'2{symbols(unit)[-1]}')}"
        raise ConfigurationError(f"--threshold: {text!r} has no value", remedy=remedy)
    limit = parse_amount(value, unit, "threshold")
    if limit == 0:
        raise ConfigurationError(
            f"--threshold: no measurement can show a difference within {text}",
            remedy="give the largest difference that does not matter",
        )
    return name, limit


def _concern_text(comparison: Comparison, concern: Concern) -> str:
    """Return the effect of a difference between the conditions of A and B, in words."""
    if concern.refuses:
        return "not comparable"
    return _VARIED_TEXT if concern in comparison.varied else "may matter"


def _require_common_condition(comparison: Comparison, arguments: argparse.Namespace) -> None:
    if all(pair.missing_in for pair in comparison.pairs):
        # No condition is common, so the conditions that B lacks are those of A, and vice versa.
        conditions_a, conditions_b = (
            "; ".join(pair.name for pair in comparison.pairs if pair.missing_in == other) or "nothing"
            for other in "BA"
        )
        raise ConfigurationError(
            f"A and B have no condition in common:\n  A has {conditions_a}\n  B has {conditions_b}",
            remedy=_pairing_remedy(comparison, arguments),
        )


def _pairing_remedy(comparison: Comparison, arguments: argparse.Namespace) -> str:
    """Return a remedy for two runs without a common condition: columns by which they can be paired."""
    # A has the conditions that are missing in B, and vice versa.
    sides = [[pair.key for pair in comparison.pairs if pair.missing_in == other] for other in "BA"]
    values = {name: [{key[name] for key in keys} for keys in sides] for name in comparison.by}
    disjoint = [name for name, (values_a, values_b) in values.items() if values_a.isdisjoint(values_b)]
    distinguishing = [
        name for name, (values_a, values_b) in values.items() if name not in disjoint and len(values_a | values_b) > 1
    ]
    by = ("--by", ",".join(distinguishing) or "protocol")
    options = ("--between", arguments.between) if arguments.between else ()
    paths = [arguments.a] if arguments.b is None else [arguments.a, arguments.b]
    words = ("fieldkit", "compare", *paths, *options, *by)
    if (
        len(disjoint) == 1
        and set(disjoint) <= VARIED
        and all(len(side_values) == 1 for side_values in values[disjoint[0]])
    ):
        return f"only {disjoint[0]} differs; to compare one with the other: {shell_command(*words)}"
    differing = f"they differ in {', '.join(disjoint)}; " if disjoint else ""
    return (
        f"{differing}give two runs with the same conditions; or, to compare these: {shell_command(*words, '--force')}"
    )


def _require_measured(comparison: Comparison, thresholds: Mapping[str, float]) -> None:
    measured = {difference.quantity.name for difference in comparison.differences}
    for name in thresholds:
        if name not in measured:
            raise ConfigurationError(
                f"--threshold: neither A nor B has {name}",
                remedy=did_you_mean(name, measured, f"they have {', '.join(sorted(measured)) or 'no valid repeat'}"),
            )


def _print_comparison(comparison: Comparison) -> None:
    for pair in comparison.pairs:
        if not pair.missing_in:
            print_table(_HEAD, _lines(comparison, pair), title=f"{pair.name}: {_repeats(pair)}", right=(1, 2, 3))
    print_text(_DELTA)
    print_text("\n".join(comparison_results.conclusions(comparison)))


def _markdown(comparison: Comparison) -> str:
    rows = [
        ("condition", *_HEAD),
        ("---", "---", "---:", "---:", "---:", "---"),
        *(
            (pair.name, *line)
            for pair in comparison.pairs
            if not pair.missing_in
            for line in _lines(comparison, pair)
        ),
    ]
    differing = (*comparison.refusals, *comparison.varied)
    notes = [
        _DELTA,
        *comparison_results.conclusions(comparison),
        *(f"{_concern_text(comparison, concern)}: {concern}" for concern in differing),
    ]
    return (
        "".join(map(paper_tables.markdown_line, rows))
        + "\n"
        + "".join(f"- {paper_tables.markdown_escaped(line)}\n" for line in notes)
    )


_FORMATS: Final[Mapping[str, Callable[[Comparison], str]]] = MappingProxyType(
    {"csv": comparison_results.to_csv, "json": comparison_results.to_json, "markdown": _markdown}
)


def _lines(comparison: Comparison, pair: Pair) -> list[tuple[str, ...]]:
    """Return the table rows of a condition: one per figure, then one per column of words."""
    figures: list[tuple[str, ...]] = [
        (
            wording.label(difference.quantity),
            _value(difference, difference.a),
            _value(difference, difference.b),
            _delta(difference),
            comparison_results.verdict(difference, comparison.n_compared),
        )
        for difference in pair.differences
    ]
    words = [
        (a.label, wording.tally_text(a), wording.tally_text(b), "", comparison_results.NOT_JUDGED)
        for a, b in pair.words
    ]
    return figures + words or [("nothing measured", "", "", "", "")]


def _value(difference: Difference, side: Estimate | None) -> str:
    if side is None:
        return ""
    part = wording.incomplete(side)
    return wording.amount(comparison_results.comparison_scale(difference), side) + (f" ({part})" if part else "")


def _delta(difference: Difference) -> str:
    return "" if difference.cliffs_delta is None else f"{difference.cliffs_delta:+.2f}"


def _repeats(pair: Pair) -> str:
    return "; ".join(f"{name} {wording.counts(cell)}" for name, cell in (("A", pair.a), ("B", pair.b)) if cell)
