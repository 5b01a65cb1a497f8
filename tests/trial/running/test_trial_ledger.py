"""The ledger: linear cost, each repeat is measured once, and changed evidence is rejected."""

import os
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import pytest

from fieldkit.cli import main
from fieldkit.config.schema import parse, validate
from fieldkit.core import files
from fieldkit.core.columns import Column
from fieldkit.core.errors import EvidenceError
from fieldkit.core.model import RepeatId, Status
from fieldkit.core.units import parse_distance
from fieldkit.measure.attempt import AttemptEvidence
from fieldkit.measure.evidence import ping
from fieldkit.trial import gates, journal, manifest, rows, store
from fieldkit.trial.columns import Row
from fieldkit.trial.plan import Plan
from fieldkit.trial.procedure import Procedure
from fieldkit.trial.request import TrialRequest, make_plan
from fieldkit.trial.running import ledger
from fieldkit.trial.running.ledger import Ledger
from fieldkit.trial.running.stop import Stop
from fieldkit.trial.stored import plans, verification
from fieldkit.trial.stored.rebuild import rebuild
from tests.helpers.casts import CAST
from tests.trial.test_trial_crash import PING, PROCEDURE

CHANGED_FILE = "repeats/tcp-02/ping.txt"


def begin_trial(out: Path, repeats: int) -> tuple[Ledger, Plan, Path]:
    """Start a trial with this number of repeats, each with one ping."""
    request = TrialRequest(validate(parse(PROCEDURE, source="x"), Procedure), parse_distance("30ft"), repeats=repeats)
    plan = make_plan(request, backend="field", cast=CAST, now=datetime(2026, 11, 20, 12, 0, tzinfo=UTC))
    folder = store.create(out / str(repeats), plan)
    (folder / journal.JOURNAL_FILE).touch()
    return Ledger(plan, folder, Stop()), plan, folder


def add_valid_repeat(trial_ledger: Ledger, plan: Plan, folder: Path, repeat: RepeatId) -> None:
    entry = trial_ledger.begin(repeat)
    partial = store.open_attempt(folder, repeat)
    (partial / "ping.txt").write_text(PING, encoding="ascii")
    trial_ledger.record_measured(entry)
    measured = gates.judge(plan, repeat, AttemptEvidence(partial)).measured
    trial_ledger.commit(partial, replace(entry, status=Status.VALID), measured)


@pytest.fixture
def trial(tmp_path: Path) -> Path:
    """A trial with three planned repeats, of which two have ended."""
    trial_ledger, plan, folder = begin_trial(tmp_path, 3)
    for repeat in list(plan.repeats_in_order())[:2]:
        add_valid_repeat(trial_ledger, plan, folder, repeat)
    trial_ledger.summarize()
    return folder


def reopen(folder: Path) -> Ledger:
    return Ledger(plans.read_plan(folder), folder, Stop())


