"""The stored state of a campaign: its frozen inputs and the progress of each trial, also with a truncated journal."""

from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fieldkit.backends.protocols import Backend
from fieldkit.backends.registry import load_backend
from fieldkit.campaign import plan
from fieldkit.campaign.journal import JOURNAL_FILE, CampaignJournal, TrialProgress
from fieldkit.campaign.order import walk_m
from fieldkit.campaign.plan import CampaignPlan
from fieldkit.campaign.runner import PLACING_S, CampaignRun
from fieldkit.config import schema
from fieldkit.config.site import load_site
from fieldkit.core.campaign_events import CampaignEnded, CampaignPlanned
from fieldkit.core.errors import ConfigurationError, EvidenceError
from fieldkit.core.events import Event
from fieldkit.core.prompts import Unattended
from fieldkit.trial.running.stop import Stop
from tests.helpers.casts import los_plan
from tests.helpers.paths import ROOT

LAWN = """\
name: lawn
procedures: [los, nlos]
distances: [10ft, 20ft]
topologies: [master, masterless]
repeats: 3
record: 1.1min
seed: 7
walk: 333ft
"""
SITE = """\
robots:
  a: {profile: turtlebot3_burger, host: 10.0.0.1, user: u, host_key: ssh-ed25519 AAAA}
  b: {profile: turtlebot3_burger, host: 10.0.0.2, user: u, host_key: ssh-ed25519 AAAA}
  c: {profile: duckiedrone, host: 10.0.0.3, user: u, host_key: ssh-ed25519 AAAA}
roles: {master: {sender: a, receiver: b, relay: c}, masterless: {sender: a, receiver: c}}
"""


@pytest.fixture
def lawn(tmp_path: Path) -> Path:
    path = tmp_path / "lawn.yaml"
    path.write_text(LAWN, encoding="utf-8")
    return path


def plan_and_journal(lawn: Path) -> tuple[CampaignPlan, CampaignJournal]:
    campaign_plan, _ = plan.make_plan(lawn, "field")
    return campaign_plan, CampaignJournal(lawn.parent / "campaign_lawn")


def test_the_frozen_plan_is_read_again_and_a_new_comment_is_no_change(lawn: Path) -> None:
    campaign_plan, journal = plan_and_journal(lawn)
    with journal.locked(campaign_plan):
        lawn.write_text(f"# dry grass\n{LAWN}", encoding="utf-8")
    new_plan, document = plan.make_plan(lawn, "field")
    frozen = plan.started_plan(journal.folder, new_plan, document)
    assert frozen is not None
    assert frozen.order == campaign_plan.order
    assert frozen.trials() == campaign_plan.trials()


@pytest.mark.parametrize(
    ("old", "new", "line", "changed_key"),
    [
        ("20ft", "25ft", 3, "distances"),
        ("seed: 7", "seed: 8", 7, "seed"),
        ("seed: 7", "seed: 7\nexcept: [{procedure: los}]", 8, "except"),
        ("repeats: 3", "", 1, "repeats"),
        ("name: lawn", "name: lawn", 1, "backend"),
    ],
)
def test_a_changed_file_is_rejected_with_the_key(lawn: Path, old: str, new: str, line: int, changed_key: str) -> None:
    campaign_plan, journal = plan_and_journal(lawn)
    with journal.locked(campaign_plan):
        lawn.write_text(LAWN.replace(old, new), encoding="utf-8")
    new_plan, document = plan.make_plan(lawn, "emulated" if changed_key == "backend" else "field")
    with pytest.raises(ConfigurationError) as error_info:
        plan.started_plan(journal.folder, new_plan, document)
    assert error_info.value.what == f"these have changed since the campaign started: {changed_key}"
    assert error_info.value.where == f"{lawn}:{line}"
    assert "campaign.yaml" in error_info.value.remedy


