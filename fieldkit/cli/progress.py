"""The line at the bottom of a terminal: how far trial, campaign or computation are, and what is being done."""

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
"""Width of the bar by the least width of the line, so that it does not jump with the words beside it."""
_APART: Final = "  "
_CUT: Final = "..."
_FULL: Final = "\N{BOX DRAWINGS HEAVY HORIZONTAL}"
_EMPTY: Final = "\N{BOX DRAWINGS LIGHT HORIZONTAL}"


def shortened(text: str, width: int) -> str:
    """Return a text of at most `width` characters; one that is cut ends in `...`."""
    return text if len(text) <= width else f"{text[: max(width - len(_CUT), 0)]}{_CUT}"[:width]


class ProgressBar:
    """How far a trial or a computation is."""

    def __init__(self) -> None:
        self._phase = PhaseStarted("")
        self._phase_began_s = 0.0
        self._trial = ""
        self._done, self._total, self._unit = 0.0, 0.0, ""
        self._ends_s: float | None = None
        self._asking = False

    @property
    def is_needed(self) -> bool:
        """Whether there is something to show; a line that redraws itself would write over what an operator types."""
        return bool(self._phase.name) and not self._asking

    def take(self, event: Event) -> None:
        """Take up what happened."""
        # Other threads may tell something while the operator is asked.
        asked = isinstance(event, Request | Asked)
        self._asking = asked or (self._asking and not isinstance(event, Answered | Entered))
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
        """Return the line, at most `width` columns long: what is least needed goes first where room is short."""
        now_s = time.monotonic()
        count = f"{self._done:g}/{self._total:g}{self._unit}" if self._total else ""
        whole_s = 0.0 if self._ends_s is None else self._ends_s - now_s
        whole = f"{format_duration(whole_s)} left" if whole_s > 0 else ""
        spent_s = now_s - self._phase_began_s
        left_s = (self._phase.expected_s or 0.0) - spent_s
        phase = f"{self._phase.repeat} {self._phase.name}".strip()
        lasts = f"{format_duration(left_s)} left" if left_s > 0 else f"for {format_duration(spent_s)}"
        pieces = [(self._trial, "bold"), (count, ""), (whole, "dim"), (phase, "cyan"), (lasts, "dim")]
        for least in (None, self._trial, whole, lasts, count):
            pieces = [piece for piece in pieces if piece[0] and piece[0] is not least]
            room = width - len(_APART.join(text for text, _ in pieces))
            if room >= 0:
                break
        bar = next(bar for least, bar in _BARS.items() if width >= least)
        words: list[tuple[str, str]] = []
        for text, style in pieces:
            words += [(_APART, "")] * bool(words)
            if text is count and bar + len(_APART) <= room:
                full = int(bar * self._done / self._total)
                words += [(_FULL * full, "green"), (_EMPTY * (bar - full), "dim"), (_APART, "")]
            words.append((shortened(text, width), style))
        return tuple(words)
