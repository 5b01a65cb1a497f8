"""Tables of `fieldkit aggregate`."""

import argparse
from collections.abc import Iterator, Mapping, Sequence
from types import MappingProxyType
from typing import Final

from fieldkit.analysis import lines, tables, wording
from fieldkit.analysis.cells import Cell, aggregate
from fieldkit.analysis.comparable import MIXED_BY, mixtures
from fieldkit.analysis.expectations import Expectation
from fieldkit.analysis.judgements import Judgement, judge_own
from fieldkit.analysis.lines import TableLine
from fieldkit.analysis.planning import more_wanted_of
from fieldkit.analysis.quantities import PER_UNIT, Quantity, parse_amount, symbols
from fieldkit.analysis.repeats import SOURCE, Repeats
from fieldkit.cli import summary
from fieldkit.cli.display import prose, show_note, table
from fieldkit.core.columns import Kind, plain_name
from fieldkit.core.errors import ConfigurationError, EvidenceError
from fieldkit.core.printing import say
from fieldkit.core.units import parse_quantity
from fieldkit.trial import sources
from fieldkit.trial.sources import Sources

_More = Sequence[Mapping[str, int]]
"""Of each cell, how many repeats more each quantity wants; nothing if that was not asked."""

_FOR_PROGRAMS: Final = MappingProxyType({"csv": tables.to_csv, "json": tables.to_json})
_FOR_PAPERS: Final = MappingProxyType({"markdown": tables.to_markdown, "latex": tables.to_latex})
# A paper has room for a delay and a loss; every protocol has one of the two losses.
_PAPER: Final = ("rtt_median_s", "ip_loss", "tcp_byte_loss")
_VALUE: Final = MappingProxyType(
    {Kind.COUNTED: "share", Kind.FLAG: "share", Kind.MEAN: "mean", Kind.MEDIAN: "median"}
)
_WORDS: Final = "choose --format table, markdown, csv or json"
_WIDTHS: Final = "give 2% for shares, 1ms for times, 100kbit/s for rates; or other columns by --quantity"
_UNITS: Final = MappingProxyType({"share": "a share", "s": "a time", "bit/s": "a rate"})


def show(arguments: argparse.Namespace) -> int:
    """Print the cells."""
    form = arguments.format
    found = sources.find(arguments.paths, show_note, rebuild=arguments.rebuild)
    by = found.condition(arguments.by)
    chosen, words = found.chosen(arguments.quantity)
    if words and form == "latex":
        raise ConfigurationError(
            f"--quantity: {words[0].name} is words, which latex has no column for", remedy=_WORDS
        )
    if arguments.width and form in _FOR_PAPERS:
        raise ConfigurationError(f"--width: {form} has no column for it", remedy="choose --format table, csv or json")
    quantities = _by_default(form, found.quantities) if chosen is None else chosen
    counted = list(found.words.values()) if words is None else words
    widths = dict(_width(text, quantities) for text in arguments.width)
    _demand_units(widths, quantities)
    needed = {name for quantity in quantities for name in quantity.needed} | {quantity.name for quantity in counted}
    mixed = {column.name for column in found.columns if plain_name(column.name) in MIXED_BY}
    repeats = found.read({*by, *needed, *mixed, "started_utc_ns"})
    for mixture in mixtures(repeats, by):
        show_note(mixture.removesuffix("."))
    cells = aggregate(repeats, by, quantities=quantities, words=counted)
    more = more_wanted_of(cells, widths) if widths else ()
    if form in _FOR_PROGRAMS:
        say(_FOR_PROGRAMS[form](by, cells, more), end="")
    elif form in _FOR_PAPERS:
        if form == "latex":
            _demand_figures(cells, quantities)
        say(_FOR_PAPERS[form](by, cells, quantities), end="")
    else:
        judgements = _judged(found, repeats, cells, quantities)
        expected = {judgement.expectation.quantity for judgement in judgements}
        every = arguments.all or chosen is not None or bool(widths)
        shown = lines.lines(cells, quantities) if every else lines.of_operator(cells, expected)
        _show(by, cells, shown, more)
        _show_expected(by, cells, judgements)
        _note_rest(cells, shown)
    has = {name for cell in cells for name in (*cell.estimates, *cell.tallies)}
    if missing := [name for name in arguments.quantity if name not in has]:
        show_note(f"no valid repeat has {' or '.join(missing)}")
    return 0


