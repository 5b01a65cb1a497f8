"""Reports with raw evidence of a small synthetic trial whose packets and replies are known."""

import math
import os
import re
import shutil
from dataclasses import replace
from pathlib import Path

import pytest

from fieldkit.analysis.cells import aggregate
from fieldkit.cli import main
from fieldkit.config import schema
from fieldkit.core.model import Role, TrackPoint
from fieldkit.measure.evidence import track
from fieldkit.report import distribution, packet_rasters, page, timeline, trial_folders
from fieldkit.report.contents import build_contents, repeat_to_draw
from fieldkit.report.series import Identities
from fieldkit.report.trial_folders import load_evidence
from fieldkit.trial import store
from fieldkit.trial.plan import PLAN_FILE
from fieldkit.trial.stored import plans, sources
from tests.helpers import recorded
from tests.report.test_report_page import HOSTILE, Elements

START_M = (0.0, 0.0, 0.2)


@pytest.fixture
def trial(tmp_path: Path) -> Path:
    (tmp_path / "trials").mkdir()
    return recorded.make(tmp_path / "trials")


def test_links_lead_to_existing_folders(trial: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    lab = trial.parent.parent
    monkeypatch.chdir(lab)
    (lab / "out").mkdir()
    assert main(["report", "trials", "-o", "out/report.html"]) == 0
    elements = Elements((lab / "out" / "report.html").read_text(encoding="utf-8"))
    links = [value for name, value in elements.attributes if name == "href" and value.startswith("../")]
    assert len(links) == 2 + 1 + 4  # the attempts, the trial, and its files
    assert {link for link in links if not (lab / "out" / link).exists()} == {
        f"../trials/{trial.name}/MANIFEST.sha256"
    }


def copy_trial(trial: Path, name: str) -> Path:
    """Copy a trial to a folder with another name; return the folder."""
    copy = trial.with_name(name)
    shutil.copytree(trial, copy)
    for file in ("trial.csv", PLAN_FILE):
        text = (copy / file).read_text(encoding="utf-8")
        (copy / file).write_text(text.replace(trial.name, name), encoding="utf-8")
    return copy


def test_a_trial_that_the_filter_removes_is_not_opened(trial: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    lab = trial.parent.parent
    monkeypatch.chdir(lab)
    os.mkfifo(copy_trial(trial, "other") / store.REPEATS / "pipe")
    pages = []
    for options in ((), ("--where", 'trial != "other"')):
        assert main(["report", "trials", "-o", "report.html", *options]) == 0
        pages.append((lab / "report.html").read_text(encoding="utf-8"))
    assert "other/repeats/pipe" in pages[0]
    assert "other" not in pages[1].replace("--where", "").replace("!= &#34;other&#34;", "")


def test_the_evidence_of_many_trials_is_limited(trial: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    copy_trial(trial, "other")
    monkeypatch.setattr(trial_folders, "MAX_TRIALS", 1)
    repeats = sources.find([trial.parent], print).read()
    for name in (trial.name, "other"):
        contents = build_contents(
            repeats, title="", repeat=f"{name}/udp-01", command=["fieldkit", "report", "trials"], paths=["trials"]
        )
        assert contents.evidence.verified_sources == {str(trial.parent / name)}
        assert any("of 1 of 2 trials" in warning.text for warning in contents.warnings)
        assert len(contents.evidence.plans) == 2
    text = page.render(replace(contents, max_trials=1), trial / "report.html")
    assert text.count('<th scope="row"><a href=') == 1
    assert "The first 1 of 2 trials" in text
    assert "fieldkit export trials --format csv" in text


def test_lost_packets_are_marked_at_their_positions(trial: Path) -> None:
    evidence = load_evidence(sources.find([trial], print).read())
    ((raster,),) = (group.rasters for group in packet_rasters.groups(aggregate(evidence.repeats), evidence))
    assert raster.lines == 1
    assert raster.columns == recorded.PACKETS
    assert raster.runs == [(0, 3, 2), (0, 17, 1)]
    assert raster.description.endswith("1 repeat, 3 of 40 IP packets lost, at most 2 in a row")


def test_each_reply_is_in_the_distribution(trial: Path) -> None:
    evidence = load_evidence(sources.find([trial], print).read())
    cells = aggregate(evidence.repeats)
    chart, *_ = distribution.charts(cells, Identities(cells), evidence)
    assert chart.title == "Round-trip time: distribution, 8192 bytes"
    ((series,),) = (panel.series for panel in chart.panels)
    assert sorted(set(series.x)) == pytest.approx(sorted(recorded.RTT_MS))


def test_time_line_has_all_packets_and_replies(trial: Path) -> None:
    evidence = load_evidence(sources.find([trial], print).read())
    row = repeat_to_draw(aggregate(evidence.repeats), evidence, "")
    assert row is not None
    assert evidence.repeats.texts["status"][row] == "valid"
    (phases, trips), (packets,) = (chart.panels for chart in timeline.charts(row, evidence))
    assert phases.lanes == ["ping", "receive", "send", "record"]
    counts = {series.label: len(series.x) for series in (*packets.series, *trips.series)}
    lost = len(recorded.LOST)
    assert counts == {
        "sent": recorded.PACKETS - lost,
        "received": recorded.PACKETS - lost + 1,
        "lost": lost,
        "round trip": len(recorded.RTT_MS),
        "no reply": 7,
    }
    # The receiver's clock is an hour ahead, which the captures do not show.
    assert max(packets.series[1].x) == pytest.approx(recorded.PACKETS)


def test_time_line_shows_the_distance_between_moving_robots(trial: Path) -> None:
    started_ns = recorded.START_NS + 10 * recorded.SECOND_NS
    places_m = {Role.SENDER: 1.0, Role.RECEIVER: 4.0}
    initial = [TrackPoint(0, role, (place_m, 0.0, 0.2)) for role, place_m in places_m.items()]
    moved_points = [
        TrackPoint(started_ns + 10**9, Role.SENDER, None),
        TrackPoint(started_ns + 2 * 10**9, Role.SENDER, START_M),
    ]
    file = trial / "repeats" / "udp-01" / "track.csv"
    for moves, panels in (([], 2), (moved_points, 3)):
        file.write_text(track.text([*initial, *moves]), encoding="ascii")
        evidence = load_evidence(sources.find([trial], print).read())
        row = repeat_to_draw(aggregate(evidence.repeats), evidence, "")
        assert row is not None
        chart, _ = timeline.charts(row, evidence)
        assert len(chart.panels) == panels
    (series,) = chart.panels[-1].series
    assert list(series.y) == pytest.approx([3.0, math.nan, 4.0], nan_ok=True)
    assert series.x[0] == 0 < series.x[1] == series.x[2] - 1


def test_repeat_of_the_time_line_can_be_selected(trial: Path) -> None:
    report = build_contents(sources.find([trial], print).read(), title="", repeat="udp-01.void1", command=())
    assert "one-repeat" not in [section.name for section in report.sections]
    report = build_contents(sources.find([trial], print).read(), title="", repeat=f"{trial.name}/udp-01", command=())
    assert report.sections[-1].charts[0].title == "Time line of udp-01"


def test_texts_of_the_operator_are_escaped(trial: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(trial.parent.parent)
    plan = plans.read_plan(trial).model_copy(update={"notes": HOSTILE, "versions": {HOSTILE: HOSTILE}})
    (trial / PLAN_FILE).write_text(schema.dump(plan), encoding="utf-8")
    assert main(["report", "trials"]) == 0
    text = Path("report.html").read_text(encoding="utf-8")
    assert "script" not in Elements(text).tags
    assert text.count("&lt;script&gt;alert(1)") == 3
    assert not re.search("[\x00-\x09\x0b-\x1f\u202e]", text)


def test_same_evidence_gives_the_same_page(trial: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(trial.parent.parent)
    pages = []
    for _ in range(2):
        assert main(["report", "trials", "--rebuild"]) == 0
        pages.append(Path("report.html").read_bytes())
    (trial / store.TRIAL_CSV).unlink()
    assert main(["report", "trials", "--rebuild"]) == 0
    assert pages == [Path("report.html").read_bytes()] * 2
