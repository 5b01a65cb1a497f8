"""Ask the operator for what no robot measures: wind, people, grass."""

import math
import sys
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Final, Literal

from fieldkit.backends.protocols import Testbed
from fieldkit.config import schema
from fieldkit.config.schema import AfterValidator, Field, Number
from fieldkit.core.columns import MISSING, Column, Figure, Kind, Measured, Value
from fieldkit.core.errors import EvidenceError
from fieldkit.core.model import Protocol, Role
from fieldkit.core.prompts import UNKNOWN, Question
from fieldkit.measure.evidence import reading
from fieldkit.steps.base import Step, StepName, View
from fieldkit.steps.scene import Announce, Planned, Scene

_MOST_LETTERS: Final = 31


def _can_be_chosen(word: str) -> str:
    """Return a word that is neither a place in the list of choices nor what says that nobody knows."""
    fits = 0 < len(word) <= _MOST_LETTERS and word.isprintable() and word == word.strip()
    if not fits or word.isdigit() or word in {UNKNOWN, *MISSING}:
        raise schema.complaint(f"{word[:40]!r} cannot be a choice: write words, {_MOST_LETTERS} characters at most")
    return word


_Word = Annotated[str, AfterValidator(_can_be_chosen)]


class AskStep(Step):
    """A question to the operator, whose answer is a column.

    A number where there are no `choices`, else one of them. Who does not know answers `-`, and the column is empty.

    Attributes:
        column: The column that keeps the answer.
        question: What is asked, without a question mark.
        unit: Of the number.
        choices: What the answer is one of.
        least: Smallest number that is possible.
        most: Largest number that is possible.
        usual: What Enter alone answers, and what stands there where nobody is asked.
        each: Whether it is asked in each repeat, or once for all of a trial.
    """

    column: StepName
    question: Annotated[str, schema.shaped(r"^\S[^\n]{0,200}$", "a question: one line")]
    unit: (
        Annotated[str, schema.shaped(r"^[^\s0-9][^\s]{0,15}$", "a unit: up to 16 characters, no digit first")] | None
    ) = None
    choices: Annotated[tuple[_Word, ...], Field(min_length=2, max_length=20)] | None = None
    least: Number | None = None
    most: Number | None = None
    usual: Annotated[str, Field(pattern=r"^\S[^\n]{0,30}$")] | None = None
    each: Literal["repeat", "trial"] = "trial"

    @schema.model_validator(mode="after")
    def _can_be_answered(self) -> "AskStep":
        if self.choices and (self.unit or self.least is not None or self.most is not None):
            raise schema.complaint("choices are words: they take no unit, least or most", "choices")
        if self.least is not None and self.most is not None and self.least > self.most:
            raise schema.complaint("least is above most", "least")
        if self.choices and len(set(self.choices)) < len(self.choices):
            raise schema.complaint("a choice comes twice", "choices")
        if self.usual and self._asked.read(self.usual) is None:
            how = replace(self._asked, usual="").how
            raise schema.complaint(f"usual is {self.usual!r}, and what can be answered is {how}", "usual")
        return self

    @property
    def _asked(self) -> Question:
        bounds = (-math.inf if self.least is None else self.least, math.inf if self.most is None else self.most)
        return Question(self.question, self.unit or "", self.choices or (), bounds, self.usual or "")

    def commands(self, scene: Scene) -> Iterator[Planned]:  # noqa: ARG002 (nothing runs)
        """See `Step.commands`."""
        return iter(())

    def beside(self, scene: Scene) -> Iterator[str]:  # noqa: ARG002 (the same for every scene)
        """See `Step.beside`."""
        yield f"the operator is asked: {self.question}? {self._asked.how}"

    def run(self, scene: Scene, testbed: Testbed, announce: Announce) -> None:
        """See `Step.run`.

        Raises:
            ConfigurationError: There is nobody to ask.
        """
        answer = self._earlier(scene) if self.each == "trial" else None
        if answer is None:
            announce("ask", None)
            answer = testbed.operator.enter(self._asked)
        if scene.here is not None:
            (scene.here / self._file).write_text(f"{answer}\n", encoding="utf-8")

    def _earlier(self, scene: Scene) -> str | None:
        """Return what was answered in an earlier attempt of the trial, None where that is the first."""
        for kept in sorted(scene.here.parent.glob(f"*/{self._file}")) if scene.here else ():
            with suppress(EvidenceError):
                return _read(kept, self._asked)
        return None

    def roles(self) -> frozenset[Role]:
        """See `Step.roles`."""
        return frozenset()

    def claims(self) -> tuple[str, ...]:
        """See `Step.claims`."""
        return (f"an answer {self.column}",)

    def files(self) -> tuple[str, ...]:
        """See `Step.files`."""
        return (self._file,)

    @property
    def _file(self) -> str:
        return self.own_name(f"answer-{self.column}.txt")

    def declared(self) -> tuple[Column, ...]:
        """See `Step.declared`."""
        unit = "text" if self.choices else self.unit or "number"
        meaning = f"What the operator answered to: {self.question}? Empty where nobody knew."
        label = self.column.replace("_", " ")
        if self.choices:
            return (Column(self.column, unit, meaning, figure=Figure(label, Kind.WORDS)),)
        low, high = self._asked.bounds
        bounds = (max(low, -sys.float_info.max), min(high, sys.float_info.max))
        return (Column(self.column, unit, meaning, bounds=bounds, figure=Figure(label, Kind.MEDIAN)),)

    def problems(self, view: View) -> Iterator[str]:
        """See `Step.problems`."""
        if view.evidence.known(_read, self._file, self._asked) is None:
            yield f"{self._file} does not say what the operator answered"

    def measure(self, view: View) -> Measured:
        """See `Step.measure`."""
        answer = view.evidence.known(_read, self._file, self._asked)
        known = answer if answer != UNKNOWN else None
        value: Value | None = known if known is None or self.choices else float(known)
        return Measured.of({self.column: value}, "the operator did not know")

    def in_words(self, values: Mapping[str, Value]) -> Iterator[str]:
        """See `Step.in_words`."""
        if self.column in values:
            value = values[self.column]
            shown = value if isinstance(value, str) else f"{value:g}{f' {self.unit}' if self.unit else ''}"
            yield f"{self.column} {shown}"

    def asks(self) -> bool:
        """See `Step.asks`."""
        return True

    def expected_s(self, protocol: Protocol) -> float:  # noqa: ARG002 (nobody knows how long a person takes)
        """See `Step.expected_s`."""
        return 0.0


def _read(path: Path, question: Question) -> str:
    """Return the answer in a file.

    Raises:
        EvidenceError: There is none, or none to this question.
    """
    answer = question.read(reading.text(path))
    if answer is None:
        raise EvidenceError("does not say what the operator answered", where=str(path))
    return answer