def _by_default(form: str, known: Mapping[str, Quantity]) -> list[Quantity]:
    """Return what is put together where nobody says: all that there is, and in a paper what it has room for."""
    if form != "latex":
        return list(known.values())
    return [one for name in _PAPER for one in known.values() if plain_name(one.name) == name]


def _demand_units(widths: Mapping[str, float], quantities: Sequence[Quantity]) -> None:
    if widths and not any(quantity.unit in widths for quantity in quantities):
        names = [quantity.name for quantity in quantities]
        raise ConfigurationError(
            f"--width: none of these is {_UNITS[next(iter(widths))]}: {', '.join(names)}",
            remedy=_WIDTHS,
        )


def _demand_figures(cells: Sequence[Cell], quantities: Sequence[Quantity]) -> None:
    if not wording.shown(cells, quantities):
        names = " or ".join(quantity.name for quantity in quantities)
        raise EvidenceError(
            f"no valid repeat has {names}: the table would be empty",
            remedy="name others by --quantity; to see what there is: --format table",
        )


def _width(text: str, quantities: Sequence[Quantity]) -> tuple[str, float]:
    """Return the unit of the quantities that a wanted half-width is for, and the half-width in it."""
    units = dict.fromkeys(quantity.unit for quantity in quantities)
    symbol = text.strip().lstrip("0123456789. ")
    own = [unit for unit in units if unit not in PER_UNIT]
    unit = next((unit for unit in (*PER_UNIT, *own) if symbol in symbols(unit)), None)
    if unit is None:
        parse_quantity(text, {symbol: 1.0 for unit in (*PER_UNIT, *own) for symbol in symbols(unit)}, "width")
        raise ConfigurationError(f"--width: {text!r} is not a width", remedy=_WIDTHS)
    width = parse_amount(text, unit, "width")
    if width <= 0:
        raise ConfigurationError(f"--width: {text!r} is not above zero", remedy="write for example --width 2%")
    return unit, width


def _note_rest(cells: Sequence[Cell], shown: Sequence[TableLine]) -> None:
    """Print a note on the quantities that are not shown."""
    names = {quantity.name for line in shown for quantity in line.quantities}
    if left_out := len({quantity.name for quantity in wording.measured(cells)} - names):
        prose(f"{summary.more(left_out)}: add --all")


def _show(by: Sequence[str], cells: Sequence[Cell], shown: Sequence[TableLine], more: _More) -> None:
    """Print a table of the repeats, and one per line of `shown`."""
    counts = [{"valid": str(cell.n_valid), "void": str(cell.n_void), "failed": str(cell.n_failed)} for cell in cells]
    _show_one("repeats", by, cells, counts)
    apart, _ = wording.told_by(by, cells)
    for line in shown:
        having = [cell for cell in cells if line.estimate(cell) or line.is_lacking(cell)]
        scale = line.scale(having)
        figures = [_figures(line, cell, scale) for cell in having]
        if any(quantity.name in wanted for wanted in more for quantity in line.quantities):
            figures = [
                {**figure, "more": str(_wanted(line, cell, more[cells.index(cell)]))}
                for figure, cell in zip(figures, having, strict=True)
            ]
        if having:
            _show_one(scale.head(line.label.removesuffix(", median")), apart, having, figures)
    for name, label in wording.worded(cells).items():
        having = [cell for cell in cells if name in cell.tallies]
        figures = [
            {"n": _n(cell.tallies[name].n, cell), "repeats with each": wording.tally(cell, name)} for cell in having
        ]
        _show_one(label, apart, having, figures, words=1)
    for caution in wording.cautions(cells, {quantity.name for line in shown for quantity in line.quantities}):
        prose(caution)


