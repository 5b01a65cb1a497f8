"""The columns of a trial: common columns and columns of steps, in the plan and in the table."""

from collections.abc import Iterator, Sequence
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fieldkit.analysis import repeats, table_files
from fieldkit.config import schema
from fieldkit.core import plugins
from fieldkit.core.columns import Column, Figure, Kind, Value, with_step_name
from fieldkit.core.errors import ConfigurationError
from fieldkit.steps import kinds
from fieldkit.steps.base import step_types
from fieldkit.trial import frozen, rows
from fieldkit.trial.columns import (
    IDENTITY,
    additional_columns,
    filled_columns,
    installed_columns,
    measured_columns,
    robot_columns,
    trial_columns,
)
from fieldkit.trial.frozen import freeze
from fieldkit.trial.procedure import Procedure
from fieldkit.trial.stored import plans, tables
from tests.helpers import meter, vendor_trials
from tests.helpers.casts import los_plan
from tests.helpers.outside_packages import write_package

NAMES = st.from_regex(r"[a-z][a-z0-9_]{0,12}(\.[a-z][a-z0-9_]{0,12})?", fullmatch=True)
WORDS = st.text(st.characters(categories=("L", "N", "P", "S")), min_size=1, max_size=20)
UNITS = (
    st.sampled_from(("text", "hash", "bool", "count", "B", "ns", "share", "s", "m", "bit/s", "ppm", "dBm")) | WORDS
)
COMMON_NAMES = [column.name for column in trial_columns()]


@st.composite
def declared_columns(draw: st.DrawFn) -> Column:
    """Any valid column."""
    name, unit, meaning = draw(NAMES), draw(UNITS), draw(WORDS)
    plain = Column(name, unit, meaning)
    if plain.type is str:
        return plain
    low, high = sorted((draw(st.floats(-1e9, 1e9)), draw(st.floats(-1e9, 1e9))))
    kind = Kind.FLAG if plain.type is bool else draw(st.sampled_from((Kind.MEAN, Kind.MEDIAN)))
    figure = draw(st.none() | st.builds(Figure, WORDS, st.just(kind), rank=st.integers(0, 10**6)))
    bounds = draw(st.sampled_from((None, (low, high)))) if plain.type is float else None
    return Column(name, unit, meaning, bounds=bounds, figure=figure)


@st.composite
def tables_of_columns(draw: st.DrawFn) -> tuple[list[Column], dict[str, Value]]:
    """Columns of one trial, and a value for each."""
    drawn_columns = draw(st.lists(declared_columns(), min_size=1, max_size=5, unique_by=lambda column: column.name))
    columns = [column for column in drawn_columns if column.name not in COMMON_NAMES]
    return columns, {column.name: draw(values(column)) for column in columns}


def values(column: Column) -> st.SearchStrategy[Value]:
    """Return a strategy for the values of a column, as in a CSV file."""
    low, high = column.possible_range
    if column.type is str:
        return WORDS
    if column.type is bool:
        return st.booleans()
    if column.type is int:
        return st.integers(int(low), int(min(high, 2**53)))
    return st.floats(max(low, -1e300), min(high, 1e300)).map(lambda value: min(max(float(f"{value:.9g}"), low), high))


@settings(max_examples=15)
@given(tables_of_columns())
def test_any_valid_column_is_read_back_from_plan_and_table(
    tmp_path_factory: pytest.TempPathFactory, drawn_table: tuple[list[Column], dict[str, Value]]
) -> None:
    columns, row = drawn_table
    assert [column.declaration_error() for column in columns] == [None] * len(columns)
    plan = los_plan().model_copy(update={"columns": freeze(columns) or None})
    folder = tmp_path_factory.mktemp("trial")
    (folder / "trial.yaml").write_text(schema.dump(plan), encoding="utf-8")
    assert [*plans.read_columns(folder / "trial.yaml")] == columns
    assert plans.read_plan(folder).table == plan.table == (*trial_columns(), *columns)
    table_of_trials = repeats.parse(rows.to_csv([row], plan.table).encode(), plan.table)
    # A cell of a table has nine digits of a number; a drawn value may have more, because it may be a bound.
    values = [float(f"{value:.9g}") if isinstance(value, float) else value for value in row.values()]
    assert [table_of_trials.column(name)[0] for name in row] == values


