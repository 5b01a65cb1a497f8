"""Tables of `fieldkit aggregate`."""

import argparse
from collections.abc import Iterator, Mapping, Sequence
from types import MappingProxyType
from typing import Final

from fieldkit.analysis import paper_tables, result_tables, table_lines, wording
from fieldkit.analysis.cells import Cell, aggregate
from fieldkit.analysis.comparable import MIXTURE_COLUMNS, mixtures
from fieldkit.analysis.expectations import Expectation
from fieldkit.analysis.judgement_words import judgement_texts
from fieldkit.analysis.judgements import Judgement, judge_by_trial
from fieldkit.analysis.quantities import PER_UNIT, Quantity, parse_amount, symbols
from fieldkit.analysis.repeats import SOURCE, Repeats
from fieldkit.analysis.sample_size import additional_repeats_by_cell
from fieldkit.analysis.table_lines import TableLine
from fieldkit.cli import results
from fieldkit.cli.display import print_folded, print_table, show_note
from fieldkit.cli.shared_arguments import CONDITION
from fieldkit.core.columns import Kind, plain_name
from fieldkit.core.errors import ConfigurationError, EvidenceError
from fieldkit.core.executors import Workers
from fieldkit.core.text import print_text
from fieldkit.core.units import parse_quantity
from fieldkit.trial.stored import sources
from fieldkit.trial.stored.sources import Sources

_AdditionalRepeats = Sequence[Mapping[str, int]]
"""For each cell (the repeats of one condition), the number of additional repeats per quantity.

Empty unless `--width` is given.
"""

_FOR_PROGRAMS: Final = MappingProxyType({"csv": result_tables.to_csv, "json": result_tables.to_json})
_FOR_PAPERS: Final = MappingProxyType({"markdown": paper_tables.to_markdown, "latex": paper_tables.to_latex})
# A table in a paper has space for one delay and one loss. Each protocol has one of these two losses.
_PAPER_COLUMNS: Final = ("rtt_median_s", "ip_loss", "tcp_byte_loss")
_VALUE_HEADS: Final = MappingProxyType(
    {Kind.COUNTED: "share", Kind.FLAG: "share", Kind.MEAN: "mean", Kind.MEDIAN: "median"}
)
_WORDS_REMEDY: Final = "choose --format table, markdown, csv or json"
_WIDTH_REMEDY: Final = (
    "give 2% for shares, 1ms for times, 100kbit/s for rates; or choose other columns with --quantity"
)
_UNITS: Final = MappingProxyType({"share": "a share", "s": "a time", "bit/s": "a rate"})


def show(arguments: argparse.Namespace) -> int:
    """Aggregate the repeats, print the result in the format of `--format`, and return the exit code."""
    output_format = arguments.format
    data = sources.find(
        arguments.paths,
        show_note,
        rebuild=arguments.rebuild,
        workers=Workers(arguments.jobs, arguments.cluster),
        use_index=arguments.use_index,
    ).with_filter(arguments.where)
    condition_columns = (arguments.by == CONDITION and data.sweep_condition) or data.condition(arguments.by)
    selected, words = data.select(arguments.quantity)
    if words and output_format == "latex":
        raise ConfigurationError(
            f"--quantity: the values of {words[0].name} are words, and latex tables have no column for words",
            remedy=_WORDS_REMEDY,
        )
    if arguments.width and output_format in _FOR_PAPERS:
        raise ConfigurationError(
            f"--width: {output_format} has no column for it", remedy="choose --format table, csv or json"
        )
    quantities = _default_quantities(output_format, data.quantities) if selected is None else selected
    text_columns = list(data.words.values()) if words is None else words
    widths = dict(_parse_width(text, quantities) for text in arguments.width)
    _require_units(widths, quantities)
    needed_names = {name for quantity in quantities for name in quantity.needed_columns} | {
        quantity.name for quantity in text_columns
    }
    mixture_names = {column.name for column in data.columns if plain_name(column.name) in MIXTURE_COLUMNS}
    repeats = data.read({*condition_columns, *needed_names, *mixture_names, "started_utc_ns"})
    for mixture in mixtures(repeats, condition_columns):  # cells that mix repeats with different settings
        show_note(mixture.removesuffix("."))
    cells = aggregate(repeats, condition_columns, quantities=quantities, words=text_columns)
    additional = additional_repeats_by_cell(cells, widths) if widths else ()
    if output_format in _FOR_PROGRAMS:
        print_text(_FOR_PROGRAMS[output_format](condition_columns, cells, additional), end="")
    elif output_format in _FOR_PAPERS:
        if output_format == "latex":
            _require_values(cells, quantities)
        print_text(_FOR_PAPERS[output_format](condition_columns, cells, quantities), end="")
    else:
        judgements = _shown_judgements(data, repeats, cells, quantities)
        expected = {judgement.expectation.quantity for judgement in judgements}
        show_all = arguments.all or selected is not None or bool(widths)
        shown_lines = (
            table_lines.lines(cells, quantities) if show_all else table_lines.operator_lines(cells, expected)
        )
        _print_tables(condition_columns, cells, shown_lines, additional)
        _print_judgements(condition_columns, cells, judgements)
        _note_omitted(cells, shown_lines)
    available = {name for cell in cells for name in (*cell.estimates, *cell.tallies)}
    if missing := [name for name in arguments.quantity if name not in available]:
        show_note(f"no valid repeat has {' or '.join(missing)}")
    return 0