def test_written_bytes_and_rendered_rows_grow_linearly(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """With a new table and manifest after each repeat, the bytes would grow with the square of the repeats."""
    monkeypatch.setattr(ledger, "TABLE_SHARE", 0.1)
    monkeypatch.setattr(os, "fsync", lambda _: None)
    written_bytes: Counter[int] = Counter()
    rendered_rows: Counter[int] = Counter()
    write, line = files.write, rows.line
    now = 0

    def count_bytes(path: Path, content: bytes) -> None:
        written_bytes[now] += len(content)
        write(path, content)

    def count_line(row: Row, table: Sequence[Column]) -> str:
        rendered_rows[now] += 1
        return line(row, table)

    monkeypatch.setattr(files, "write", count_bytes)
    monkeypatch.setattr(rows, "line", count_line)
    for now in (60, 120):
        trial_ledger, plan, folder = begin_trial(tmp_path, now)
        for repeat in plan.repeats_in_order():
            add_valid_repeat(trial_ledger, plan, folder, repeat)
        trial_ledger.summarize()
        assert trial_ledger.finished_count == now
        assert rendered_rows[now] == now
        assert verification.verify(folder) == []
    assert written_bytes[120] < 3 * written_bytes[60]


def test_a_small_trial_writes_every_row_immediately(trial: Path) -> None:
    plan = plans.read_plan(trial)
    before = (trial / store.TRIAL_CSV).read_text(encoding="utf-8")
    add_valid_repeat(reopen(trial), plan, trial, list(plan.repeats_in_order())[2])
    after = (trial / store.TRIAL_CSV).read_text(encoding="utf-8")
    assert after.startswith(before)
    assert after.count("\n") == before.count("\n") + 1


def test_a_reopened_trial_measures_nothing_and_computes_no_checksum_again(
    trial: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    table = (trial / store.TRIAL_CSV).read_bytes()

    def fail_on_call(*_: object) -> None:
        raise AssertionError("a repeat was measured again, or a checksum computed again")

    monkeypatch.setattr(gates, "judge", fail_on_call)
    monkeypatch.setattr(manifest.Manifest, "add", fail_on_call)
    trial_ledger = reopen(trial)
    assert trial_ledger.differences == {}
    assert (trial_ledger.finished_count, trial_ledger.counts(Status.VALID)) == (2, 2)
    trial_ledger.summarize()
    assert (trial / store.TRIAL_CSV).read_bytes() == table


def test_rows_missing_in_the_table_after_a_kill_are_measured(trial: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    plan = plans.read_plan(trial)
    table = (trial / store.TRIAL_CSV).read_bytes()
    monkeypatch.setattr(ledger, "TABLE_SHARE", 2.0)
    add_valid_repeat(reopen(trial), plan, trial, list(plan.repeats_in_order())[2])
    assert (trial / store.TRIAL_CSV).read_bytes() == table, "the process is killed here"
    reopen(trial).summarize()
    assert verification.verify(trial) == []
    assert rebuild(trial).changed == ()
    assert (trial / store.TRIAL_CSV).read_bytes().startswith(table)


def test_only_rebuilt_tables_get_new_checksums(trial: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A rebuild with another version of fieldkit changes the table; changes of other files are still reported."""
    with (trial / "preflight.txt").open("a", encoding="utf-8") as file:
        file.write("changed\n")
    reopen(trial).summarize()
    header, line = rows.header, rows.line
    monkeypatch.setattr(rows, "header", lambda table: f"more,{header(table)}")
    monkeypatch.setattr(rows, "line", lambda row, table: f",{line(row, table)}")
    monkeypatch.setattr(rows, "write_summary", lambda folder, plan, table: ())
    before = verification.verify(trial)
    (trial / "preflight.txt").write_text("changed once more\n", encoding="utf-8")
    assert rebuild(trial).changed == (store.TRIAL_CSV,)
    assert verification.verify(trial) == [*before, "preflight.txt: changed"]


def change_file(path: Path) -> None:
    path.write_text(PING.replace("time=2 ms", "time=9 ms"), encoding="ascii")


@pytest.mark.parametrize(
    ("change", "changes"),
    [
        (change_file, {CHANGED_FILE: "changed"}),
        (Path.unlink, {CHANGED_FILE: "missing"}),
        (lambda path: change_file(path.with_name("more.txt")), {"repeats/tcp-02/more.txt": "not in the manifest"}),
        (lambda path: path.parent.rename(path.parent.with_name("moved")), {CHANGED_FILE: "missing"}),
    ],
    ids=["changed", "missing", "more", "moved"],
)
def test_checksums_are_kept_and_differences_reported(
    trial: Path,
    change: Callable[[Path], object],
    changes: dict[str, str],
    capsys: pytest.CaptureFixture[str],
) -> None:
    tables = {name: (trial / name).read_bytes() for name in (store.TRIAL_CSV, store.SUMMARY_CSV)}
    change(trial / CHANGED_FILE)
    output_text = [f"{name}: {kind}" for name, kind in changes.items()]
    trial_ledger = reopen(trial)
    assert trial_ledger.differences == changes
    trial_ledger.summarize()
    assert set(output_text) <= set(verification.verify(trial))
    with pytest.raises(EvidenceError, match="so the tables are not rebuilt") as caught:
        rebuild(trial)
    assert all(text in caught.value.what for text in output_text)
    assert {name: (trial / name).read_bytes() for name in tables} == tables
    assert main(["aggregate", str(trial), "--rebuild"]) == 0
    assert all(text in " ".join(capsys.readouterr().err.split()) for text in output_text)
    assert main(["export", str(trial), "--format", "mcap", "-o", str(trial.parent / "out.mcap")]) == 0
    assert all(text in " ".join(capsys.readouterr().err.split()) for text in output_text)


def test_changes_of_plan_journal_and_table_are_reported(trial: Path) -> None:
    for name in (store.TRIAL_CSV, "trial.yaml"):
        with (trial / name).open("a", encoding="utf-8") as file:
            file.write("\n" if name == "trial.yaml" else "x\n")
    text = (trial / journal.JOURNAL_FILE).read_text(encoding="utf-8")
    (trial / journal.JOURNAL_FILE).write_text(text.replace("valid", "failed", 1), encoding="utf-8")
    (trial / "repeats/tcp-01").rename(trial / "repeats/tcp-01.failed1")
    trial_ledger = reopen(trial)
    assert trial_ledger.differences.items() >= {("trial.yaml", "changed"), ("journal.jsonl", "changed")}
    trial_ledger.summarize()
    assert "trial.yaml: changed" in verification.verify(trial)


@pytest.mark.parametrize("name", [journal.JOURNAL_FILE, "trial.yaml"])
def test_no_table_is_rebuilt_from_a_changed_plan_or_journal(trial: Path, name: str) -> None:
    """A truncated journal may have fewer repeats, and an edited plan may have another distance."""
    tables = {name: (trial / name).read_bytes() for name in (store.TRIAL_CSV, store.SUMMARY_CSV)}
    text = (trial / name).read_text(encoding="utf-8")
    truncated = "".join(text.splitlines(keepends=True)[:-1])
    (trial / name).write_text(truncated if name == journal.JOURNAL_FILE else text + "\n", encoding="utf-8")
    with pytest.raises(EvidenceError, match=f"so the tables are not rebuilt: {name}: changed"):
        rebuild(trial)
    assert {name: (trial / name).read_bytes() for name in tables} == tables


def test_too_little_memory_leaves_the_table_unchanged(
    trial: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Too little memory is no error of the evidence, so values must not be missing because of it."""
    tables = {name: (trial / name).read_bytes() for name in (store.TRIAL_CSV, store.SUMMARY_CSV)}

    def raise_memory_error(_path: Path) -> ping.Ping:
        raise MemoryError

    monkeypatch.setattr(ping, "read", raise_memory_error)
    assert main(["rebuild", str(trial)]) == 2
    assert "this machine has too little memory\n  remedy: " in capsys.readouterr().err
    assert {name: (trial / name).read_bytes() for name in tables} == tables


def test_a_table_is_not_rebuilt_from_changed_evidence(trial: Path) -> None:
    (trial / store.TRIAL_CSV).write_text("gone\n", encoding="utf-8")
    change_file(trial / CHANGED_FILE)
    with pytest.raises(EvidenceError, match=rf"evidence has changed since it was measured: {CHANGED_FILE}: changed"):
        reopen(trial)


def test_a_missing_table_is_rebuilt_and_reported(trial: Path) -> None:
    table = (trial / store.TRIAL_CSV).read_bytes()
    (trial / store.TRIAL_CSV).unlink()
    trial_ledger = reopen(trial)
    assert trial_ledger.differences == {store.TRIAL_CSV: "changed"}
    trial_ledger.summarize()
    assert (trial / store.TRIAL_CSV).read_bytes() == table


def test_a_missing_or_invalid_manifest_is_reported(trial: Path) -> None:
    (trial / store.MANIFEST_FILE).write_text("nonsense\n", encoding="utf-8")
    with pytest.raises(EvidenceError, match="no readable manifest: not a line of a manifest: nonsense") as caught:
        reopen(trial)
    assert caught.value.remedy == "restore the file from a copy"
    (trial / store.MANIFEST_FILE).unlink()
    assert reopen(trial).differences.keys() == {store.MANIFEST_FILE}


def test_a_report_leaves_out_changed_evidence_with_a_note(trial: Path) -> None:
    change_file(trial / CHANGED_FILE)
    page = trial.parent / "report.html"
    assert main(["report", str(trial), "-o", str(page)]) == 0
    assert f"evidence that differs from the manifest is left out: {CHANGED_FILE}: changed" in page.read_text(
        encoding="utf-8"
    )
