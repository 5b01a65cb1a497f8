"""Questions to the operator, and the substitute for the operator with `--yes`.

The operators that read answers are in `fieldkit.cli.operators`.
"""

import math
from dataclasses import dataclass
from typing import Final, Protocol

from typing_extensions import override

from fieldkit.core.text import sanitized

SKIP: Final = "s"
"""Answer that postpones a request."""
NOTE: Final = "n "
"""Start of an answer that means "done" and continues with a note."""
UNKNOWN: Final = "-"
"""Answer that means "unknown"."""


@dataclass(frozen=True)
class Answer:
    """Answer of the operator to a request.

    Attributes:
        skip: Whether the request is postponed.
        note: Note that is stored with the trial; empty if none.
    """

    skip: bool = False
    note: str = ""


DONE: Final = Answer()


@dataclass(frozen=True)
class Question:
    """A question to the operator for a number, or for one of several words.

    Attributes:
        text: The question, without a question mark.
        unit: Unit of the number; empty if it has none.
        choices: The possible words; empty for a number.
        bounds: Smallest and largest possible number.
        usual: Default answer, which an empty line selects; empty if there is no default.
    """

    text: str
    unit: str = ""
    choices: tuple[str, ...] = ()
    bounds: tuple[float, float] = (-math.inf, math.inf)
    usual: str = ""

    def read(self, line: str) -> str | None:
        """Return the answer in a typed line: a number, a word or `UNKNOWN`; None if the line is not an answer."""
        text = line.strip() or self.usual
        if not text or text == UNKNOWN:
            return text or None
        if self.choices:
            by_number = {str(number): choice for number, choice in enumerate(self.choices, start=1)}
            return text if text in self.choices else by_number.get(text)
        try:
            value = float(text.removesuffix(self.unit))
        except ValueError:
            return None
        low, high = self.bounds
        return f"{value:.9g}" if math.isfinite(value) and low <= value <= high else None

    @property
    def answer_hint(self) -> str:
        """Description of the possible answers."""
        if self.choices:
            words = ", ".join(f"{number} {choice}" for number, choice in enumerate(self.choices, start=1))
        else:
            low, high = self.bounds
            low_text = f" from {low:g}" if math.isfinite(low) else ""
            high_text = f" to {high:g}" if math.isfinite(high) else ""
            words = f"a number{f' in {self.unit}' if self.unit else ''}{low_text}{high_text}"
        return f"{words}; {UNKNOWN} if unknown{f'; Enter for {self.usual}' if self.usual else ''}"


class Operator(Protocol):
    """The person who places the robots and answers questions, or a substitute."""

    def ask(self, request: str, *, may_skip: bool = False) -> Answer:
        """Show a request, wait until it is done or postponed, and return the answer.

        Args:
            request: What to do, in the imperative, without a full stop: `put turtlebot-1 ...`.
            may_skip: Whether `Answer.skip` is a possible answer.

        Raises:
            ConfigurationError: No answer is available.
        """
        ...

    def enter(self, question: Question) -> str:
        """Show a question and return its answer in the form of `Question.read`. Raises the same errors as `ask`."""
        ...


class Unattended(Operator):
    """Substitute for the operator with `--yes`: requests count as done, and questions have their default answer."""

    @override
    def ask(self, request: str, *, may_skip: bool = False) -> Answer:
        return DONE

    @override
    def enter(self, question: Question) -> str:
        return question.usual or UNKNOWN


UNATTENDED: Final = Unattended()


def answer_hint(*, may_skip: bool) -> str:
    """Return a description of the possible answers to a request."""
    return f"Enter when done, {f'{SKIP} to leave it for later, ' * may_skip}{NOTE}TEXT when done, with a note"


def parse(line: str, *, may_skip: bool) -> Answer | None:
    """Return the answer in a typed line, or None if the line is not an answer."""
    text = line.strip()
    if not text:
        return DONE
    if text == SKIP and may_skip:
        return Answer(skip=True)
    note = sanitized(text.removeprefix(NOTE).strip())
    return Answer(note=note) if text.startswith(NOTE) and note else None
