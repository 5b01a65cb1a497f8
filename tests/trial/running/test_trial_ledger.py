"""The ledger: linear cost, no repeated measurement or checksum, and no acceptance of changed evidence."""

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

CHANGED = "repeats/tcp-02/ping.txt"


def begin(out: Path, repeats: int) -> tuple[Ledger, Plan, Path]:
    """Start a trial with this number of repeats, each with one ping."""
    request = TrialRequest(validate(parse(PROCEDURE, source="x"), Procedure), parse_distance("30ft"), repeats=repeats)
    plan = make_plan(request, backend="field", cast=CAST, now=datetime(2026, 11, 20, 12, 0, tzinfo=UTC))
    folder = store.create(out / str(repeats), plan)
    (folder / journal.JOURNAL_FILE).touch()
    return Ledger(plan, folder, Stop()), plan, folder


def keep(to: Ledger, plan: Plan, folder: Path, repeat: RepeatId) -> None:
    entry = to.begin(repeat)
    partial = store.open_attempt(folder, repeat)
    (partial / "ping.txt").write_text(PING, encoding="ascii")
    to.record_measured(entry)
    measured = gates.judge(plan, repeat, AttemptEvidence(partial)).measured
    to.commit(partial, replace(entry, status=Status.VALID), measured)


@pytest.fixture
def trial(tmp_path: Path) -> Path:
    """A trial of three repeats, of which two have ended."""
    to, plan, folder = begin(tmp_path, 3)
    for repeat in list(plan.repeats_in_order())[:2]:
        keep(to, plan, folder, repeat)
    to.summarize()
    return folder


def reopened(folder: Path) -> Ledger:
    return Ledger(plans.read_plan(folder), folder, Stop())


