"""Tables and events as they are printed."""

import argparse

import pytest

from fieldkit.cli import catalog
from fieldkit.cli.display import table, words_of
from fieldkit.core.events import CampaignPlanned, CampaignWent, RepeatEnded
from fieldkit.core.model import Status
from tests.helpers.paths import ROOT


def test_a_table_wider_than_the_screen_breaks_no_name_and_no_figure(capsys: pytest.CaptureFixture[str]) -> None:
    table([f"quantity {n}" for n in range(20)], [["masterless", *["[0.00, 56.15]"] * 19]], right=range(1, 20))
    head, _, row = capsys.readouterr().out.splitlines()
    assert len(row) > 200
    assert row.split("  ") == [" masterless", *["[0.00, 56.15]"] * 19]
    assert head.split() == [part for n in range(20) for part in ("quantity", str(n))]


def test_words_at_the_end_of_a_line_are_folded_between_words(capsys: pytest.CaptureFixture[str]) -> None:
    verdict = "no difference seen; " * 20
    table(("quantity", "A", "verdict"), [("RTT, median", "1.05 ms", verdict)], right=(1,))
    _, _, *lines = capsys.readouterr().out.splitlines()
    assert len(lines) > 1
    assert all(len(line) <= 160 for line in lines)
    first, *rest = (" ".join(line.split()) for line in lines)
    assert " ".join((first, *rest)) == f"RTT, median 1.05 ms {verdict.strip()}"


def test_a_title_longer_than_its_table_stays_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    table(("n",), [("3",)], title="repeats, nlos, masterless, emulated, 30ft")
    assert capsys.readouterr().out.splitlines()[0] == "repeats, nlos, masterless, emulated, 30ft"


def test_why_a_repeat_is_not_valid_comes_before_what_it_measured() -> None:
    ended = RepeatEnded("udp-07", 1, Status.VOID, "no message", "RTT 1.3 ms", done=0, total=2, left_s=0.0)
    assert "".join(text for text, _ in words_of(ended)) == "  0/2  udp-07  void   no message; RTT 1.3 ms"


def test_a_campaign_that_is_done_tells_of_no_time_and_no_disk() -> None:
    went = CampaignWent("los 10ft master", done=2, total=2, left_s=0.0)
    planned = CampaignPlanned("small", (), 2, 2, walk_m=0.0, left_s=0.0, needed_bytes=0, free_bytes=1 << 30)
    for event in (went, planned):
        assert "".join(text for text, _ in words_of(event)) == "campaign: 2 of 2 trials are done"


def test_a_path_in_a_list_of_robots_is_never_folded(capsys: pytest.CaptureFixture[str]) -> None:
    catalog.robots(argparse.Namespace(profile=None))
    head, _, *rows = capsys.readouterr().out.splitlines()
    assert head.split() == ["name", "file", "summary"]
    assert any(str(ROOT / "robots" / "duckiedrone.yaml") in row for row in rows)