def _default_quantities(output_format: str, available: Mapping[str, Quantity]) -> list[Quantity]:
    """Return the quantities to aggregate without `--quantity`: all, or for latex the quantities for a paper."""
    if output_format != "latex":
        return list(available.values())
    return [
        quantity for name in _PAPER_COLUMNS for quantity in available.values() if plain_name(quantity.name) == name
    ]


def _require_units(widths: Mapping[str, float], quantities: Sequence[Quantity]) -> None:
    if widths and not any(quantity.unit in widths for quantity in quantities):
        names = [quantity.name for quantity in quantities]
        raise ConfigurationError(
            f"--width: none of these is {_UNITS[next(iter(widths))]}: {', '.join(names)}",
            remedy=_WIDTH_REMEDY,
        )


def _require_values(cells: Sequence[Cell], quantities: Sequence[Quantity]) -> None:
    if not wording.with_estimates(cells, quantities):
        names = " or ".join(quantity.name for quantity in quantities)
        raise EvidenceError(
            f"no valid repeat has a value of {names}, so the table would be empty",
            remedy="choose other columns with --quantity; to list the available ones: --format table",
        )


def _parse_width(text: str, quantities: Sequence[Quantity]) -> tuple[str, float]:
    """Return the unit of the quantities that `--width` applies to, and the half-width in this unit."""
    units = dict.fromkeys(quantity.unit for quantity in quantities)
    symbol = text.strip().lstrip("0123456789. ")
    other_units = [unit for unit in units if unit not in PER_UNIT]
    unit = next((unit for unit in (*PER_UNIT, *other_units) if symbol in symbols(unit)), None)
    if unit is None:
        # Raises an error that names the valid units if the number or the unit is invalid.
        parse_quantity(text, {symbol: 1.0 for unit in (*PER_UNIT, *other_units) for symbol in symbols(unit)}, "width")
        raise ConfigurationError(f"--width: {text!r} is not a width", remedy=_WIDTH_REMEDY)
    width = parse_amount(text, unit, "width")
    if width <= 0:
        raise ConfigurationError(f"--width: {text!r} is not above zero", remedy="write for example --width 2%")
    return unit, width


def _note_omitted(cells: Sequence[Cell], shown_lines: Sequence[TableLine]) -> None:
    """Print the number of quantities that are not shown."""
    names = {quantity.name for line in shown_lines for quantity in line.quantities}
    if omitted_count := len({quantity.name for quantity in wording.measured(cells)} - names):
        print_folded(f"{results.more_quantities_text(omitted_count)}: add --all")


def _print_tables(
    condition_columns: Sequence[str],
    cells: Sequence[Cell],
    shown_lines: Sequence[TableLine],
    additional: _AdditionalRepeats,
) -> None:
    """Print a table of the repeats, and a table for each line of `shown_lines`."""
    counts = [{"valid": str(cell.n_valid), "void": str(cell.n_void), "failed": str(cell.n_failed)} for cell in cells]
    _print_table("repeats", condition_columns, cells, counts)
    differing_columns, _ = wording.varying_and_common(condition_columns, cells)
    for line in shown_lines:
        measured_cells = [cell for cell in cells if line.estimate(cell) or line.lacks_value(cell)]
        scale = line.scale(measured_cells)
        figures = [_figures(line, cell, scale) for cell in measured_cells]
        if any(quantity.name in cell_repeats for cell_repeats in additional for quantity in line.quantities):
            figures = [
                {**figure, "more": str(_additional_repeats(line, cell, additional[cells.index(cell)]))}
                for figure, cell in zip(figures, measured_cells, strict=True)
            ]
        if measured_cells:
            _print_table(scale.head(line.label.removesuffix(", median")), differing_columns, measured_cells, figures)
    for name, label in wording.word_labels(cells).items():
        measured_cells = [cell for cell in cells if name in cell.tallies]
        figures = [
            {"n": _repeat_count(cell.tallies[name].n, cell), "repeats with each": wording.tally(cell, name)}
            for cell in measured_cells
        ]
        _print_table(label, differing_columns, measured_cells, figures, words=1)
    for caution in wording.cautions(cells, {quantity.name for line in shown_lines for quantity in line.quantities}):
        print_folded(caution)


