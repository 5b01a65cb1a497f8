"""What a campaign remembers: its frozen inputs, and what became of each trial, whatever tore the journal."""

from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fieldkit.backends.protocols import Backend
from fieldkit.backends.registry import load_backend
from fieldkit.campaign import frozen
from fieldkit.campaign.book import JOURNAL_FILE, Book, What
from fieldkit.campaign.frozen import Frozen
from fieldkit.campaign.order import walk_m
from fieldkit.campaign.runner import PLACING_S, Campaign
from fieldkit.config.profiles import load_site
from fieldkit.core.errors import ConfigurationError, EvidenceError
from fieldkit.core.events import CampaignEnded, CampaignPlanned, Event
from fieldkit.core.prompts import Nobody
from fieldkit.trial.stop import Stop
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


def begin(lawn: Path) -> tuple[Frozen, Book]:
    asked, _ = frozen.freeze(lawn, "field")
    return asked, Book(lawn.parent / "campaign_lawn")


def test_what_was_frozen_is_read_back_and_a_comment_changes_nothing(lawn: Path) -> None:
    asked, book = begin(lawn)
    with book.kept(asked):
        lawn.write_text(f"# dry grass\n{LAWN}", encoding="utf-8")
    again, document = frozen.freeze(lawn, "field")
    found = frozen.begun(book.folder, again, document)
    assert found is not None
    assert found.order == asked.order
    assert found.turns() == asked.turns()


@pytest.mark.parametrize(
    ("old", "new", "line", "named"),
    [
        ("20ft", "25ft", 3, "distances"),
        ("seed: 7", "seed: 8", 7, "seed"),
        ("seed: 7", "seed: 7\nexcept: [{procedure: los}]", 8, "except"),
        ("repeats: 3", "", 1, "repeats"),
        ("name: lawn", "name: lawn", 1, "backend"),
    ],
)
def test_a_file_that_changed_is_refused_and_the_key_named(
    lawn: Path, old: str, new: str, line: int, named: str
) -> None:
    asked, book = begin(lawn)
    with book.kept(asked):
        lawn.write_text(LAWN.replace(old, new), encoding="utf-8")
    again, document = frozen.freeze(lawn, "emulated" if named == "backend" else "field")
    with pytest.raises(ConfigurationError) as caught:
        frozen.begun(book.folder, again, document)
    assert caught.value.what == f"changed since the campaign was begun: {named}"
    assert caught.value.where == f"{lawn}:{line}"
    assert "campaign.yaml" in caught.value.remedy


