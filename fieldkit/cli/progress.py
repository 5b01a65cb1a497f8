"""The line at the bottom of a terminal: progress of trial, campaign or computation, and the current phase."""

import time
from typing import Final

from fieldkit.core.events import (
    Answered,
    Asked,
    Entered,
    Event,
    PhaseStarted,
    Progress,
    RepeatEnded,
    Request,
    TrialStarted,
    Words,
)
from fieldkit.core.units import format_duration

_BARS: Final = {100: 24, 60: 12, 0: 6}
"""Width of the bar by the minimum width of the line. Fixed widths keep the bar from moving when texts change."""
_SEPARATOR: Final = "  "
_ELLIPSIS: Final = "..."
_FULL: Final = "\N{BOX DRAWINGS HEAVY HORIZONTAL}"
_EMPTY: Final = "\N{BOX DRAWINGS LIGHT HORIZONTAL}"


def abbreviate(text: str, width: int) -> str:
    """Return a text of at most `width` characters. A shortened text ends in `...`."""
    return text if len(text) <= width else f"{text[: max(width - len(_ELLIPSIS), 0)]}{_ELLIPSIS}"[:width]


class ProgressBar:
    """The progress of a trial or a computation."""

    def __init__(self) -> None:
        self._phase = PhaseStarted("")
        self._phase_start_s = 0.0
        self._trial = ""
        self._done, self._total, self._unit = 0.0, 0.0, ""
        self._end_s: float | None = None
        self._is_awaiting_input = False

    @property
    def is_needed(self) -> bool:
        """True if there is something to show and no input is expected. A redrawn line would overwrite typed input."""
        return bool(self._phase.name) and not self._is_awaiting_input

    def update(self, event: Event) -> None:
        """Update the progress by an event."""
        # Other threads may send events while the operator types.
        is_question = isinstance(event, Request | Asked)
        self._is_awaiting_input = is_question or (
            self._is_awaiting_input and not isinstance(event, Answered | Entered)
        )
        self._trial = event.part or self._trial
        match event:
            case PhaseStarted():
                self._phase, self._phase_start_s = event, time.monotonic()
            case Progress():
                if event.what != self._phase.name:
                    self._phase, self._phase_start_s = PhaseStarted(event.what), time.monotonic()
                self._done, self._total, self._unit = event.done, event.total, f" {event.unit}"
                self._end_s = None if event.left_s is None else time.monotonic() + event.left_s
            case TrialStarted():
                self._done, self._total, self._end_s = event.done, event.total, None
            case RepeatEnded():
                self._done, self._total = event.done, event.total
                self._end_s = time.monotonic() + event.left_s
            case _ if event.ends_progress:
                self._phase, self._done, self._total, self._end_s = PhaseStarted(""), 0, 0, None

    def words(self, width: int) -> Words:
        """Return the line, at most `width` columns long.

        If there is too little space, the least important texts are omitted.
        """
        now_s = time.monotonic()
        count = f"{self._done:g}/{self._total:g}{self._unit}" if self._total else ""
        total_left_s = 0.0 if self._end_s is None else self._end_s - now_s
        total_left = f"{format_duration(total_left_s)} left" if total_left_s > 0 else ""
        elapsed_s = now_s - self._phase_start_s
        left_s = (self._phase.expected_s or 0.0) - elapsed_s
        phase = f"{self._phase.repeat} {self._phase.name}".strip()
        phase_time = f"{format_duration(left_s)} left" if left_s > 0 else f"for {format_duration(elapsed_s)}"
        parts = [(self._trial, "bold"), (count, ""), (total_left, "dim"), (phase, "cyan"), (phase_time, "dim")]
        for omitted in (None, self._trial, total_left, phase_time, count):
            parts = [part for part in parts if part[0] and part[0] is not omitted]
            free_width = width - len(_SEPARATOR.join(text for text, _ in parts))
            if free_width >= 0:
                break
        bar_width = next(bar_width for min_width, bar_width in _BARS.items() if width >= min_width)
        words: list[tuple[str, str]] = []
        for text, style in parts:
            words += [(_SEPARATOR, "")] * bool(words)
            if text is count and bar_width + len(_SEPARATOR) <= free_width:
                filled_width = int(bar_width * self._done / self._total)
                words += [
                    (_FULL * filled_width, "green"),
                    (_EMPTY * (bar_width - filled_width), "dim"),
                    (_SEPARATOR, ""),
                ]
            words.append((abbreviate(text, width), style))
        return tuple(words)