def _shown_judgements(
    data: Sources, repeats: Repeats, cells: Sequence[Cell], quantities: Sequence[Quantity]
) -> Sequence[Judgement]:
    """Return the judgements of the trials' expectations about the quantities that are shown."""
    shown_names = {quantity.name for quantity in quantities}
    if not (expected := data.expectations()):
        return ()
    rows = repeats.groups(tuple(cells[0].key))

    def expectations_of(cell: Cell) -> Iterator[Expectation]:
        for source in dict.fromkeys(repeats.texts[SOURCE][rows[tuple(cell.key.values())]]):
            yield from (item for item in expected.get(source, ()) if item.quantity in shown_names)

    return judge_by_trial((cell, expectations_of(cell)) for cell in cells)


def _print_judgements(
    condition_columns: Sequence[str], cells: Sequence[Cell], judgements: Sequence[Judgement]
) -> None:
    """Print for each condition whether its expectations are met; without expectations, print nothing."""
    differing_columns, _ = wording.varying_and_common(condition_columns, cells)
    rows = []
    for judgement in judgements:
        expected, _, *judgement_columns = judgement_texts(judgement)
        rows.append(
            (
                expected,
                *(wording.key(judgement.cell, name) if judgement.cell else "" for name in differing_columns),
                *judgement_columns,
            )
        )
    if rows:
        head = ("expected", *differing_columns, "measured", "95 % interval", "")
        print_table(head, rows, fold=(0, len(head) - 1))


def _print_table(
    title: str,
    condition_columns: Sequence[str],
    cells: Sequence[Cell],
    figures: Sequence[Mapping[str, str]],
    *,
    words: int = 0,
) -> None:
    """Print a row per cell. The last `words` columns are text.

    A condition column with the same value in all cells is shown in the title instead.
    """
    differing_columns, common = wording.varying_and_common(condition_columns, cells)
    full_title = ", ".join([title, *dict.fromkeys(wording.key(cells[0], name) for name in common)])
    head = [*differing_columns, *figures[0]]
    rows = [
        [*(wording.key(cell, name) for name in differing_columns), *values.values()]
        for cell, values in zip(cells, figures, strict=True)
    ]
    print_table(head, rows, title=full_title, right=range(len(differing_columns), len(head) - words))


def _additional_repeats(line: TableLine, cell: Cell, additional: Mapping[str, int]) -> int | str:
    """Return the number of additional repeats that a cell needs, or an empty string if it is unknown."""
    estimate = line.estimate(cell)
    return additional.get(estimate.quantity.name, "") if estimate else ""


def _repeat_count(n: int, cell: Cell) -> str:
    """Return the number of valid repeats with a value: `5`, or `4 of 5`."""
    return table_lines.partial_count(n, cell) or str(n)


def _figures(line: TableLine, cell: Cell, scale: wording.Scale) -> dict[str, str]:
    """Return the texts of a cell by column head.

    If the cell has no value, only the text of column `n` is not empty.
    """
    estimate, quantity = line.estimate(cell), line.quantities[0]
    kind = quantity.kind
    heads = ["n", *(("sent",) if kind is Kind.COUNTED else ()), _VALUE_HEADS[kind], "95 % interval"]
    if kind is not Kind.FLAG:
        heads += ["Wilson" if kind is Kind.COUNTED else "mean", "median", "p95"]
    if quantity.at_least:
        heads.append("not ended")
    if estimate is None:
        return dict.fromkeys(heads, "") | {"n": table_lines.partial_count(0, cell)}
    figures = {
        "n": _repeat_count(estimate.n, cell),
        "sent": "" if estimate.trials is None else str(estimate.trials),
        "Wilson": scale.interval(estimate.wilson_low, estimate.wilson_high),
        "mean": wording.number(scale, estimate, estimate.mean),
        "median": scale.number(estimate.median),
        "p95": wording.number(scale, estimate, estimate.p95),
        _VALUE_HEADS[kind]: wording.number(scale, estimate),
        "95 % interval": wording.interval(scale, estimate),
        "not ended": f"{estimate.n_censored} of {estimate.n}",
    }
    return {head: figures[head] for head in dict.fromkeys(heads)}
