"""Every export format with damaged trials: an error with a remedy, or a complete file."""

import os
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from fieldkit.cli import main
from fieldkit.trial import store
from fieldkit.trial.journal import JOURNAL_FILE
from fieldkit.trial.plan import PLAN_FILE
from tests.helpers.stored_trials import TRIALS

LOSSY = next(TRIALS.glob("20261122T013134*"))
FORMATS = ("csv", "parquet", "mcap", "junit")


def _replace_by_pipe(path: Path) -> None:
    path.unlink()
    os.mkfifo(path)


def _replace_by_folder(path: Path) -> None:
    path.unlink()
    path.mkdir()


DAMAGES: dict[str, Callable[[Path], object]] = {
    "gone": lambda path: path.unlink(),
    "empty": lambda path: path.write_bytes(b""),
    "text": lambda path: path.write_bytes(b"a: [1, {"),
    "binary": lambda path: path.write_bytes(bytes(range(256))),
    "cut": lambda path: path.write_bytes(path.read_bytes()[:-200]),
    "pipe": _replace_by_pipe,
    "folder": _replace_by_folder,
}


def export_and_check(path: Path, form: str, capsys: pytest.CaptureFixture[str]) -> int:
    out = path.parent / f"out.{form}"
    code = main(["export", str(path), "--format", form, "-o", str(out)])
    error_text = capsys.readouterr().err
    assert code in {0, 2, 4}
    assert out.exists() is (code == 0), "an incomplete file is removed"
    assert code == 0 or ("error: " in error_text and "remedy: " in error_text)
    return code


@pytest.mark.parametrize("form", FORMATS)
@pytest.mark.parametrize("name", [PLAN_FILE, JOURNAL_FILE, store.TRIAL_CSV])
@pytest.mark.parametrize("damage", DAMAGES)
def test_a_damaged_trial_gives_an_error_with_a_remedy_or_a_complete_file(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], form: str, name: str, damage: str
) -> None:
    trial = tmp_path / LOSSY.name
    trial.mkdir()
    for file_name in (PLAN_FILE, JOURNAL_FILE, store.TRIAL_CSV, store.MANIFEST_FILE):
        shutil.copy(LOSSY / file_name, trial)
    DAMAGES[damage](trial / name)
    export_and_check(trial, form, capsys)


@pytest.mark.parametrize("form", FORMATS)
@pytest.mark.parametrize("missing", ["none", "folder"])
def test_a_path_without_a_trial_is_an_error(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], form: str, missing: str
) -> None:
    (tmp_path / "folder").mkdir()
    assert export_and_check(tmp_path / missing, form, capsys) == 2
