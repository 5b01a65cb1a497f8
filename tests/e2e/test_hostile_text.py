"""No output contains control characters, even if texts of robots and operators contain them."""

import csv
import io
import json
import shutil
from collections.abc import Iterator, Sequence
from pathlib import Path

import pyarrow.parquet
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader

from fieldkit.analysis import repeats
from fieldkit.cli import main, parser
from fieldkit.trial import rows
from fieldkit.trial.columns import trial_columns
from tests.helpers.paths import ROOT
from tests.helpers.stored_trials import TRIALS
from tests.helpers.tables import ROW, RepeatRow, replace, write

HOSTILE = "=a\x1b[31mb\x07\x7f\x9b5m\u202ec\u2066\u200fd\u2028e"
TEXTS = ("procedure", "scenario", "backend", "distance", "sender", "reason")
FILE_COMMAND = "export"
BARE_PRINT = {"fieldkit/cli/display.py", "fieldkit/cli/operators.py", "fieldkit/cli/commands/completion.py"}
"""Modules that may print: the module that escapes texts, the prompts, and the script for shell completion."""


def formats() -> Iterator[tuple[str, str]]:
    """Yield every command that has a choice of formats, with each format, including commands added later."""
    for command in ("aggregate", "compare", "export"):
        arguments = parser().command(command)
        assert arguments is not None
        (choices,) = (action.choices for action in arguments._actions if "--format" in action.option_strings)
        assert choices is not None
        yield from ((command, form) for form in choices)


@pytest.fixture(scope="module")
def hostile(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two trials with hostile texts in plan, journal and table, and in the name and values of an unknown column."""
    folder = tmp_path_factory.mktemp("hostile")
    for name in ("a", "b"):
        trial = shutil.copytree(TRIALS / "20261122T013134.573068Z_los_30ft_master", folder / f"{name}\x1b[2J" / "los")
        with (trial / "trial.csv").open(encoding="utf-8", newline="") as file:
            table = list(csv.DictReader(file))
        for row in table:
            row.update(dict.fromkeys(TEXTS, HOSTILE), **{f"other{HOSTILE}": HOSTILE})
            row["trial"] += name
        with (trial / "trial.csv").open("w", encoding="utf-8", newline="") as file:
            writer = csv.DictWriter(file, list(table[0]), lineterminator="\n")
            writer.writeheader()
            writer.writerows(table)
        journal = (trial / "journal.jsonl").read_text(encoding="utf-8").splitlines()
        entries = [json.loads(line) for line in journal]
        for entry in entries:
            if entry.get("reason"):
                entry["reason"] = HOSTILE
        assert any(entry.get("reason") for entry in entries)
        (trial / "journal.jsonl").write_text("".join(json.dumps(entry) + "\n" for entry in entries), encoding="utf-8")
        (trial / "MANIFEST.sha256").unlink()
    return folder


def assert_printable(text: str) -> None:
    assert {char for char in text if not (char.isprintable() or char in "\n\N{NO-BREAK SPACE}")} == set()


def texts_in(form: str, path: Path) -> Iterator[str]:
    """Yield the texts in a file of a format."""
    if form == "parquet":
        table = pyarrow.parquet.read_table(path)
        yield from table.column_names
        yield from (text for column in table.columns for text in column.to_pylist() if isinstance(text, str))
    elif form == "mcap":
        with path.open("rb") as file:
            yield from (message.data.decode() for _, _, message in make_reader(file).iter_messages())
    else:
        yield path.read_text(encoding="utf-8")


def words(command: str, form: str, hostile: Path, out: Path) -> Sequence[str]:
    a, b = (str(next(hostile.glob(f"{name}*"))) for name in "ab")
    arguments = {"aggregate": (str(hostile),), "compare": (a, b, "--force"), "export": (f"{a}/los", "-o", str(out))}
    return (command, *arguments[command], "--format", form)


@pytest.mark.parametrize(("command", "form"), [*formats(), ("report", "html")])
def test_no_output_contains_control_characters(
    hostile: Path, tmp_path: Path, command: str, form: str, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / f"out.{form}"
    if command == "report":
        assert main(["report", str(hostile), "-o", str(out)]) == 0
    else:
        assert main([*words(command, form, hostile, out)]) == 0
    captured = capsys.readouterr()
    assert_printable(captured.out)
    assert_printable(captured.err)
    output_texts = list(texts_in(form, out)) if out.exists() else [captured.out]
    assert out.exists() is (command in {"export", "report"})
    for text in output_texts:
        assert_printable(text)
    if form != "mcap":
        assert any("?[31mb" in text or "\\u001b[31mb" in text for text in output_texts), (
            "the texts contain the sequence"
        )
    if form == "csv":
        cells = [cell for line in csv.reader(io.StringIO(output_texts[0])) for cell in line]
        assert not [cell for cell in cells if cell.startswith("=")]


def test_only_listed_modules_print() -> None:
    modules = [*(ROOT / "fieldkit" / "cli").rglob("*.py"), *(ROOT / "sim_backends/cosim/commands").rglob("*.py")]
    printing = {
        str(path.relative_to(ROOT))
        for path in modules
        if any(line.strip().startswith("print(") for line in path.read_text(encoding="utf-8").splitlines())
    }
    assert printing <= BARE_PRINT


def round_trip(row: RepeatRow) -> dict[str, object]:
    """Return the texts of a row after writing and reading its table."""
    content = rows.to_csv([row], trial_columns()).encode()
    table = repeats.parse(content, trial_columns())
    return {name: table.texts[name][0] for name in ("distance", "reason", "sender")}


@given(st.tuples(*[st.text(st.characters(exclude_categories=["C", "Z"]), max_size=12)] * 3))
def test_a_table_that_is_read_again_has_equal_texts(texts: tuple[str, str, str]) -> None:
    expected_texts = dict(zip(("distance", "reason", "sender"), texts, strict=True))
    expected_texts = {name: "" if text in {"nan", "NaN"} else text for name, text in expected_texts.items()}
    assert round_trip(replace(ROW, **expected_texts)) == expected_texts


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None, max_examples=25)
@given(text=st.text(min_size=1, max_size=20), form=st.sampled_from(["table", "csv", "json", "markdown", "latex"]))
def test_any_text_of_a_condition_is_printable_in_any_format(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], text: str, form: str
) -> None:
    table = write(tmp_path, [replace(ROW, distance=text, distance_m=None, tcp_byte_loss=0.1)])
    code = main(["aggregate", str(table), "--by", "distance,protocol", "--format", form])
    captured = capsys.readouterr()
    assert code == 0, captured.err
    assert_printable(captured.out + captured.err)
