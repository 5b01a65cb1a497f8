"""What happens in a trial, as a stream that display, log and `--json` subscribe to."""

from collections.abc import Callable
from dataclasses import dataclass

from fieldkit.model import Status


@dataclass(frozen=True)
class Note:
    """Something the operator should know, in one line."""

    text: str


@dataclass(frozen=True)
class PhaseStarted:
    """A phase of work began.

    Attributes:
        name: For example `record`, `transfer`, `start robots`.
        repeat: The repeat it belongs to, or empty.
        expected_s: How long it should take, None when unknown.
    """

    name: str
    repeat: str = ""
    expected_s: float | None = None


@dataclass(frozen=True)
class RepeatEnded:
    """A repeat ended.

    Attributes:
        repeat: For example `udp-07`.
        attempt: 1 for the first try.
        status: Valid, void or failed.
        reason: Why it is not valid; empty when it is.
        summary: What was measured, in a few words.
        done: Repeats finished for good so far.
        total: Repeats planned.
        left_s: Estimated time left.
    """

    repeat: str
    attempt: int
    status: Status
    reason: str
    summary: str
    done: int
    total: int
    left_s: float


@dataclass(frozen=True)
class TrialEnded:
    """The trial ended; its folder is complete."""

    folder: str
    valid: int
    void: int
    failed: int


Event = Note | PhaseStarted | RepeatEnded | TrialEnded
Sink = Callable[[Event], None]
