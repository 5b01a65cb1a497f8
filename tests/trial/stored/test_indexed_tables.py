"""The index of tables: results with it equal results without it, even after changes of the trials or the index."""

import errno
import io
import os
import shutil
import stat
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Final

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from fieldkit.analysis import table_index
from fieldkit.core.errors import FieldkitError
from fieldkit.core.executors import Workers
from fieldkit.export import table
from fieldkit.trial.stored import indexed_tables, sources
from tests.helpers.paths import ROOT

STORED: Final = ROOT / "tests" / "data" / "fieldkit"
TRIALS: Final = (*sorted((STORED / "4" / "trials").iterdir()), *(STORED / "evidence").iterdir())
DEADLINE_S: Final = 60


@pytest.fixture(autouse=True)
def _small_index(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Index even a few tables, and tables that have just been written."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr(indexed_tables, "MIN_TABLES", 1)
    monkeypatch.setattr(indexed_tables, "MIN_NEW", 1)
    monkeypatch.setattr(table_index, "SETTLED_S", -1.0)


def write_archive(folder: Path, count: int = 6) -> list[Path]:
    """Write this number of trials without evidence; return their folders."""
    return [add_trial(folder, number) for number in range(count)]


def add_trial(folder: Path, number: int) -> Path:
    original = TRIALS[number % len(TRIALS)]
    trial = folder / f"{number:03d}-{original.name}"
    trial.mkdir(parents=True)
    for name in ("trial.csv", "trial.yaml"):
        text = (original / name).read_text(encoding="utf-8").replace(original.name, trial.name)
        (trial / name).write_text(text, encoding="utf-8")
    return trial


def outcome(*paths: Path, use_index: bool, selection: str = "") -> tuple[object, ...]:
    """Return the rows, columns, expectations and notes of trials, or the error and the notes."""
    notes: list[str] = []
    try:
        data = sources.find(paths, notes.append, workers=Workers(jobs=1), use_index=use_index).with_filter(selection)
        rows = data.read(undeclared=True)
        selected_rows = data.read({"status", "rtt_median_s"})
        expected = {source: [str(item) for item in items] for source, items in data.expectations().items()}
    except FieldkitError as error:
        return type(error), error.located, error.remedy, notes
    files = [io.BytesIO() for _ in range(2)]
    for file, part in zip(files, (rows, selected_rows), strict=True):
        table.write_csv(file, part)
    return [file.getvalue() for file in files], data.columns, expected, notes


def index_file(tmp_path: Path) -> Path:
    return next((tmp_path / "cache" / "fieldkit" / "tables").glob("*.index"))


def edit(path: Path, change: Callable[[Path], None]) -> None:
    """Change a file, and make sure that its time of change differs, which has a resolution of some milliseconds."""
    before, deadline_s = path.stat(), time.monotonic() + DEADLINE_S
    change(path)
    while path.exists() and path.stat().st_ctime_ns == before.st_ctime_ns and time.monotonic() < deadline_s:
        path.chmod(stat.S_IMODE(path.stat().st_mode))


def test_rows_of_the_index_equal_rows_of_the_tables(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_archive(tmp_path / "trials")
    expected = outcome(tmp_path / "trials", use_index=False)
    assert outcome(tmp_path / "trials", use_index=True) == expected

    def fail_on_read(*_: object) -> bytes:
        raise AssertionError("a table is read although it is indexed")

    monkeypatch.setattr("fieldkit.analysis.table_files._split", fail_on_read)
    monkeypatch.setattr("fieldkit.analysis.table_files.names", fail_on_read)
    monkeypatch.setattr("fieldkit.trial.stored.plans.read_columns", fail_on_read)
    assert outcome(tmp_path / "trials", use_index=True) == expected
    selection = 'topology == "master" and distance_m < 20'
    selected_rows = outcome(tmp_path / "trials", use_index=True, selection=selection)
    monkeypatch.undo()
    assert selected_rows == outcome(tmp_path / "trials", use_index=False, selection=selection)
    assert selected_rows != expected


def test_a_replaced_table_of_the_same_size_and_time_is_read_again(tmp_path: Path) -> None:
    trial = write_archive(tmp_path / "trials")[0]
    outcome(tmp_path / "trials", use_index=True)
    path, before = trial / "trial.csv", (trial / "trial.csv").stat()
    content = path.read_bytes()
    changed_content = content.replace(b",valid,", b",void,,").replace(b",void,,,", b",void,x,")
    assert len(changed_content) == len(content)
    assert changed_content != content

    def replace_and_restore(path: Path) -> None:
        path.write_bytes(changed_content)
        os.utime(path, ns=(before.st_atime_ns, before.st_mtime_ns))

    edit(path, replace_and_restore)
    after = path.stat()
    assert (after.st_size, after.st_mtime_ns, after.st_ino) == (before.st_size, before.st_mtime_ns, before.st_ino)
    assert outcome(tmp_path / "trials", use_index=True) == outcome(tmp_path / "trials", use_index=False)


def test_a_pipe_without_a_plan_is_not_indexed(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "table.csv")
    assert table_index.stamp(tmp_path / "table.csv", tmp_path / "trial.yaml") is None


def test_a_table_that_has_just_changed_is_not_indexed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(table_index, "SETTLED_S", 3600.0)
    write_archive(tmp_path / "trials")
    outcome(tmp_path / "trials", use_index=True)
    assert not (tmp_path / "cache").exists()


def test_other_trials_in_the_same_folder_stay_in_the_index(tmp_path: Path) -> None:
    trials = write_archive(tmp_path / "trials")
    outcome(*trials[:3], use_index=True)
    outcome(*trials[3:], use_index=True)
    shutil.rmtree(trials[0])
    outcome(trials[1], add_trial(tmp_path / "trials", 7), use_index=True)
    paths = {entry.path for entry in table_index.load(index_file(tmp_path)).entries.values()}
    assert paths == {str(path / "trial.csv") for path in (tmp_path / "trials").iterdir()}


Damage = Callable[[Path], object]


def _flip_bit(path: Path) -> None:
    content = bytearray(path.read_bytes())
    content[len(content) // 3] ^= 1
    path.write_bytes(content)


def _replace_by_link(path: Path) -> None:
    path.rename(path.with_name("target"))
    path.symlink_to("target")


def _replace_by_pipe(path: Path) -> None:
    path.unlink()
    os.mkfifo(path)


def _replace_by_folder(path: Path) -> None:
    path.unlink()
    path.mkdir()


DAMAGES: Final[dict[str, Damage]] = {
    "truncated": lambda path: os.truncate(path, path.stat().st_size // 2),
    "empty": lambda path: os.truncate(path, 0),
    "flipped bit": _flip_bit,
    "other content": lambda path: path.write_bytes(b"x" * 1000),
    "writable by others": lambda path: path.chmod(0o666),
    "foreign": lambda path: os.chown(path, 65534, 65534) if not os.geteuid() else path.chmod(0o666),
    "symbolic link": _replace_by_link,
    "pipe": _replace_by_pipe,
    "folder": _replace_by_folder,
    "folder writable by others": lambda path: path.parent.chmod(0o777),
}


@pytest.mark.parametrize("damage", DAMAGES.values(), ids=DAMAGES)
def test_the_result_is_correct_with_a_damaged_index(tmp_path: Path, damage: Damage) -> None:
    trials = write_archive(tmp_path / "trials")
    outcome(tmp_path / "trials", use_index=True)
    damage(index_file(tmp_path))
    shutil.rmtree(trials[2])
    *expected, _ = outcome(tmp_path / "trials", use_index=False)
    for _ in range(2):
        *result, notes = outcome(tmp_path / "trials", use_index=True)
        assert result == expected
        assert isinstance(notes, list)
        assert len(notes) <= 1


@pytest.mark.parametrize("failing", ["tempfile.mkstemp", "pathlib.Path.rename", "pathlib.Path.mkdir"])
def test_the_result_is_correct_if_the_index_cannot_be_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, failing: str
) -> None:
    def raise_disk_full(*_: object, **__: object) -> None:
        raise OSError(28, "No space left on device")

    write_archive(tmp_path / "trials")
    *expected, _ = outcome(tmp_path / "trials", use_index=False)
    monkeypatch.setattr(failing, raise_disk_full)
    *result, notes = outcome(tmp_path / "trials", use_index=True)
    assert result == expected
    assert isinstance(notes, list)
    assert len(notes) == 1
    assert "No space left on device" in notes[0]
    monkeypatch.undo()
    assert not list((tmp_path / "cache").rglob("*.*"))


def test_an_invalid_table_is_also_an_error_with_the_index(tmp_path: Path) -> None:
    trial = write_archive(tmp_path / "trials")[1]
    path = trial / "trial.csv"
    path.write_bytes(path.read_bytes().replace(b",valid,", b",vapid,"))
    results = [outcome(tmp_path / "trials", use_index=use_index) for use_index in (False, True, True)]
    assert results[0] == results[1] == results[2]
    assert "vapid" in str(results[0])


def test_the_oldest_indexes_are_removed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(table_index, "MAX_FILES", 2)
    for number in range(4):
        write_archive(tmp_path / f"trials-{number}", 2)
        outcome(tmp_path / f"trials-{number}", use_index=True)
    assert len(list((tmp_path / "cache").rglob("*.index"))) == 2


def _change_digit(path: Path, draw: int) -> None:
    content = bytearray(path.read_bytes())
    digits = [at for at, byte in enumerate(content) if chr(byte).isdigit()]
    at = digits[draw % len(digits)]
    content[at] = ord("1") if content[at] != ord("1") else ord("2")
    path.write_bytes(content)


def _replace_by_copy(path: Path) -> None:
    shutil.copy(path, path.with_suffix(".new"))
    path.with_suffix(".new").replace(path)


EDITS: Final[dict[str, Callable[[Path, int], object]]] = {
    "digit of the table": lambda trial, draw: edit(trial / "trial.csv", lambda path: _change_digit(path, draw)),
    "digit of the plan": lambda trial, draw: edit(trial / "trial.yaml", lambda path: _change_digit(path, draw)),
    "truncated": lambda trial, draw: edit(
        trial / "trial.csv", lambda path: os.truncate(path, draw % (path.stat().st_size + 1))
    ),
    "removed": lambda trial, _: shutil.rmtree(trial),
    "table removed": lambda trial, _: (trial / "trial.csv").unlink(),
    "plan removed": lambda trial, _: (trial / "trial.yaml").unlink(missing_ok=True),
    "renamed": lambda trial, draw: trial.rename(trial.with_name(f"{trial.name}-{draw}")),
    "hidden": lambda trial, draw: trial.rename(trial.with_name(f".hidden-{draw}")),
    "added": lambda trial, draw: add_trial(trial.parent, 1000 + draw),
    "copied": lambda trial, draw: shutil.copytree(trial, trial.with_name(f"copy-{draw}")),
    "linked": lambda trial, draw: trial.with_name(f"link-{draw}").symlink_to(trial.name),
    "new file": lambda trial, _: _replace_by_copy(trial / "trial.csv"),
}


def _trials(folder: Path) -> Iterator[Path]:
    return (path for path in sorted(folder.iterdir()) if (path / "trial.csv").is_file() and not path.is_symlink())


def _check_edits(folder: Path, edits: list[tuple[str, int, int]]) -> None:
    write_archive(folder)
    outcome(folder, use_index=True)
    for name, trial_index, draw in edits:
        trials = list(_trials(folder))
        if not trials:
            return
        try:
            EDITS[name](trials[trial_index % len(trials)], draw)
        except OSError as error:
            if error.errno not in {errno.EEXIST, errno.ENOTEMPTY}:  # the same edit with the same number
                raise
            continue
        assert outcome(folder, use_index=True) == outcome(folder, use_index=False), name


edits_of_archives = st.lists(
    st.tuples(st.sampled_from(sorted(EDITS)), st.integers(0, 20), st.integers(0, 10_000)), min_size=1, max_size=5
)


@settings(max_examples=4, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(edits_of_archives)
def test_results_after_random_edits_equal_those_without_the_index(
    tmp_path_factory: pytest.TempPathFactory, edits: list[tuple[str, int, int]]
) -> None:
    _check_edits(tmp_path_factory.mktemp("archive") / "trials", edits)


@pytest.mark.nightly
@settings(max_examples=400, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(edits_of_archives)
def test_results_after_many_random_edits_equal_those_without_the_index(
    tmp_path_factory: pytest.TempPathFactory, edits: list[tuple[str, int, int]]
) -> None:
    _check_edits(tmp_path_factory.mktemp("archive") / "trials", edits)
