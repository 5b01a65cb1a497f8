"""Asking the operator: one interface for a person at a terminal, for a script, and for nobody."""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final, Protocol

from fieldkit.core.errors import ConfigurationError
from fieldkit.core.events import Answered, Asked, Entered, Request, Sink
from fieldkit.core.text import harmless

SKIP: Final = "s"
NOTE: Final = "n "
UNKNOWN: Final = "-"
"""What who does not know enters."""


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


@dataclass(frozen=True)
class Question:
    """Something that the operator sees: a number, or one of several words.

    Attributes:
        text: The question, without a question mark.
        unit: Of the number; empty where it has none.
        choices: The words; empty for a number.
        bounds: Smallest and largest number that is possible.
        usual: What an empty line says; empty where it says nothing.
    """

    text: str
    unit: str = ""
    choices: tuple[str, ...] = ()
    bounds: tuple[float, float] = (-math.inf, math.inf)
    usual: str = ""

    def read(self, line: str) -> str | None:
        """Return what a typed line says: a number, a word, `UNKNOWN`, or None where it says nothing of that."""
        said = line.strip() or self.usual
        if not said or said == UNKNOWN:
            return said or None
        if self.choices:
            by_number = {str(number): choice for number, choice in enumerate(self.choices, start=1)}
            return said if said in self.choices else by_number.get(said)
        try:
            value = float(said.removesuffix(self.unit))
        except ValueError:
            return None
        low, high = self.bounds
        return f"{value:.9g}" if math.isfinite(value) and low <= value <= high else None

    @property
    def how(self) -> str:
        """What can be answered, in words."""
        if self.choices:
            words = ", ".join(f"{number} {choice}" for number, choice in enumerate(self.choices, start=1))
        else:
            low, high = self.bounds
            least = f" from {low:g}" if math.isfinite(low) else ""
            most = f" to {high:g}" if math.isfinite(high) else ""
            words = f"a number{f' in {self.unit}' if self.unit else ''}{least}{most}"
        return f"{words}; {UNKNOWN} if nobody knows{f'; Enter for {self.usual}' if self.usual else ''}"


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

    def enter(self, question: Question) -> str:
        """Show a question and return what was answered, as `Question.read`. Errors as `ask`."""
        ...


class Nobody:
    """The operator who said `--yes`: everything is as it should be."""

    def ask(self, request: str, *, may_skip: bool = False) -> Answer:  # noqa: ARG002 (nobody listens)
        """See `Operator.ask`."""
        return DONE

    def enter(self, question: Question) -> str:
        """See `Operator.enter`; who is not asked does not know."""
        return question.usual or UNKNOWN


NOBODY: Final = Nobody()


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
        line = self._next(request)
        answer = parse(line, may_skip=may_skip)
        if answer is None:
            raise self._no_answer(line, request, how(may_skip=may_skip))
        self._sink(Answered(answer.skip, answer.note))
        return answer

    def enter(self, question: Question) -> str:
        """See `Operator.enter`."""
        self._sink(Asked(question.text, question.how))
        line = self._next(question.text)
        answer = question.read(line)
        if answer is None:
            raise self._no_answer(line, question.text, question.how)
        self._sink(Entered(answer))
        return answer

    def _next(self, request: str) -> str:
        self._asked += 1
        line = next(self._lines, None)
        if line is None:
            raise ConfigurationError(
                f"no answer left to: {request}", where=self._where, remedy="add a line per request"
            )
        return line

    def _no_answer(self, line: str, request: str, remedy: str) -> ConfigurationError:
        return ConfigurationError(f"{line.strip()!r} is no answer to: {request}", where=self._where, remedy=remedy)

    @property
    def _where(self) -> str:
        return f"{self._source}:{self._asked}"


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
