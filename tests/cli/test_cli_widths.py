"""Output for terminals of any width: cuts are marked, and words are not broken."""

import io
import re
import sys
from contextlib import redirect_stdout
from unittest.mock import patch

from hypothesis import given, settings
from hypothesis import strategies as st
from rich.cells import cell_len

from fieldkit.cli.display import print_table
from fieldkit.cli.event_words import event_words
from fieldkit.cli.progress import ProgressBar
from fieldkit.core.campaign_events import CampaignTrial
from fieldkit.core.events import NOTHING_ARRIVED, PhaseStarted, RepeatEnded, TrialStarted
from fieldkit.core.model import FINAL_STATUSES, Status

WORD = st.text(st.sampled_from("abcXYZ019-_/.%[]漢é"), min_size=1, max_size=40)
CELL = st.lists(WORD, max_size=6).map(" ".join)
WIDTHS = st.integers(20, 220)


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def printed_table(width: int, headers: list[str], rows: list[tuple[str, ...]], right_aligned: list[int]) -> str:
    out = Terminal()
    with redirect_stdout(out), patch.dict("os.environ", COLUMNS=str(width), TERM="xterm"):
        assert sys.stdout.isatty()
        print_table(headers, rows, right=right_aligned)
    return re.sub("\x1b[^m]*m", "", out.getvalue())


@settings(max_examples=40, deadline=None)
@given(st.data(), WIDTHS)
def test_a_table_keeps_every_word_and_is_no_wider_than_the_terminal(data: st.DataObject, width: int) -> None:
    size = data.draw(st.integers(1, 6))
    headers = data.draw(st.lists(st.from_regex(r"[a-z]{1,12}", fullmatch=True), min_size=size, max_size=size))
    rows = data.draw(st.lists(st.tuples(*[CELL] * size), min_size=1, max_size=4))
    right_aligned = data.draw(st.lists(st.integers(0, size - 1), max_size=2))
    text = printed_table(width, headers, rows, right_aligned)
    words = [word for row in rows for cell in row for word in cell.split()]
    printed_words = text.split()
    assert all(printed_words.count(word) >= words.count(word) for word in words)
    longest = max([cell_len(word) for word in words], default=0) + max(map(len, headers)) + 4
    assert all(cell_len(line) <= max(width, longest) for line in text.splitlines())


FIGURES = st.lists(st.from_regex(r"[a-zA-Z]{1,15} (loss|RTT) [0-9]{1,4}\.[0-9] (%|ms)", fullmatch=True), min_size=1)


@given(FIGURES, st.integers(40, 200), st.sampled_from(FINAL_STATUSES), st.text("ab ", max_size=60))
def test_line_of_a_repeat_is_complete_at_any_width(parts: list[str], width: int, status: Status, reason: str) -> None:
    event = RepeatEnded("udp-07", 1, status, reason.strip(), ", ".join(parts), 7, 40, 0.0)
    text = "".join(part for part, _ in event_words(event, width))
    assert all(len(line) <= width for line in text.splitlines())
    assert not re.search(r"[0-9]\n *(%|ms)", text)
    wide_text = "".join(part for part, _ in event_words(event))
    assert text.split() == wide_text.split()


def test_a_repeat_in_which_nothing_arrived_is_red() -> None:
    event = RepeatEnded("udp-07", 1, Status.VALID, "", f"{NOTHING_ARRIVED}, ping loss 100.0 %", 7, 40, 0.0)
    assert [style for text, style in event_words(event, 80) if NOTHING_ARRIVED in text] == ["red"]


@given(WORD, WORD, st.integers(4, 120))
def test_progress_line_marks_cuts(trial: str, phase: str, width: int) -> None:
    progress = ProgressBar()
    for event in (CampaignTrial(trial, 1, 2), TrialStarted("a", 0, 40), PhaseStarted(phase, repeat="udp-07")):
        progress.update(event)
    text = "".join(part for part, _ in progress.words(width))
    assert len(text) <= width
    assert f"udp-07 {phase}" in text or text.endswith("...") or "..." in text