def test_written_bytes_and_rendered_rows_grow_linearly(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Twice the repeats take twice the bytes; with a new table and manifest after each they would take four times."""
    monkeypatch.setattr(ledger, "TABLE_SHARE", 0.1)
    monkeypatch.setattr(os, "fsync", lambda _: None)
    written: Counter[int] = Counter()
    rendered: Counter[int] = Counter()
    write, line = files.write, rows.line
    now = 0

    def counted(path: Path, content: bytes) -> None:
        written[now] += len(content)
        write(path, content)

    def counted_line(row: Row, table: Sequence[Column]) -> str:
        rendered[now] += 1
        return line(row, table)

    monkeypatch.setattr(files, "write", counted)
    monkeypatch.setattr(rows, "line", counted_line)
    for now in (60, 120):
        to, plan, folder = begin(tmp_path, now)
        for repeat in plan.repeats_in_order():
            keep(to, plan, folder, repeat)
        to.summarize()
        assert to.finished_count == now
        assert rendered[now] == now
        assert verification.verify(folder) == []
    assert written[120] < 3 * written[60]


def test_a_small_trial_writes_every_row_immediately(trial: Path) -> None:
    plan = plans.read_plan(trial)
    before = (trial / store.TRIAL_CSV).read_text(encoding="utf-8")
    keep(reopened(trial), plan, trial, list(plan.repeats_in_order())[2])
    after = (trial / store.TRIAL_CSV).read_text(encoding="utf-8")
    assert after.startswith(before)
    assert after.count("\n") == before.count("\n") + 1


def test_a_reopened_trial_measures_nothing_and_computes_no_checksum_again(
    trial: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    table = (trial / store.TRIAL_CSV).read_bytes()

    def never(*_: object) -> None:
        raise AssertionError("measured or summed again")

    monkeypatch.setattr(gates, "judge", never)
    monkeypatch.setattr(manifest.Manifest, "add", never)
    to = reopened(trial)
    assert to.differences == {}
    assert (to.finished_count, to.counts(Status.VALID)) == (2, 2)
    to.summarize()
    assert (trial / store.TRIAL_CSV).read_bytes() == table


def test_rows_missing_in_the_table_after_a_kill_are_measured(trial: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    plan = plans.read_plan(trial)
    table = (trial / store.TRIAL_CSV).read_bytes()
    monkeypatch.setattr(ledger, "TABLE_SHARE", 2.0)
    keep(reopened(trial), plan, trial, list(plan.repeats_in_order())[2])
    assert (trial / store.TRIAL_CSV).read_bytes() == table, "the process is killed here"
    reopened(trial).summarize()
    assert verification.verify(trial) == []
    assert rebuild(trial).changed == ()
    assert (trial / store.TRIAL_CSV).read_bytes().startswith(table)


def test_only_rebuilt_tables_get_new_checksums(trial: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Another version of fieldkit measures other rows; an edited journal is still reported as changed."""
    with (trial / "preflight.txt").open("a", encoding="utf-8") as file:
        file.write("changed\n")
    reopened(trial).summarize()
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
        (change_file, {CHANGED: "changed"}),
        (Path.unlink, {CHANGED: "missing"}),
        (lambda path: change_file(path.with_name("more.txt")), {"repeats/tcp-02/more.txt": "not in the manifest"}),
        (lambda path: path.parent.rename(path.parent.with_name("moved")), {CHANGED: "missing"}),
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
    change(trial / CHANGED)
    output_text = [f"{name}: {kind}" for name, kind in changes.items()]
    to = reopened(trial)
    assert to.differences == changes
    to.summarize()
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
    to = reopened(trial)
    assert to.differences.items() >= {("trial.yaml", "changed"), ("journal.jsonl", "changed")}
    to.summarize()
    assert "trial.yaml: changed" in verification.verify(trial)


@pytest.mark.parametrize("name", [journal.JOURNAL_FILE, "trial.yaml"])
def test_no_table_is_rebuilt_from_a_changed_plan_or_journal(trial: Path, name: str) -> None:
    """A journal cut at the end of a line has fewer repeats, an edited plan has another distance."""
    tables = {name: (trial / name).read_bytes() for name in (store.TRIAL_CSV, store.SUMMARY_CSV)}
    text = (trial / name).read_text(encoding="utf-8")
    cut = "".join(text.splitlines(keepends=True)[:-1])
    (trial / name).write_text(cut if name == journal.JOURNAL_FILE else text + "\n", encoding="utf-8")
    with pytest.raises(EvidenceError, match=f"so the tables are not rebuilt: {name}: changed"):
        rebuild(trial)
    assert {name: (trial / name).read_bytes() for name in tables} == tables


def test_too_little_memory_leaves_the_table_unchanged(
    trial: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Too little memory is not a property of the evidence, so no value is left out because of it."""
    tables = {name: (trial / name).read_bytes() for name in (store.TRIAL_CSV, store.SUMMARY_CSV)}

    def exhausted(_path: Path) -> ping.Ping:
        raise MemoryError

    monkeypatch.setattr(ping, "read", exhausted)
    assert main(["rebuild", str(trial)]) == 2
    assert "this machine has too little memory\n  remedy: " in capsys.readouterr().err
    assert {name: (trial / name).read_bytes() for name in tables} == tables


def test_a_table_is_not_rebuilt_from_changed_evidence(trial: Path) -> None:
    (trial / store.TRIAL_CSV).write_text("gone\n", encoding="utf-8")
    change_file(trial / CHANGED)
    with pytest.raises(EvidenceError, match=rf"evidence has changed since it was measured: {CHANGED}: changed"):
        reopened(trial)


def test_a_missing_table_is_rebuilt_and_reported(trial: Path) -> None:
    table = (trial / store.TRIAL_CSV).read_bytes()
    (trial / store.TRIAL_CSV).unlink()
    to = reopened(trial)
    assert to.differences == {store.TRIAL_CSV: "changed"}
    to.summarize()
    assert (trial / store.TRIAL_CSV).read_bytes() == table


def test_a_missing_or_invalid_manifest_is_reported(trial: Path) -> None:
    (trial / store.MANIFEST_FILE).write_text("nonsense\n", encoding="utf-8")
    with pytest.raises(EvidenceError, match="no readable manifest: not a line of a manifest: nonsense") as caught:
        reopened(trial)
    assert caught.value.remedy == "restore the file from a copy"
    (trial / store.MANIFEST_FILE).unlink()
    assert reopened(trial).differences.keys() == {store.MANIFEST_FILE}


def test_a_report_leaves_out_changed_evidence_with_a_note(trial: Path) -> None:
    change_file(trial / CHANGED)
    page = trial.parent / "report.html"
    assert main(["report", str(trial), "-o", str(page)]) == 0
    assert f"evidence that differs from the manifest is left out: {CHANGED}: changed" in page.read_text(
        encoding="utf-8"
    )