def test_common_columns_are_first_independently_of_their_rank() -> None:
    more_columns = [Column("probe.level", "dBm", "x", rank=1), Column("status", "count", "not this one")]
    assert trial_columns(more_columns) == (*trial_columns(), more_columns[0])
    assert trial_columns()[: len(IDENTITY)] == IDENTITY
    assert len({column.name for column in trial_columns()}) == len(trial_columns())


def test_the_plan_of_the_paper_s_procedure_has_only_the_columns_of_robots() -> None:
    plan = los_plan()
    assert plan.columns == freeze(robot_columns(plan.procedure.roles()))
    assert names(plan.table) == names((*trial_columns(), *robot_columns(plan.procedure.roles())))


def test_a_named_column_has_named_figures_and_counts() -> None:
    (loss,) = (column for column in trial_columns() if column.name == "ip_loss")
    up = with_step_name("up", loss)
    assert up.name == "up.ip_loss"
    assert up.figure is not None
    assert (up.figure.label, up.figure.arrived, up.figure.sent) == (
        "up: IP packet loss",
        "up.ip_packets_received",
        "up.ip_packets_sent",
    )
    assert (up.unit, up.meaning, up.possible_range) == (loss.unit, loss.meaning, loss.possible_range)
    assert with_step_name("", loss) is loss


@pytest.mark.parametrize(
    ("column", "expected_problem"),
    [
        (Column("Level", "dBm", "x"), "its name must consist of lower-case letters"),
        (Column("a..b", "dBm", "x"), "its name"),
        (Column("a" * 101, "dBm", "x"), "its name is not 1 to 100"),
        (Column("a", "", "x"), "its unit"),
        (Column("a", "m" * 21, "x"), "its unit is not 1 to 20"),
        (Column("a", "m\n", "x"), "its unit"),
        (Column("a", "m", "\x1b[2J"), "its meaning"),
        (Column("a", "m", "x", figure=Figure("\u202eevil", Kind.MEAN)), "its label"),
        (Column("a", "m", "x", bounds=(2.0, 1.0)), "bounds 2 and 1 are not"),
        (Column("a", "m", "x", bounds=(0.0, float("nan"))), "bounds 0 and nan are not"),
        (Column("a", "text", "x", figure=Figure("a", Kind.MEAN)), "a text column needs a figure of kind words"),
        (Column("a", "bool", "x", figure=Figure("a", Kind.MEAN)), "a bool column needs a figure of kind flag"),
        (Column("a", "m", "x", figure=Figure("a", Kind.FLAG)), "needs a figure of kind flag"),
        (Column("a", "share", "x", figure=Figure("a", Kind.COUNTED, "b")), "needs the columns arrived and sent"),
        (Column("a", "share", "x", figure=Figure("a", Kind.MEAN, "b", "c")), "needs the columns arrived and sent"),
        (
            Column("a", "m", "x", figure=Figure("a", Kind.COUNTED, "b", "c")),
            "the unit of a counted figure must be share",
        ),
    ],
)
def test_a_column_that_cannot_be_read_or_shown_is_rejected(column: Column, expected_problem: str) -> None:
    problem = column.declaration_error()
    assert problem is not None
    assert expected_problem in problem


def test_columns_of_every_trial_include_those_of_every_shipped_kind() -> None:
    columns_of_kinds = {column for kind in kinds.shipped_names() for column in step_types()[kind].columns}
    assert columns_of_kinds <= set(measured_columns())


# Steps.


