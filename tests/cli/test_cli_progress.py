"""The progress line of a terminal: it fits the width, and keeps the most important values in a narrow terminal."""

import time

import pytest

from fieldkit.cli.event_words import event_words
from fieldkit.cli.progress import ProgressBar
from fieldkit.core.campaign_events import CampaignTrial
from fieldkit.core.events import (
    Answered,
    Event,
    PhaseStarted,
    Progress,
    RepeatEnded,
    Request,
    TrialEnded,
    TrialStarted,
)
from fieldkit.core.model import Status

VALID = RepeatEnded("udp-07", 1, Status.VALID, "", "IP loss 3.2 %, file loss 18 %, RTT 1.3 ms", 7, 40, 200.0)
STARTED = (
    CampaignTrial("los 5m master", 3, 6),
    TrialStarted("trials/a", 0, 40),
    VALID,
    PhaseStarted("transfer", "udp-08", 12.0),
)


def progress_line(width: int, *events: Event) -> str:
    progress = ProgressBar()
    for event in events:
        progress.update(event)
    return "".join(text for text, _ in progress.words(width))


@pytest.fixture(autouse=True)
def stopped_clock(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(time, "monotonic", lambda: 1000.0)


@pytest.mark.parametrize(
    ("width", "expected"),
    [
        (120, f"trial 3 of 6  {'━' * 4}{'─' * 20}  7/40  3 min 20 s left  udp-08 transfer  12 s left"),
        (80, f"trial 3 of 6  {'━' * 2}{'─' * 10}  7/40  3 min 20 s left  udp-08 transfer  12 s left"),
        (60, "7/40  3 min 20 s left  udp-08 transfer  12 s left"),
        (40, "━─────  7/40  udp-08 transfer  12 s left"),
        (24, "7/40  udp-08 transfer"),
        (16, "udp-08 transfer"),
        (5, "ud..."),
    ],
)
def test_line_fits_and_keeps_the_current_phase(width: int, expected: str) -> None:
    assert progress_line(width, *STARTED) == expected


def test_the_line_is_never_wider_than_the_terminal() -> None:
    for width in range(1, 130):
        assert len(progress_line(width, *STARTED)) <= width
        assert len(progress_line(width, *STARTED[1:])) <= width


def test_no_estimate_before_the_first_repeat_ends() -> None:
    assert progress_line(80, *STARTED[1:2], PhaseStarted("check")) == f"{'─' * 12}  0/40  check  for 0.0 s"


def test_no_line_during_a_question_and_after_the_end() -> None:
    progress = ProgressBar()
    assert not progress.is_needed
    progress.update(STARTED[-1])
    assert progress.is_needed
    progress.update(Request("move a", may_skip=False))
    progress.update(PhaseStarted("reported by another thread"))
    assert not progress.is_needed
    progress.update(Answered(skip=False, note=""))
    assert progress.is_needed
    progress.update(TrialEnded("trials/a", 1, 0, 0))
    assert not progress.is_needed


def test_line_of_a_valid_repeat_is_complete_and_wraps_in_narrow_terminals() -> None:
    def repeat_line(width: int | None) -> str:
        return "".join(text for text, _ in event_words(VALID, width))

    assert repeat_line(None) == "  7/40  udp-07  valid  IP loss 3.2 %, file loss 18 %, RTT 1.3 ms  (3 min 20 s left)"
    assert repeat_line(80) == "  7/40  udp-07  valid  IP loss 3.2 %, file loss 18 %, RTT 1.3 ms"
    assert repeat_line(40) == "  7/40  udp-07  valid  IP loss 3.2 %,\n        file loss 18 %, RTT 1.3 ms"


def test_reason_of_a_void_repeat_wraps_below_it_and_is_not_cut() -> None:
    reason = "turtlebot-1: the link is lost; the sender's capture dropped 12 packets, its interface none"
    void_repeat = RepeatEnded("udp-07", 1, Status.VOID, reason, "RTT 1.3 ms", 6, 40, 200.0)
    first_line, *following_lines = "".join(text for text, _ in event_words(void_repeat, 60)).splitlines()
    assert first_line == "  6/40  udp-07  void   "
    assert all(text.startswith(" " * 8) and len(text) <= 60 for text in following_lines)
    assert " ".join(text.strip() for text in following_lines) == f"{reason}; measured: RTT 1.3 ms"


def test_progress_of_a_computation_with_its_remaining_time() -> None:
    half_done = Progress("simulate", 15.0, 30.0, "s", 42.0)
    assert progress_line(80, half_done) == f"{'━' * 6}{'─' * 6}  15/30 s  42 s left  simulate  for 0.0 s"
    assert progress_line(80, Progress("simulate", 0, 20, "runs")) == f"{'─' * 12}  0/20 runs  simulate  for 0.0 s"
