"""Tables and events as the command line prints them."""

import argparse
import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from fieldkit.cli import main
from fieldkit.cli.commands import listings
from fieldkit.cli.display import print_table
from fieldkit.cli.event_words import event_words
from fieldkit.core.campaign_events import CampaignPlanned, CampaignWent
from fieldkit.core.events import RepeatEnded
from fieldkit.core.model import Status
from tests.helpers.paths import ROOT
from tests.helpers.stored_trials import TRIALS


def test_a_table_wider_than_the_screen_does_not_wrap_names_and_values(capsys: pytest.CaptureFixture[str]) -> None:
    print_table([f"quantity {n}" for n in range(20)], [["masterless", *["[0.00, 56.15]"] * 19]], right=range(1, 20))
    header, _, row = capsys.readouterr().out.splitlines()
    assert len(row) > 200
    assert row.split("  ") == [" masterless", *["[0.00, 56.15]"] * 19]
    assert header.split() == [part for n in range(20) for part in ("quantity", str(n))]


def test_a_summary_wider_than_the_terminal_has_a_table_per_protocol(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    trial = shutil.copytree(TRIALS / "20261122T010946.593049Z_los_30ft_master", tmp_path / "los")
    main(["rebuild", str(trial)])
    wide_output = capsys.readouterr().out
    monkeypatch.setattr(sys.stdout, "isatty", lambda: True)
    monkeypatch.setenv("COLUMNS", "80")
    main(["rebuild", str(trial)])
    narrow_output = re.sub("\x1b[^m]*m", "", capsys.readouterr().out)
    assert max(map(len, wide_output.splitlines())) > 80 >= max(map(len, narrow_output.splitlines()))
    assert {word for word in wide_output.split() if "─" not in word} == {
        word for word in narrow_output.split() if "─" not in word
    }
    assert [line.split()[-1] for line in narrow_output.splitlines() if line.startswith(" [95")] == ["TCP", "UDP"]


@pytest.mark.parametrize("columns", [60, 80, 100])
def test_a_summary_of_a_trial_fits_a_narrow_terminal(
    tmp_path: Path, columns: int, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """No value is broken; in the narrowest terminal, an interval is below its value."""
    trial = shutil.copytree(TRIALS / "20261122T013134.573068Z_los_30ft_master", tmp_path / "los")
    main(["rebuild", str(trial)])
    wide_output = capsys.readouterr().out
    monkeypatch.setattr(sys.stdout, "isatty", lambda: True)
    monkeypatch.setenv("COLUMNS", str(columns))
    main(["rebuild", str(trial)])
    narrow_output = re.sub("\x1b[^m]*m", "", capsys.readouterr().out)
    assert max(map(len, narrow_output.splitlines())) <= columns
    figure = re.compile(r"\d\.\d+ [%a-zA-Z/]+|\[\d+\.\d[^]]*\]\*?")
    assert sorted(figure.findall(wide_output)) == sorted(figure.findall(narrow_output))


def test_long_text_wraps_between_words(capsys: pytest.CaptureFixture[str]) -> None:
    verdict = "no difference seen; " * 20
    print_table(("quantity", "A", "verdict"), [("RTT, median", "1.05 ms", verdict)], right=(1,))
    _, _, *lines = capsys.readouterr().out.splitlines()
    assert len(lines) > 1
    assert all(len(line) <= 160 for line in lines)
    first_line, *other_lines = (" ".join(line.split()) for line in lines)
    assert " ".join((first_line, *other_lines)) == f"RTT, median 1.05 ms {verdict.strip()}"


def test_a_title_longer_than_its_table_stays_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    print_table(("n",), [("3",)], title="repeats, nlos, masterless, emulated, 30ft")
    assert capsys.readouterr().out.splitlines()[0] == "repeats, nlos, masterless, emulated, 30ft"


def test_reason_of_a_void_repeat_precedes_its_measurements() -> None:
    event = RepeatEnded("udp-07", 1, Status.VOID, "no message", "RTT 1.3 ms", done=0, total=2, left_s=0.0)
    assert "".join(text for text, _ in event_words(event)) == "  0/2  udp-07  void   no message; measured: RTT 1.3 ms"


def test_remedy_for_a_failed_step_is_below_its_repeat() -> None:
    event = RepeatEnded("udp-07", 1, Status.VOID, "too late", "", done=0, total=2, left_s=0, remedy="a larger idle")
    _, remedy_line = "".join(text for text, _ in event_words(event)).splitlines()
    assert remedy_line.split() == ["remedy:", "a", "larger", "idle"]


def test_finished_campaign_shows_no_time_and_no_disk_space() -> None:
    progress = CampaignWent("los 10ft master", done=2, total=2, left_s=0.0)
    campaign_planned = CampaignPlanned("small", (), 2, 2, walk_m=0.0, left_s=0.0, needed_bytes=0, free_bytes=1 << 30)
    for event in (progress, campaign_planned):
        assert "".join(text for text, _ in event_words(event)) == "campaign: 2 of 2 trials are done"


def test_paths_in_the_list_of_robots_are_not_wrapped(capsys: pytest.CaptureFixture[str]) -> None:
    listings.run_robots(argparse.Namespace(profile=None))
    header, _, *rows = capsys.readouterr().out.splitlines()
    assert header.split() == ["name", "file", "summary"]
    assert any(str(ROOT / "robots" / "duckiedrone.yaml") in row for row in rows)


def test_table_has_a_header_a_rule_and_aligned_columns(capsys: pytest.CaptureFixture[str]) -> None:
    rows = [("RTT", "1.05 ms\n[1.00, 1.10]", "same"), ("漢", "", ""), ("", "", "")]
    print_table(("quantity", "A", "verdict"), rows, title="los", right=(1,))
    assert capsys.readouterr().out.splitlines() == [
        "los",
        " quantity             A  verdict",
        " ────────────────────────────────",
        " RTT            1.05 ms  same",
        "           [1.00, 1.10]",
        " 漢",
    ]


REPORT_EVENTS = """
from threading import Thread
from fieldkit.cli.display import showing_events
from fieldkit.core.events import PhaseStarted
with showing_events(as_json=True) as sink:
    threads = [Thread(target=lambda: [sink(PhaseStarted("ping")) for _ in range(200)]) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
"""


def test_events_of_concurrent_steps_are_one_line_each() -> None:
    unbuffered = os.environ | {"PYTHONUNBUFFERED": "1"}
    completed = subprocess.run(
        (sys.executable, "-c", REPORT_EVENTS), capture_output=True, text=True, check=True, env=unbuffered
    )
    assert [json.loads(line)["name"] for line in completed.stdout.split("\n")[:-1]] == ["ping"] * 800
