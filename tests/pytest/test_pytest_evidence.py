"""Evidence folders of tests are created on first use, removed unless they are kept, and never overwritten."""

from pathlib import Path

import pytest

from fieldkit.core.errors import ConfigurationError
from fieldkit.core.events import Note, PhaseStarted, TrialStarted
from fieldkit.pytest.evidence import LOG, EvidenceFolder, EvidenceKeeper
from fieldkit.pytest.plugin_options import Keep


def test_a_folder_is_created_on_first_use(tmp_path: Path) -> None:
    folder = EvidenceFolder(tmp_path / "run" / "test_a")
    assert (folder.exists, list(tmp_path.iterdir())) == (False, [])
    folder.add("received")
    assert folder.path == tmp_path / "run" / "test_a"
    assert (folder.path / LOG).read_text(encoding="utf-8").endswith(" received\n")


@pytest.mark.parametrize(
    ("keep", "has_failed", "is_kept"),
    [
        (Keep.FAILED, True, True),
        (Keep.FAILED, False, False),
        (Keep.ALL, False, True),
        (Keep.NONE, True, False),
    ],
)
def test_a_folder_remains_if_it_must_be_kept(tmp_path: Path, *, keep: Keep, has_failed: bool, is_kept: bool) -> None:
    folder = EvidenceFolder(tmp_path / "run" / "test_a")
    folder.add("received")
    folder.has_failed = has_failed
    folder.remove_unless_kept(keep)
    assert (folder.exists, (tmp_path / "run").exists()) == (is_kept, is_kept)


def test_a_rerun_of_a_test_has_a_separate_folder(tmp_path: Path) -> None:
    folders = [EvidenceFolder(tmp_path / "test_a") for _ in range(3)]
    assert [folder.path.name for folder in folders] == ["test_a", "test_a-2", "test_a-3"]


def test_a_folder_that_cannot_be_created_is_reported_with_the_option(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(ConfigurationError, match="cannot create the folder for evidence") as error_info:
        EvidenceFolder(tmp_path / "file" / "run" / "test_a").add("received")
    assert "--fieldkit-output" in error_info.value.remedy


def test_a_run_without_kept_evidence_leaves_no_folder(tmp_path: Path) -> None:
    keeper = EvidenceKeeper(tmp_path / "results" / "run", Keep.FAILED)
    keeper.add_event(Note("robots are up"))
    assert list(tmp_path.rglob(LOG))
    keeper.end()
    assert not list(tmp_path.iterdir())


def test_other_files_in_the_folder_remain(tmp_path: Path) -> None:
    (tmp_path / "results").mkdir()
    (tmp_path / "results" / "notes.txt").touch()
    keeper = EvidenceKeeper(tmp_path / "results" / "run", Keep.FAILED)
    keeper.add_event(Note("robots are up"))
    keeper.end()
    assert [path.name for path in tmp_path.rglob("*")] == ["results", "notes.txt"]


def test_events_are_logged_as_text_except_progress(tmp_path: Path) -> None:
    keeper = EvidenceKeeper(tmp_path / "run", Keep.ALL)
    for event in (Note("up"), PhaseStarted("record", "udp-01"), TrialStarted("folder", 0, 1)):
        keeper.add_event(event)
    lines = (keeper.folder.path / LOG).read_text(encoding="utf-8").splitlines()
    assert [line.split(" ", 1)[1] for line in lines] == ["up", "udp-01 record"]