def _judged(
    found: Sources, repeats: Repeats, cells: Sequence[Cell], quantities: Sequence[Quantity]
) -> Sequence[Judgement]:
    """Return what cells say of what their trials expect of the figures that are shown."""
    shown = {quantity.name for quantity in quantities}
    if not (expected := found.expectations()):
        return ()
    rows = repeats.groups(tuple(cells[0].key))

    def of(cell: Cell) -> Iterator[Expectation]:
        for source in dict.fromkeys(repeats.texts[SOURCE][rows[tuple(cell.key.values())]]):
            yield from (one for one in expected.get(source, ()) if one.quantity in shown)

    return judge_own((cell, of(cell)) for cell in cells)


def _show_expected(by: Sequence[str], cells: Sequence[Cell], judgements: Sequence[Judgement]) -> None:
    """Print whether expectations hold, a line for each condition; nothing where nothing was expected."""
    apart, _ = wording.told_by(by, cells)
    rows = []
    for judgement in judgements:
        expected, _, *said = wording.judged(judgement)
        rows.append(
            (expected, *(wording.key(judgement.cell, name) if judgement.cell else "" for name in apart), *said)
        )
    if rows:
        head = ("expected", *apart, "measured", "95 % interval", "")
        table(head, rows, fold=(0, len(head) - 1))


def _show_one(
    title: str, by: Sequence[str], cells: Sequence[Cell], figures: Sequence[Mapping[str, str]], *, words: int = 0
) -> None:
    """Print a line per cell; what they have in common goes into the title. The last `words` figures are words."""
    apart, common = wording.told_by(by, cells)
    said = ", ".join([title, *dict.fromkeys(wording.key(cells[0], name) for name in common)])
    head = [*apart, *figures[0]]
    rows = [
        [*(wording.key(cell, name) for name in apart), *one.values()]
        for cell, one in zip(cells, figures, strict=True)
    ]
    table(head, rows, title=said, right=range(len(apart), len(head) - words))


def _wanted(line: TableLine, cell: Cell, more: Mapping[str, int]) -> int | str:
    """Return how many repeats more a cell wants, empty where that is not known."""
    estimate = line.estimate(cell)
    return more.get(estimate.quantity.name, "") if estimate else ""


def _n(n: int, cell: Cell) -> str:
    """Return how many valid repeats have something: `5`, or `4 of 5`."""
    return lines.part_of(n, cell) or str(n)


def _figures(line: TableLine, cell: Cell, scale: wording.Scale) -> dict[str, str]:
    """Return the figures of a cell by head; of a cell that lacks them, empty ones and how many repeats it has."""
    estimate, quantity = line.estimate(cell), line.quantities[0]
    kind = quantity.kind
    heads = ["n", *(("sent",) if kind is Kind.COUNTED else ()), _VALUE[kind], "95 % interval"]
    if kind is not Kind.FLAG:
        heads += ["Wilson" if kind is Kind.COUNTED else "mean", "median", "p95"]
    if quantity.at_least:
        heads.append("not ended")
    if estimate is None:
        return dict.fromkeys(heads, "") | {"n": lines.part_of(0, cell)}
    figures = {
        "n": _n(estimate.n, cell),
        "sent": "" if estimate.trials is None else str(estimate.trials),
        "Wilson": scale.interval(estimate.wilson_low, estimate.wilson_high),
        "mean": wording.number(scale, estimate, estimate.mean),
        "median": scale.number(estimate.median),
        "p95": wording.number(scale, estimate, estimate.p95),
        _VALUE[kind]: wording.number(scale, estimate),
        "95 % interval": wording.interval(scale, estimate),
        "not ended": f"{estimate.n_censored} of {estimate.n}",
    }
    return {head: figures[head] for head in dict.fromkeys(heads)}
