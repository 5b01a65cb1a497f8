"""The line at the bottom of a terminal: progress of trial, campaign or computation, and the current phase."""

import time
from typing import Final

from fieldkit.core.events import (
    Answered,
    Asked,
    CampaignEnded,
    CampaignTrial,
    Entered,
    Event,
    PhaseStarted,
    Progress,
    RepeatEnded,
    Request,
    TrialEnded,
    TrialStarted,
    TrialStopped,
)
from fieldkit.core.units import format_duration

Words = tuple[tuple[str, str], ...]
"""Texts with their styles, in order."""

_BARS: Final = {100: 24, 60: 12, 0: 6}
"""Width of the bar by the least width of the line. Fixed widths keep the bar from moving when texts change."""
_APART: Final = "  "
_CUT: Final = "..."
_FULL: Final = "\N{BOX DRAWINGS HEAVY HORIZONTAL}"
_EMPTY: Final = "\N{BOX DRAWINGS LIGHT HORIZONTAL}"


def shortened(text: str, width: int) -> str:
    """Return a text of at most `width` characters. A shortened text ends in `...`."""
    return text if len(text) <= width else f"{text[: max(width - len(_CUT), 0)]}{_CUT}"[:width]


class ProgressBar:
    """The progress of a trial or a computation."""

    def __init__(self) -> None:
        self._phase = PhaseStarted("")
        self._phase_began_s = 0.0
        self._trial = ""
        self._done, self._total, self._unit = 0.0, 0.0, ""
        self._ends_s: float | None = None
        self._asking = False

    @property
    def is_needed(self) -> bool:
        """True if there is something to show and no input is expected, which a redrawn line would overwrite."""
        return bool(self._phase.name) and not self._asking

    def update(self, event: Event) -> None:
        """Update the progress by an event."""
        # Other threads may send events while the operator types.
        is_question = isinstance(event, Request | Asked)
        self._asking = is_question or (self._asking and not isinstance(event, Answered | Entered))
        match event:
            case PhaseStarted():
                self._phase, self._phase_began_s = event, time.monotonic()
            case Progress():
                if event.what != self._phase.name:
                    self._phase, self._phase_began_s = PhaseStarted(event.what), time.monotonic()
                self._done, self._total, self._unit = event.done, event.total, f" {event.unit}"
                self._ends_s = None if event.left_s is None else time.monotonic() + event.left_s
            case CampaignTrial():
                self._trial = f"trial {event.number} of {event.total}"
            case TrialStarted():
                self._done, self._total, self._ends_s = event.done, event.total, None
            case RepeatEnded():
                self._done, self._total = event.done, event.total
                self._ends_s = time.monotonic() + event.left_s
            case TrialEnded() | TrialStopped() | CampaignEnded():
                self._phase, self._done, self._total, self._ends_s = PhaseStarted(""), 0, 0, None

    def words(self, width: int) -> Words:
        """Return the line, at most `width` columns long.

        If space is short, the least important texts are left out.
        """
        now_s = time.monotonic()
        count = f"{self._done:g}/{self._total:g}{self._unit}" if self._total else ""
        total_left_s = 0.0 if self._ends_s is None else self._ends_s - now_s
        total_left = f"{format_duration(total_left_s)} left" if total_left_s > 0 else ""
        spent_s = now_s - self._phase_began_s
        left_s = (self._phase.expected_s or 0.0) - spent_s
        phase = f"{self._phase.repeat} {self._phase.name}".strip()
        phase_time = f"{format_duration(left_s)} left" if left_s > 0 else f"for {format_duration(spent_s)}"
        pieces = [(self._trial, "bold"), (count, ""), (total_left, "dim"), (phase, "cyan"), (phase_time, "dim")]
        for left_out in (None, self._trial, total_left, phase_time, count):
            pieces = [piece for piece in pieces if piece[0] and piece[0] is not left_out]
            free = width - len(_APART.join(text for text, _ in pieces))
            if free >= 0:
                break
        bar = next(bar for least, bar in _BARS.items() if width >= least)
        words: list[tuple[str, str]] = []
        for text, style in pieces:
            words += [(_APART, "")] * bool(words)
            if text is count and bar + len(_APART) <= free:
                full = int(bar * self._done / self._total)
                words += [(_FULL * full, "green"), (_EMPTY * (bar - full), "dim"), (_APART, "")]
            words.append((shortened(text, width), style))
        return tuple(words)
