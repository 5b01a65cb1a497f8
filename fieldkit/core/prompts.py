"""Asking the operator: one interface for a person at a terminal, for a script, and for nobody."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final, Protocol

from fieldkit.core.errors import ConfigurationError
from fieldkit.core.events import Answered, Request, Sink
from fieldkit.core.text import harmless

SKIP: Final = "s"
NOTE: Final = "n "


@dataclass(frozen=True)
class Answer:
    """What the operator said when a request was done.

    Attributes:
        skip: Leave it for later.
        note: Kept with the trial; empty for none.
    """

    skip: bool = False
    note: str = ""


DONE: Final = Answer()


class Operator(Protocol):
    """Person who carries robots."""

    def ask(self, request: str, *, may_skip: bool = False) -> Answer:
        """Show a request and return when it is done, or left.

        Args:
            request: What to do, in the imperative, without a full stop: `put turtlebot-1 ...`.
            may_skip: Whether `Answer.skip` is a possible answer.

        Raises:
            ConfigurationError: There is nobody to ask.
        """
        ...


class Nobody:
    """The operator who said `--yes`: everything is as it should be."""

    def ask(self, request: str, *, may_skip: bool = False) -> Answer:  # noqa: ARG002 (nobody listens)
        """See `Operator.ask`."""
        return DONE


class Script:
    """Answers from lines written beforehand, one per request.

    An empty line says done, `s` skips, `n TEXT` says done and keeps a note. A line is read only after its request
    was told, so that a program at the other end of a pipe can answer what it is asked.

    Args:
        lines: The answers.
        source: Where they come from, for messages.
        sink: Told each request and its answer.
    """

    def __init__(self, lines: Iterator[str], source: str, sink: Sink) -> None:
        self._lines = lines
        self._source = source
        self._sink = sink
        self._asked = 0

    def ask(self, request: str, *, may_skip: bool = False) -> Answer:
        """See `Operator.ask`."""
        self._sink(Request(request, may_skip))
        self._asked += 1
        where = f"{self._source}:{self._asked}"
        line = next(self._lines, None)
        if line is None:
            raise ConfigurationError(f"no answer left to: {request}", where=where, remedy="add a line per request")
        answer = parse(line, may_skip=may_skip)
        if answer is None:
            raise ConfigurationError(
                f"{line.strip()!r} is no answer to: {request}", where=where, remedy=how(may_skip=may_skip)
            )
        self._sink(Answered(answer.skip, answer.note))
        return answer


def how(*, may_skip: bool) -> str:
    """Return what can be answered, in words."""
    return f"Enter when done, {f'{SKIP} to leave it for later, ' * may_skip}{NOTE}TEXT when done, with a note"


def parse(line: str, *, may_skip: bool) -> Answer | None:
    """Return what a typed line means, None when it means nothing."""
    text = line.strip()
    if not text:
        return DONE
    if text == SKIP and may_skip:
        return Answer(skip=True)
    note = harmless(text.removeprefix(NOTE).strip())
    return Answer(note=note) if text.startswith(NOTE) and note else None
