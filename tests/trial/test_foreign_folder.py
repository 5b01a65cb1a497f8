"""Folders of trials from other people: links out of them are not followed, pipes do not block, errors are short."""

import json
import os
import shutil
import socket
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from fieldkit.cli import main
from fieldkit.core import files, jsonl
from fieldkit.core.columns import Measured
from fieldkit.core.errors import ConfigurationError, EvidenceError
from fieldkit.core.model import Protocol, RepeatId, Status
from fieldkit.trial import journal, store
from fieldkit.trial.journal import JournalEntry
from fieldkit.trial.running.ledger import Ledger
from fieldkit.trial.running.stop import Stop
from fieldkit.trial.stored import plans, verification
from fieldkit.trial.stored.rebuild import rebuild
from tests.helpers import recorded
from tests.helpers.casts import los_plan

FOREIGN_TEXT = "ours, and of no interest to others\n"


@pytest.fixture
def foreign_file(tmp_path: Path) -> Path:
    path = tmp_path / "ours"
    path.write_text(FOREIGN_TEXT, encoding="utf-8")
    return path


@pytest.fixture(scope="module")
def original(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A trial of one repeat with a manifest; no test may change it."""
    folder = recorded.make(tmp_path_factory.mktemp("trials"))
    Ledger(plans.read_plan(folder), folder, Stop()).summarize()
    return folder


@pytest.fixture
def trial(original: Path, tmp_path: Path) -> Path:
    """A copy of the original trial; a test may change it."""
    return Path(shutil.copytree(original, tmp_path / "trials" / original.name))


def pipe(path: Path) -> None:
    os.mkfifo(path)


def unix_socket(path: Path) -> None:
    working_directory = Path.cwd()
    os.chdir(path.parent)  # a socket path is limited to 108 characters
    try:
        with socket.socket(socket.AF_UNIX) as listener:
            listener.bind(path.name)
    finally:
        os.chdir(working_directory)


PLACES = [
    "trial.yaml",
    "journal.jsonl",
    "trial.csv",
    "summary.csv",
    "MANIFEST.sha256",
    "repeats/udp-01/ping.txt",
    "repeats/udp-01/scan.bag",
]
COMMANDS = [
    ["rebuild"],
    ["resume", "--backend", "emulated"],
    ["aggregate", "--rebuild"],
    ["export", "--format", "mcap", "-o", "out.mcap"],
]


@pytest.mark.parametrize("name", PLACES)
@pytest.mark.parametrize("command", COMMANDS, ids=lambda words: words[0])
def test_a_link_to_a_local_file_is_rejected(
    trial: Path, foreign_file: Path, name: str, command: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    (trial / name).unlink(missing_ok=True)
    (trial / name).symlink_to(foreign_file)
    options = [str(trial.parent / "out.mcap") if word == "out.mcap" else word for word in command[1:]]
    assert main([command[0], str(trial), *options]) == EvidenceError.exit_code
    output_text = capsys.readouterr().err
    assert f"{name}: it is a symbolic link, not a regular file" in " ".join(output_text.split())
    assert "remedy: get a copy with plain files from" in " ".join(output_text.split())
    assert foreign_file.read_text(encoding="utf-8") == FOREIGN_TEXT


@pytest.mark.parametrize("make_file", [pipe, unix_socket, lambda path: path.symlink_to("/dev/zero")])
@pytest.mark.parametrize("name", ["trial.yaml", "journal.jsonl", "trial.csv", "repeats/udp-01/sender.pcap"])
def test_files_that_could_block_a_reader_are_rejected(
    trial: Path, name: str, make_file: Callable[[Path], None]
) -> None:
    (trial / name).unlink()
    make_file(trial / name)
    with pytest.raises(EvidenceError, match="not a regular file") as caught:
        rebuild(trial)
    assert caught.value.where == str(trial / name)
    assert any(line.startswith(f"{name}: it is a ") for line in verification.verify(trial))


def test_a_pipe_as_a_table_does_not_block(
    trial: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (trial / "trial.csv").unlink()
    pipe(trial / "trial.csv")
    assert main(["aggregate", str(trial.parent)]) != 0
    assert "it is a pipe, not a regular file" in " ".join(capsys.readouterr().err.split())


@pytest.mark.parametrize("name", ["repeats", "repeats/udp-01"])
def test_a_link_to_another_folder_is_not_a_folder_of_the_trial(trial: Path, tmp_path: Path, name: str) -> None:
    (trial / name).rename(tmp_path / "elsewhere")
    (trial / name).symlink_to(tmp_path / "elsewhere")
    with pytest.raises(EvidenceError, match="it is a symbolic link"):
        plans.read_plan(trial)


def test_evidence_in_too_deep_folders_is_rejected(trial: Path) -> None:
    (trial / "repeats/udp-01/a/b").mkdir(parents=True)
    with pytest.raises(EvidenceError, match="a folder at a level below the folders of evidence"):
        plans.read_plan(trial)


def test_a_journal_with_a_second_name_is_not_written(trial: Path, foreign_file: Path) -> None:
    """A hard link shares its content with a backup or another local file, which a write would change."""
    (trial / "journal.jsonl").unlink()
    (trial / "journal.jsonl").hardlink_to(foreign_file)
    with (
        pytest.raises(ConfigurationError, match="hard link, and writing would change that file too"),
        journal.locked(trial),
    ):
        raise AssertionError("the journal was locked")
    with pytest.raises(OSError, match="hard link"):
        journal.append(trial, JournalEntry(1, Protocol.UDP, 1, 1, Status.RUNNING))
    assert foreign_file.read_text(encoding="utf-8") == FOREIGN_TEXT


def test_a_table_with_a_second_name_is_replaced_and_not_written(trial: Path, foreign_file: Path) -> None:
    (trial / "trial.csv").unlink()
    (trial / "trial.csv").hardlink_to(foreign_file)
    rebuild(trial)
    assert foreign_file.read_text(encoding="utf-8") == FOREIGN_TEXT
    assert (trial / "trial.csv").read_text(encoding="utf-8").startswith("schema_version,")


@pytest.mark.parametrize("name", ["out.csv", ".out.csv.new"])
def test_a_replacement_of_a_link_does_not_change_the_target_of_the_link(
    tmp_path: Path, foreign_file: Path, name: str
) -> None:
    (tmp_path / name).symlink_to(foreign_file)
    files.write(tmp_path / "out.csv", b"new")
    assert foreign_file.read_text(encoding="utf-8") == FOREIGN_TEXT
    assert not (tmp_path / "out.csv").is_symlink()
    assert (tmp_path / "out.csv").read_bytes() == b"new"


def test_unusual_names_are_written_to_the_manifest_as_by_sha256sum(trial: Path) -> None:
    unusual_names = ["a\nb.txt", "back\\slash", "re\rturn"]
    for name in unusual_names:
        (trial / "repeats/udp-01" / name).write_text("x", encoding="utf-8")
    Path(os.fsdecode(os.fsencode(trial / "repeats/udp-01") + b"/\xff.txt")).write_text("x", encoding="utf-8")
    lines = verification.verify(trial)
    assert len(lines) == len(unusual_names) + 1
    assert all(line.isprintable() and line.endswith(": not in the manifest") for line in lines)
    (trial / store.MANIFEST_FILE).unlink()
    ledger = Ledger(plans.read_plan(trial), trial, Stop())
    ledger.summarize()
    assert verification.verify(trial) == []
    assert os.system(f"cd '{trial}' && sha256sum --check --quiet MANIFEST.sha256") == 0


def false_journal(trial: Path, *entries: JournalEntry) -> None:
    journal.append(trial, *entries)


RUNNING, VALID, VOID, MEASURED = Status.RUNNING, Status.VALID, Status.VOID, Status.MEASURED


@pytest.mark.parametrize(
    ("entries", "reason"),
    [
        ([(1, 2, RUNNING)], "attempt 2 at udp-01 starts, although it or its repeat has ended"),
        ([(1, 3, RUNNING)], "attempt 3 at udp-01 starts, although it or its repeat has ended"),
        ([(1, 2, VALID)], "attempt 2 at udp-01 is valid, although it is not running"),
        ([(1, 7, VOID)], "attempt 7 at udp-01 is void, although it is not running"),
        ([(1, 7, MEASURED)], "attempt 7 at udp-01 is measured, although it is not running"),
        ([(2, 1, RUNNING)], "the plan has no repeat udp-02"),
        ([(1_000_000_000, 1, RUNNING)], "the plan has no repeat udp-1000000000"),
    ],
)
def test_a_contradictory_journal_is_reported_with_its_line(
    trial: Path, entries: list[tuple[int, int, Status]], reason: str
) -> None:
    false_journal(
        trial, *(JournalEntry(1, Protocol.UDP, number, attempt, status) for number, attempt, status in entries)
    )
    for read in (rebuild, lambda folder: Ledger(plans.read_plan(folder), folder, Stop())):
        with pytest.raises(EvidenceError, match=f"impossible entry: {reason}") as caught:
            read(trial)
        assert caught.value.where == f"{trial / journal.JOURNAL_FILE}:6"


@pytest.mark.parametrize(
    "line",
    [
        "[" * 100_000,
        '{"a":' * 100_000,
        json.dumps({"utc_ns": 10**400, "protocol": "udp", "number": 1, "attempt": 2, "status": "running"}),
        '{"utc_ns": 1e400, "protocol": "udp", "number": 1, "attempt": 2, "status": "running"}',
        '{"utc_ns": ' + "9" * 5000 + ', "protocol": "udp", "number": 1, "attempt": 2, "status": "running"}',
        '{"utc_ns": 1, "protocol": "udp", "number": -1, "attempt": 2, "status": "running"}',
        '{"utc_ns": 1, "protocol": "udp", "number": 1, "attempt": 99999999999999999999, "status": "running"}',
        '{"utc_ns": NaN, "protocol": "udp", "number": 1, "attempt": 2, "status": "running"}',
        "null",
        "\x00" * 100,
        "",
    ],
    ids=lambda line: line[:60],  # whole ids are sent between the processes of pytest-xdist
)
def test_the_error_of_an_invalid_line_has_its_line_number(trial: Path, line: str) -> None:
    with (trial / journal.JOURNAL_FILE).open("a", encoding="utf-8") as file:
        file.write(f"{line}\n")
    with pytest.raises(EvidenceError, match="not a journal entry") as caught:
        rebuild(trial)
    assert caught.value.where == f"{trial / journal.JOURNAL_FILE}:6"


def test_half_a_surrogate_pair_in_a_reason_is_stored_as_a_question_mark(tmp_path: Path) -> None:
    """Names of files that are not UTF-8 contain such characters, and reasons contain names of files."""
    plan = los_plan(repeats=1, protocols=(Protocol.UDP,))
    folder = store.create(tmp_path, plan)
    with journal.locked(folder):
        ledger = Ledger(plan, folder, Stop())
        repeat = RepeatId(Protocol.UDP, 1)
        entry = ledger.begin(repeat)
        reason = "cannot read \udcff\ud800.bag"
        ledger.commit(store.open_attempt(folder, repeat), replace(entry, status=VOID, reason=reason), Measured())
        ledger.summarize()
        (attempt,) = journal.ended_attempts(journal.history(folder, plan))
        assert attempt.reason == "cannot read ??.bag"
    assert "cannot read ??.bag" in (folder / store.TRIAL_CSV).read_text(encoding="utf-8")


def test_a_journal_that_an_older_fieldkit_wrote_with_half_a_pair_is_read(tmp_path: Path) -> None:
    jsonl.append(
        tmp_path / journal.JOURNAL_FILE,
        {"utc_ns": 1, "protocol": "udp", "number": 1, "attempt": 1, "status": "running", "reason": "\udcff"},
    )
    (entry,) = journal.read(tmp_path)
    assert entry.reason == "?"
    before = (tmp_path / journal.JOURNAL_FILE).read_bytes()
    journal.remove_torn_line(tmp_path)
    assert (tmp_path / journal.JOURNAL_FILE).read_bytes() == before
