"""The tables found at paths, for `aggregate` and other commands."""

from collections.abc import Sequence
from pathlib import Path

import pytest

from fieldkit.analysis.repeats import Repeats
from fieldkit.core.errors import ConfigurationError, EvidenceError
from fieldkit.trial.stored import sources
from tests.helpers.tables import ROW, repeats, replace, write


def load(paths: Sequence[Path], notes: list[str] | None = None) -> Repeats:
    return sources.find(paths, ([] if notes is None else notes).append).read()


def read_from(*paths: Path) -> list[str]:
    return list(dict.fromkeys(load(paths).texts["source"]))


def trial(folder: Path, name: str) -> Path:
    return write(folder / name, repeats(replace(ROW, trial=name), 2)).parent


def test_trials_below_a_folder_are_sorted_without_hidden_ones(tmp_path: Path) -> None:
    expected = [trial(tmp_path / "campaign_lawn", "3"), trial(tmp_path, "ones/1"), trial(tmp_path, "ones/2")]
    trial(tmp_path, ".trash")
    trial(tmp_path, "copy.partial")
    trial(tmp_path, "ones/1/repeats/udp-01")
    write(tmp_path, [ROW], "notes.csv")
    assert read_from(tmp_path) == [str(table) for table in expected]


def test_a_table_with_several_paths_counts_once(tmp_path: Path) -> None:
    table = trial(tmp_path, "1")
    (tmp_path / "again").symlink_to(table, target_is_directory=True)
    (table / "circle").symlink_to(tmp_path, target_is_directory=True)
    (tmp_path / "circle").symlink_to(tmp_path, target_is_directory=True)
    notes: list[str] = []
    assert len(load([tmp_path, table, table / "trial.csv"], notes)) == 2
    assert not notes


def test_a_copy_counts_once_with_a_note(tmp_path: Path) -> None:
    table = trial(tmp_path, "1")
    copy = write(tmp_path, repeats(replace(ROW, trial="1"), 2), "copy.csv")
    notes: list[str] = []
    assert len(load([table, copy], notes)) == 2
    assert notes == [f"{copy}: 2 rows also in {table}, counted once"]


def test_a_trial_without_a_table_is_named(tmp_path: Path) -> None:
    trial(tmp_path, "1")
    unfinished = tmp_path / "2"
    unfinished.mkdir()
    (unfinished / "trial.yaml").touch()
    notes: list[str] = []
    assert len(load([tmp_path], notes)) == 2
    assert [note for note in notes if f"to create it: fieldkit rebuild {unfinished}" in note]


def test_a_table_without_its_trial_cannot_be_rebuilt(tmp_path: Path) -> None:
    with pytest.raises(ConfigurationError, match="no raw evidence"):
        sources.find([trial(tmp_path, "1")], print, rebuild=True).read()


@pytest.mark.parametrize(("name", "message"), [("gone", "no such file"), (".", "there is no trial in this folder")])
def test_a_path_without_a_trial_is_rejected(tmp_path: Path, name: str, message: str) -> None:
    with pytest.raises(ConfigurationError, match=message):
        load([tmp_path / name])


def test_the_remedy_for_tables_in_a_folder_is_valid_in_a_shell(tmp_path: Path) -> None:
    write(tmp_path / "from Ann", [ROW], "lawn.csv")
    with pytest.raises(ConfigurationError, match="there is no trial in this folder or its subfolders") as caught:
        load([tmp_path / "from Ann"])
    assert caught.value.remedy.endswith(f"CSV files: '{tmp_path / 'from Ann'}'/*.csv")


def test_trials_without_an_attempt_are_rejected(tmp_path: Path) -> None:
    write(tmp_path, [])
    with pytest.raises(EvidenceError, match="no repeat has ended"):
        load([tmp_path])
