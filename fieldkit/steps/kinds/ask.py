"""Ask the operator for what no robot measures: wind, people, grass."""

import math
import sys
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Final, Literal

from typing_extensions import override

from fieldkit.backends.protocols import Testbed
from fieldkit.config import schema
from fieldkit.config.schema import AfterValidator, Field, Number
from fieldkit.core import laptop_files
from fieldkit.core.columns import MISSING, Column, Figure, Kind, Measured, Value
from fieldkit.core.crosschecks import CheckOutcome, CrossCheck
from fieldkit.core.errors import EvidenceError
from fieldkit.core.model import Protocol
from fieldkit.core.prompts import UNKNOWN, Question
from fieldkit.measure.evidence import reading
from fieldkit.steps.base import Step, StepName
from fieldkit.steps.scene import Announce, Planned, Scene
from fieldkit.steps.view import View

_MOST_LETTERS: Final = 31


def _can_be_chosen(word: str) -> str:
    """Return a word that is neither a place in the list of choices nor what says that nobody knows."""
    fits = 0 < len(word) <= _MOST_LETTERS and word.isprintable() and word == word.strip()
    if not fits or word.isdigit() or word in {UNKNOWN, *MISSING}:
        raise schema.complaint(f"{word[:40]!r} cannot be a choice: write words, {_MOST_LETTERS} characters at most")
    return word


_Word = Annotated[str, AfterValidator(_can_be_chosen)]


class AskStep(Step):
    """Asks the operator for a number or for one of several words, which becomes a column.

    The answer `-` means unknown: the column is then empty, as it is where no operator is asked (`--yes`) and there is
    no `usual` answer. Leaves `answer-COLUMN.txt`.

    Attributes:
        column: Name of the column.
        question: The question, without a question mark.
        unit: Unit of the number; the operator need not type it.
        choices: Possible words, for an answer that is not a number: 2 to 20 of up to 31 characters. The operator
            types a word or its position in the list.
        least: Smallest possible number.
        most: Largest possible number.
        usual: Default answer: for Enter alone, and where no operator is asked.
        each: `trial`: asked once, before the first repeat that contains the step; `repeat`: asked in each.
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

    @override
    def jobs(self, scene: Scene) -> Iterator[Planned]:
        return iter(())

    @override
    def dry_run_notes(self, scene: Scene) -> Iterator[str]:
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

    cross_checks = (
        CrossCheck(
            "answer", ("*",), "`answer-COLUMN.txt`", (), "the operator alone knows it", CheckOutcome.UNCHECKED
        ),
    )

    @override
    def exclusive_resources(self) -> tuple[str, ...]:
        return (f"an answer {self.column}",)

    @override
    def files(self) -> tuple[str, ...]:
        return (self._file,)

    @override
    def laptop_files(self) -> tuple[str, ...]:
        return (self._file,)

    @property
    def _file(self) -> str:
        return self.own_name(laptop_files.answer(self.column))

    @override
    def output_columns(self) -> tuple[Column, ...]:
        unit = "text" if self.choices else self.unit or "number"
        meaning = f"What the operator answered to: {self.question}? Empty where nobody knew."
        label = self.column.replace("_", " ")
        if self.choices:
            return (Column(self.column, unit, meaning, figure=Figure(label, Kind.WORDS)),)
        low, high = self._asked.bounds
        bounds = (max(low, -sys.float_info.max), min(high, sys.float_info.max))
        return (Column(self.column, unit, meaning, bounds=bounds, figure=Figure(label, Kind.MEDIAN)),)

    @override
    def check(self, view: View) -> Iterator[str]:
        if view.evidence.read_or_none(_read, self._file, self._asked) is None:
            yield f"{self._file} does not say what the operator answered"

    @override
    def measure(self, view: View) -> Measured:
        answer = view.evidence.read_or_none(_read, self._file, self._asked)
        known = answer if answer != UNKNOWN else None
        value: Value | None = known if known is None or self.choices else float(known)
        return Measured.of({self.column: value}, "the operator did not know")

    @override
    def summary(self, values: Mapping[str, Value]) -> Iterator[str]:
        if self.column in values:
            value = values[self.column]
            shown = value if isinstance(value, str) else f"{value:g}{f' {self.unit}' if self.unit else ''}"
            yield f"{self.column} {shown}"

    @override
    def asks(self) -> bool:
        return True

    @override
    def expected_s(self, protocol: Protocol) -> float:
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