def test_a_procedure_that_changed_is_refused(lawn: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(lawn.parent)
    asked, book = begin(lawn)
    with book.kept(asked):
        Path("procedures").mkdir()
    shipped = ROOT / "procedures" / "los.yaml"
    changed = shipped.read_text(encoding="utf-8").replace("count: 10", "count: 11")
    Path("procedures/los.yaml").write_text(changed, encoding="utf-8")
    with pytest.raises(ConfigurationError, match="a file of its procedures"):
        frozen.begun(book.folder, *frozen.freeze(lawn, "field"))


def test_a_walk_that_nobody_can_keep_is_refused_with_one_that_can(lawn: Path) -> None:
    lawn.write_text(LAWN.replace("333ft", "5m"), encoding="utf-8")
    with pytest.raises(ConfigurationError, match="the shortest way") as caught:
        frozen.freeze(lawn, "field")
    assert caught.value.where == f"{lawn}:8"
    walk = caught.value.remedy.split("m ")[0].removeprefix("walk: ")
    lawn.write_text(LAWN.replace("333ft", f"{walk}m"), encoding="utf-8")
    asked, _ = frozen.freeze(lawn, "field")
    assert walk_m(asked.turns()) <= float(walk)


def test_trials_begin_are_placed_skipped_and_end(lawn: Path) -> None:
    asked, book = begin(lawn)
    first, second, third, *_ = asked.turns()
    with book.kept(asked):
        for turn in (first, second, third):
            book.add(turn, What.STARTED, trial=f"trial of {turn}")
        book.add(first, What.PLACED, took_s=30.0, note="windy")
        book.add(first, What.ENDED, trial=f"trial of {first}", valid=3)
        book.add(second, What.SKIPPED)
        begun = book.folder / f"trial of {third}"
        begun.mkdir()
        (begun / "trial.yaml").touch()
    for seen in (book, Book(book.folder)):
        assert list(seen.ended()) == [str(first)]
        assert seen.interrupted(second) is None, "it has no folder"
        assert seen.interrupted(third) == begun
        assert seen.placing_s(99.0) == 30.0
    assert Book(book.folder / "none").placing_s(99.0) == 99.0


@settings(max_examples=30)
@given(st.integers(min_value=0, max_value=2000))
def test_a_journal_torn_anywhere_goes_on(tmp_path_factory: pytest.TempPathFactory, cut: int) -> None:
    folder = tmp_path_factory.mktemp("lab")
    lawn = folder / "lawn.yaml"
    lawn.write_text(LAWN, encoding="utf-8")
    asked, book = begin(lawn)
    turns = asked.turns()
    with book.kept(asked):
        for turn in turns[:-1]:
            book.add(turn, What.ENDED, valid=1)
    path = book.folder / JOURNAL_FILE
    whole = path.read_bytes()
    path.write_bytes(whole[: max(0, len(whole) - cut)])
    kept = Book(book.folder)
    complete = len(kept.ended())
    assert complete >= path.read_bytes().count(b"\n")
    with kept.kept(asked):
        kept.add(turns[-1], What.ENDED, valid=1)
    assert list(Book(book.folder).ended()) == [*map(str, turns[:complete]), str(turns[-1])]


def test_a_damaged_journal_and_a_second_fieldkit_are_refused(lawn: Path) -> None:
    asked, book = begin(lawn)
    with (
        book.kept(asked),
        pytest.raises(ConfigurationError, match="another fieldkit runs this campaign"),
        Book(book.folder).kept(asked),
    ):
        raise AssertionError("two at once")
    (book.folder / JOURNAL_FILE).write_text('{"what": "lost"}\n{}\n', encoding="utf-8")
    with pytest.raises(EvidenceError, match="not a journal entry"):
        Book(book.folder)


def planned(asked: Frozen, book: Book, backend: Backend) -> CampaignPlanned:
    told: list[Event] = []
    Campaign(asked, book, backend, told.append).announce()
    (event,) = told
    assert isinstance(event, CampaignPlanned)
    return event


def test_the_estimate_learns_how_long_people_take(lawn: Path) -> None:
    asked, book = begin(lawn)
    (lawn.parent / "fieldkit.yaml").write_text(SITE, encoding="utf-8")
    by_hand = load_backend("field", *load_site(lawn.parent / "fieldkit.yaml"))
    by_itself = load_backend("emulated", *load_site(lawn.parent / "fieldkit.yaml"))
    work_s = planned(asked, book, by_itself).left_s
    assert work_s > 8 * 3 * 2 * 66, "8 trials, 3 repeats of 2 protocols, recordings of 66 s"
    assert planned(asked, book, by_hand).left_s == pytest.approx(work_s + 8 * PLACING_S)
    first, second, *_ = asked.turns()
    with book.kept(asked):
        book.add(first, What.PLACED, took_s=10.0)
        book.add(second, What.PLACED, took_s=30.0)
        book.add(first, What.ENDED, valid=6)
    event = planned(asked, book, by_hand)
    assert len(event.trials) == 7
    assert event.total == 8
    assert event.left_s == pytest.approx(work_s * 7 / 8 + 7 * 20.0)


def test_a_disk_that_cannot_hold_the_evidence_is_noticed_before_anybody_walks(lawn: Path) -> None:
    lawn.write_text(LAWN.replace("repeats: 3", "repeats: 1000000000"), encoding="utf-8")
    asked, book = begin(lawn)
    told: list[Event] = []
    campaign = Campaign(asked, book, load_backend("emulated", None, None), told.append)
    with pytest.raises(ConfigurationError, match="GB are free"):
        campaign.run(Nobody(), Stop())
    assert [type(event) for event in told] == [CampaignEnded], "no robot was started"
    assert book.folder.is_dir(), "and the order is kept"