@pytest.fixture
def meters(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Install a package with the kind of step `meter`."""
    write_package(tmp_path / "installed", "meters", f"[{plugins.STEPS}]\nmeter = {meter.TARGET}\n")
    monkeypatch.syspath_prepend(tmp_path / "installed")
    for function in (step_types, installed_columns):
        function.cache_clear()
    yield
    for function in (step_types, installed_columns):
        function.cache_clear()


def procedure(*steps: str) -> Procedure:
    step_lines = "".join(f"  - {step}\n" for step in steps)
    head = "name: x\nsummary: x\nscenario: los\ntopology: masterless\nprotocols: [tcp]\nrepeats: 1\nsteps:\n"
    return schema.validate(schema.parse(head + step_lines, source="x.yaml"), Procedure)


def names(columns: Sequence[Column]) -> list[str]:
    return [column.name for column in columns]


@pytest.mark.usefixtures("meters")
def test_columns_of_steps_follow_in_the_order_of_the_procedure() -> None:
    parsed_procedure = procedure(
        "meter: {called: b, measures: [x]}", "ping: {from: sender, to: receiver}", "meter: {}"
    )
    columns = additional_columns(placed.step for placed in parsed_procedure.walk())
    assert names(columns) == ["b.meter_level", "b.x", "meter_level"]
    filled_names = names(filled_columns(placed.step for placed in parsed_procedure.walk()))
    assert filled_names[-3:] == names(columns)
    assert {"status", "rtt_sent", "emulator_late_max_s"} <= set(filled_names)
    assert not {"ip_loss", "file_loss"} & set(filled_names)
    plan = los_plan().model_copy(update={"procedure": parsed_procedure, "columns": None})
    assert plan.table == (*trial_columns(), *columns), "a plan of an earlier version, without columns"


@pytest.mark.parametrize(
    ("steps", "message"),
    [
        (("meter: {measures: [rtt_sent]}",), "fieldkit has another column 'rtt_sent'"),
        (("meter: {measures: [status]}",), "fieldkit has another column 'status'"),
        (("meter: {}", "meter: {}"), "two steps have a column 'meter_level'"),
        (("meter: {called: a, measures: [x, x]}",), "two steps have a column 'a.x'"),
        (("meter: {measures: [Level]}",), "its name must consist of lower-case letters"),
    ],
)
@pytest.mark.usefixtures("meters")
def test_names_that_are_used_twice_are_rejected_with_the_line_of_their_step(
    steps: Sequence[str], message: str
) -> None:
    with pytest.raises(ConfigurationError, match=message) as caught:
        procedure(*steps)
    assert caught.value.where == f"x.yaml:{7 + len(steps)}"


@pytest.mark.usefixtures("meters")
def test_columns_of_other_packages_are_only_in_trials_that_use_them() -> None:
    assert "meter_level" in names(installed_columns())
    assert "meter_level" not in names(trial_columns())


# Tables.

PROBE_COLUMNS = [column for column in vendor_trials.VENDOR_COLUMNS if column.name.startswith("probe")]


def write_trial(folder: Path, name: str, columns: Sequence[Column], *, with_plan: bool = True) -> Path:
    plan = vendor_trials.plan(name, distance="30ft", metres=9.144, columns=columns)
    return (
        vendor_trials.write(folder, plan, vendor_trials.valid_rows(plan, repeats=2), with_plan=with_plan)
        / "trial.csv"
    )


def test_a_table_is_read_by_its_plan_without_the_declaring_package(tmp_path: Path) -> None:
    actual = tables.declared_columns([write_trial(tmp_path, "one", vendor_trials.VENDOR_COLUMNS)])
    assert actual == (
        *trial_columns(),
        *(Column(**{**vars(column), "rank": 100}) for column in vendor_trials.VENDOR_COLUMNS),
    )


def test_different_trials_share_their_common_columns(tmp_path: Path) -> None:
    paths = [
        write_trial(tmp_path, "one", PROBE_COLUMNS),
        write_trial(tmp_path, "two", vendor_trials.NAMED_STEP_COLUMNS),
    ]
    table_of_trials = table_files.read(paths, tables.declared_columns(paths))
    assert [value is None for value in table_of_trials.column("probe.level")] == [False] * 4 + [True] * 4
    assert [value is None for value in table_of_trials.column("up.transfer_s")] == [True] * 4 + [False] * 4


def test_without_a_plan_prefixed_columns_are_known_and_others_are_text(tmp_path: Path) -> None:
    table = write_trial(
        tmp_path, "one", (*vendor_trials.NAMED_STEP_COLUMNS, *vendor_trials.VENDOR_COLUMNS), with_plan=False
    )
    actual = {column.name: column for column in tables.declared_columns([table])}
    for column in vendor_trials.NAMED_STEP_COLUMNS:
        assert actual[column.name] == column
    for column in vendor_trials.VENDOR_COLUMNS:
        assert actual[column.name] == table_files.undeclared(column.name)


def test_a_table_without_a_plan_is_read_by_the_plan_of_another_trial(tmp_path: Path) -> None:
    paths = [
        write_trial(tmp_path / "a", "one", PROBE_COLUMNS, with_plan=False),
        write_trial(tmp_path / "b", "two", PROBE_COLUMNS),
    ]
    (level,) = (column for column in tables.declared_columns(paths) if column.name == "probe.level")
    assert level.unit == "dBm"


@pytest.mark.parametrize(
    "other",
    [
        Column("probe.level", "mW", "x", figure=Figure("level", Kind.MEDIAN)),
        Column("probe.level", "dBm", "x", figure=Figure("level", Kind.MEAN)),
        Column("probe.level", "dBm", "x"),
        Column("probe.level", "text", "x"),
    ],
)
def test_plans_with_incompatible_columns_of_one_name_are_rejected(tmp_path: Path, other: Column) -> None:
    paths = [write_trial(tmp_path, "one", PROBE_COLUMNS), write_trial(tmp_path, "two", [other])]
    with pytest.raises(ConfigurationError, match=r"probe\.level is a different column here") as caught:
        tables.declared_columns(paths)
    assert caught.value.where == str(paths[1].with_name("trial.yaml"))


def test_plans_may_differ_in_meaning_and_bounds_of_a_column(tmp_path: Path) -> None:
    other = Column("probe.level", "dBm", "Level.", bounds=(-90, 0), figure=Figure("signal", Kind.MEDIAN))
    same = Column("probe.level", "dBm", "What it says.", bounds=(-120, -10), figure=Figure("level", Kind.MEDIAN))
    paths = [write_trial(tmp_path, "one", [other]), write_trial(tmp_path, "two", [same])]
    (level,) = (column for column in tables.declared_columns(paths) if column.name == "probe.level")
    assert (level.meaning, level.bounds) == ("Level.", (-120, 0))


HOSTILE = {
    "a name that is markup": "- {name: '<script>', unit: m, meaning: x}",
    "a unit that moves the cursor": '- {name: a, unit: "\\e[2J", meaning: x}',
    "a huge meaning": f"- {{name: a, unit: m, meaning: {'x' * 5000}}}",
    "no meaning": "- {name: a, unit: m}",
    "another key": "- {name: a, unit: m, meaning: x, run: reboot}",
    "a name twice": "- {name: a, unit: m, meaning: x}\n- {name: a, unit: s, meaning: x}",
    "bounds that are none": "- {name: a, unit: m, meaning: x, bounds: [1.0]}",
    "bounds the wrong way": "- {name: a, unit: m, meaning: x, bounds: [1.0, 0.0]}",
    "a kind that is none": "- {name: a, unit: m, meaning: x, figure: {label: a, kind: guess, rank: 1}}",
    "a flag of metres": "- {name: a, unit: m, meaning: x, figure: {label: a, kind: flag, rank: 1}}",
    "a figure of a text": "- {name: a, unit: text, meaning: x, figure: {label: a, kind: mean, rank: 1}}",
    "no list": "  a: b",
    "too many": "".join(f"- {{name: a{n}, unit: m, meaning: x}}\n" for n in range(frozen.MAX_COLUMNS + 1)),
}


@pytest.mark.parametrize("columns", HOSTILE.values(), ids=HOSTILE)
def test_edited_columns_are_rejected_with_their_location(tmp_path: Path, columns: str) -> None:
    table = write_trial(tmp_path, "one", PROBE_COLUMNS)
    path = table.with_name("trial.yaml")
    head, _, _ = path.read_text(encoding="utf-8").partition("columns:\n")
    path.write_text(f"{head}columns:\n{columns}\n", encoding="utf-8")
    for read in (lambda: tables.declared_columns([table]), lambda: plans.read_plan(path.parent)):
        with pytest.raises(ConfigurationError) as caught:
            read()
        assert caught.value.where is not None
        assert caught.value.where.startswith(f"{path}:")
        assert len(str(caught.value)) < 1000


def test_a_plan_may_not_redeclare_a_common_column(tmp_path: Path) -> None:
    table = write_trial(tmp_path, "one", [Column("probe.level", "dBm", "x")])
    path = table.with_name("trial.yaml")
    spoiled = path.read_text(encoding="utf-8").replace("name: probe.level", "name: status", 1)
    path.write_text(spoiled, encoding="utf-8")
    actual = [column for column in tables.declared_columns([table]) if column.name in {"status", "probe.level"}]
    assert actual[0] in IDENTITY
    assert actual[1] == table_files.undeclared("probe.level")


def test_a_plan_that_is_a_link_is_not_read(tmp_path: Path) -> None:
    table = write_trial(tmp_path, "one", [Column("probe.level", "dBm", "x")])
    plan = table.with_name("trial.yaml")
    plan.rename(tmp_path / "elsewhere.yaml")
    plan.symlink_to(tmp_path / "elsewhere.yaml")
    assert tables.declared_columns([table])[-1] == table_files.undeclared("probe.level")