def test_a_changed_procedure_is_rejected(lawn: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(lawn.parent)
    campaign_plan, journal = plan_and_journal(lawn)
    with journal.locked(campaign_plan):
        Path("procedures").mkdir()
    shipped = ROOT / "procedures" / "los.yaml"
    changed_procedure = shipped.read_text(encoding="utf-8").replace("count: 10", "count: 11")
    Path("procedures/los.yaml").write_text(changed_procedure, encoding="utf-8")
    with pytest.raises(ConfigurationError, match="a file of its procedures"):
        plan.started_plan(journal.folder, *plan.make_plan(lawn, "field"))


def test_an_impossible_walk_is_rejected_with_the_minimum(lawn: Path) -> None:
    lawn.write_text(LAWN.replace("333ft", "5m"), encoding="utf-8")
    with pytest.raises(ConfigurationError, match="the shortest path") as error_info:
        plan.make_plan(lawn, "field")
    assert error_info.value.where == f"{lawn}:8"
    minimum_m = error_info.value.remedy.split("m ")[0].removeprefix("walk: ")
    lawn.write_text(LAWN.replace("333ft", f"{minimum_m}m"), encoding="utf-8")
    campaign_plan, _ = plan.make_plan(lawn, "field")
    assert walk_m(campaign_plan.trials()) <= float(minimum_m)


def test_progress_of_trials_is_stored_and_read_again(lawn: Path) -> None:
    campaign_plan, journal = plan_and_journal(lawn)
    first, second, third, *_ = campaign_plan.trials()
    with journal.locked(campaign_plan):
        for trial in (first, second, third):
            journal.add(trial, TrialProgress.STARTED, trial=f"trial of {trial}")
        journal.add(first, TrialProgress.PLACED, took_s=30.0, note="windy")
        journal.add(first, TrialProgress.ENDED, trial=f"trial of {first}", valid=3)
        journal.add(second, TrialProgress.SKIPPED)
        interrupted_trial = journal.folder / f"trial of {third}"
        interrupted_trial.mkdir()
        (interrupted_trial / "trial.yaml").touch()
    for journal_view in (journal, CampaignJournal(journal.folder)):
        assert list(journal_view.end_entries()) == [str(first)]
        assert journal_view.interrupted_folder(second) is None, "the trial has no folder"
        assert journal_view.interrupted_folder(third) == interrupted_trial
        assert journal_view.placing_s(99.0) == 30.0
    assert CampaignJournal(journal.folder / "none").placing_s(99.0) == 99.0


@settings(max_examples=30)
@given(st.integers(min_value=0, max_value=2000))
def test_a_campaign_continues_with_a_truncated_journal(
    tmp_path_factory: pytest.TempPathFactory, n_removed_bytes: int
) -> None:
    folder = tmp_path_factory.mktemp("lab")
    lawn = folder / "lawn.yaml"
    lawn.write_text(LAWN, encoding="utf-8")
    campaign_plan, journal = plan_and_journal(lawn)
    trials = campaign_plan.trials()
    with journal.locked(campaign_plan):
        for trial in trials[:-1]:
            journal.add(trial, TrialProgress.ENDED, valid=1)
    path = journal.folder / JOURNAL_FILE
    content = path.read_bytes()
    path.write_bytes(content[: max(0, len(content) - n_removed_bytes)])
    reopened_journal = CampaignJournal(journal.folder)
    n_complete = len(reopened_journal.end_entries())
    assert n_complete >= path.read_bytes().count(b"\n")
    with reopened_journal.locked(campaign_plan):
        reopened_journal.add(trials[-1], TrialProgress.ENDED, valid=1)
    assert list(CampaignJournal(journal.folder).end_entries()) == [*map(str, trials[:n_complete]), str(trials[-1])]


def test_a_damaged_journal_and_a_second_process_are_rejected(lawn: Path) -> None:
    campaign_plan, journal = plan_and_journal(lawn)
    with (
        journal.locked(campaign_plan),
        pytest.raises(ConfigurationError, match="another fieldkit process runs this campaign"),
        CampaignJournal(journal.folder).locked(campaign_plan),
    ):
        raise AssertionError("two processes have locked the journal")
    (journal.folder / JOURNAL_FILE).write_text('{"what": "lost"}\n{}\n', encoding="utf-8")
    with pytest.raises(EvidenceError, match="not a journal entry"):
        CampaignJournal(journal.folder)


def announced_plan(campaign_plan: CampaignPlan, journal: CampaignJournal, backend: Backend) -> CampaignPlanned:
    events: list[Event] = []
    CampaignRun(campaign_plan, journal, backend, events.append).announce()
    (event,) = events
    assert isinstance(event, CampaignPlanned)
    return event


def test_the_estimate_uses_measured_placing_times(lawn: Path) -> None:
    campaign_plan, journal = plan_and_journal(lawn)
    (lawn.parent / "fieldkit.yaml").write_text(SITE, encoding="utf-8")
    field_backend = load_backend("field", *load_site(lawn.parent / "fieldkit.yaml"))
    emulated_backend = load_backend("emulated", *load_site(lawn.parent / "fieldkit.yaml"))
    work_s = announced_plan(campaign_plan, journal, emulated_backend).left_s
    assert work_s > 8 * 3 * 2 * 66, "8 trials, 3 repeats of 2 protocols, recordings of 66 s"
    assert announced_plan(campaign_plan, journal, field_backend).left_s == pytest.approx(work_s + 8 * PLACING_S)
    first, second, *_ = campaign_plan.trials()
    with journal.locked(campaign_plan):
        journal.add(first, TrialProgress.PLACED, took_s=10.0)
        journal.add(second, TrialProgress.PLACED, took_s=30.0)
        journal.add(first, TrialProgress.ENDED, valid=6)
    event = announced_plan(campaign_plan, journal, field_backend)
    assert len(event.trials) == 7
    assert event.total == 8
    assert event.left_s == pytest.approx(work_s * 7 / 8 + 7 * 20.0)


def test_a_disk_too_small_for_the_evidence_is_reported_before_robots_are_placed(lawn: Path) -> None:
    lawn.write_text(LAWN.replace("repeats: 3", "repeats: 100000"), encoding="utf-8")
    campaign_plan, journal = plan_and_journal(lawn)
    events: list[Event] = []
    campaign = CampaignRun(campaign_plan, journal, load_backend("emulated", None, None), events.append)
    with pytest.raises(ConfigurationError, match="GB are free"):
        campaign.run(Unattended(), Stop())
    assert [type(event) for event in events] == [CampaignEnded], "no robot was started"
    assert journal.folder.is_dir(), "the order is stored"


def test_trials_with_failed_repeats_are_planned_again_with_option_failed(lawn: Path) -> None:
    campaign_plan, journal = plan_and_journal(lawn)
    backend = load_backend("emulated", None, None)
    complete, failed, *_ = campaign_plan.trials()
    with journal.locked(campaign_plan):
        for trial, count in ((complete, 0), (failed, 2)):
            journal.add(trial, TrialProgress.STARTED, trial=str(count))
            journal.add(trial, TrialProgress.ENDED, trial=str(count), failed=count)
    assert str(failed) not in announced_plan(campaign_plan, journal, backend).trials
    events: list[Event] = []
    campaign = CampaignRun(campaign_plan, journal, backend, events.append, failed=True)
    campaign.announce()
    (event,) = events
    assert isinstance(event, CampaignPlanned)
    assert str(failed) in event.trials
    assert str(complete) not in event.trials
    with journal.locked(campaign_plan):
        campaign._restart_failed()
    (journal.folder / "2").mkdir()
    (journal.folder / "2" / "trial.yaml").touch()
    for current_journal in (journal, CampaignJournal(journal.folder)):
        assert set(current_journal.end_entries()) == {str(complete)}
        assert current_journal.interrupted_folder(failed) == journal.folder / "2"


def test_planned_trials_without_an_attempt_are_named(tmp_path: Path) -> None:
    file = tmp_path / "yard.yaml"
    file.write_text(LAWN.replace("20ft", "30ft").replace("name: lawn", "name: yard"), encoding="utf-8")
    campaign_plan, _ = plan.make_plan(file, "field")
    journal = CampaignJournal(tmp_path / "campaign_yard")
    with journal.locked(campaign_plan):
        trial = journal.folder / "measured"
        trial.mkdir()
        (trial / "trial.yaml").write_text(schema.dump(los_plan()), encoding="utf-8")
    notes: list[str] = []
    unmeasured = list(plan.unmeasured([tmp_path], {str(trial)}, notes.append))
    assert set(unmeasured) == {*map(str, campaign_plan.trials())} - {"los 30ft master"}
    assert len(unmeasured) == 7
    assert not notes
