"""Ask the operator for values that no robot measures: wind, people, grass."""

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
from fieldkit.steps.capabilities import AsksOperator, DescribesActions, Summarizes, WritesOnLaptop
from fieldkit.steps.scene import Announce, Planned, Scene
from fieldkit.steps.view import View

_MAX_CHARACTERS: Final = 31
"""Maximum length of a choice."""


def _checked_choice(word: str) -> str:
    """Return `word` if it is a valid choice; a number, or the answer that means *unknown*, is not valid."""
    has_valid_form = 0 < len(word) <= _MAX_CHARACTERS and word.isprintable() and word == word.strip()
    if not has_valid_form or word.isdigit() or word in {UNKNOWN, *MISSING}:
        raise schema.validation_error(
            f"{word[:40]!r} cannot be a choice: write words of at most {_MAX_CHARACTERS} characters; "
            "numbers and - are not allowed"
        )
    return word


_Word = Annotated[str, AfterValidator(_checked_choice)]


class AskStep(Step, DescribesActions, AsksOperator, WritesOnLaptop, Summarizes):
    """Asks the operator for a number or for one of several words, which becomes a column.

    The answer `-` means unknown: the column is then empty. It is also empty if no operator is asked (`--yes`) and
    there is no `usual` answer. Writes `answer-COLUMN.txt`.

    Attributes:
        column: Name of the column.
        question: The question, without a question mark.
        unit: Unit of the number; the operator need not type it.
        choices: Possible words, for an answer that is not a number: 2 to 20 words of up to 31 characters. The
            operator types a word or its position in the list.
        least: Smallest possible number.
        most: Largest possible number.
        usual: Default answer. It is used if the operator only presses Enter, and if no operator is asked.
        each: `trial` asks in the first repeat, and the others use this answer; `repeat` asks in each repeat.
    """

    column: StepName
    question: Annotated[str, schema.pattern_field(r"^\S[^\n]{0,200}$", "a question on one line")]
    unit: (
        Annotated[
            str,
            schema.pattern_field(r"^[^\s0-9][^\s]{0,15}$", "a unit of up to 16 characters that starts with no digit"),
        ]
        | None
    ) = None
    choices: Annotated[tuple[_Word, ...], Field(min_length=2, max_length=20)] | None = None
    least: Number | None = None
    most: Number | None = None
    usual: Annotated[str, Field(pattern=r"^\S[^\n]{0,30}$")] | None = None
    each: Literal["repeat", "trial"] = "trial"

    @schema.model_validator(mode="after")
    def _can_be_answered(self) -> "AskStep":
        if self.choices and (self.unit or self.least is not None or self.most is not None):
            raise schema.validation_error("choices are words: they have no unit, least or most", "choices")
        if self.least is not None and self.most is not None and self.least > self.most:
            raise schema.validation_error("least is greater than most", "least")
        if self.choices and len(set(self.choices)) < len(self.choices):
            raise schema.validation_error("a choice is listed twice", "choices")
        if self.usual and self._full_question.read(self.usual) is None:
            answers = replace(self._full_question, usual="").answer_hint
            raise schema.validation_error(f"usual is {self.usual!r}; permitted answers: {answers}", "usual")
        return self

    @property
    def _full_question(self) -> Question:
        bounds = (-math.inf if self.least is None else self.least, math.inf if self.most is None else self.most)
        return Question(self.question, self.unit or "", self.choices or (), bounds, self.usual or "")

    @override
    def jobs(self, scene: Scene) -> Iterator[Planned]:
        return iter(())

    @override
    def dry_run_notes(self, scene: Scene) -> Iterator[str]:
        yield f"the operator is asked: {self.question}? {self._full_question.answer_hint}"

    def run(self, scene: Scene, testbed: Testbed, announce: Announce) -> None:
        """Ask the operator, or use the answer of an earlier attempt of the trial; see `Step.run`.

        Raises:
            ConfigurationError: There is no operator, because the input is not a terminal.
        """
        answer = self._earlier_answer(scene) if self.each == "trial" else None
        if answer is None:
            announce("ask", None)
            answer = testbed.operator.enter(self._full_question)
        if scene.laptop_folder is not None:
            (scene.laptop_folder / self._file).write_text(f"{answer}\n", encoding="utf-8")

    def _earlier_answer(self, scene: Scene) -> str | None:
        """Return the answer in an earlier attempt of the trial; None if there is no earlier answer."""
        for path in sorted(scene.laptop_folder.parent.glob(f"*/{self._file}")) if scene.laptop_folder else ():
            with suppress(EvidenceError):
                return _read(path, self._full_question)
        return None

    cross_checks = (
        CrossCheck(
            quantity="answer",
            columns=("*",),
            source="`answer-COLUMN.txt`",
            against=(),
            tolerance="only the operator knows it",
            outcome=CheckOutcome.UNCHECKED,
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
        return self.prefixed_name(laptop_files.answer_file(self.column))

    @override
    def output_columns(self) -> tuple[Column, ...]:
        unit = "text" if self.choices else self.unit or "number"
        meaning = f"Answer of the operator to: {self.question}? Empty if unknown."
        label = self.column.replace("_", " ")
        if self.choices:
            return (Column(self.column, unit, meaning, figure=Figure(label, Kind.WORDS)),)
        low, high = self._full_question.bounds
        bounds = (max(low, -sys.float_info.max), min(high, sys.float_info.max))
        return (Column(self.column, unit, meaning, bounds=bounds, figure=Figure(label, Kind.MEDIAN)),)

    @override
    def check(self, view: View) -> Iterator[str]:
        if view.evidence.read_or_none(_read, self._file, self._full_question) is None:
            yield f"{self._file} has no valid answer of the operator"

    @override
    def measure(self, view: View) -> Measured:
        answer = view.evidence.read_or_none(_read, self._file, self._full_question)
        text = answer if answer != UNKNOWN else None
        value: Value | None = text if text is None or self.choices else float(text)
        return Measured.from_optional({self.column: value}, "the operator answered: unknown")

    @override
    def summary(self, values: Mapping[str, Value]) -> Iterator[str]:
        if self.column in values:
            value = values[self.column]
            value_text = value if isinstance(value, str) else f"{value:g}{f' {self.unit}' if self.unit else ''}"
            yield f"{self.column} {value_text}"

    @override
    def may_prompt(self) -> bool:
        return True

    @override
    def expected_s(self, protocol: Protocol) -> float:
        return 0.0


def _read(path: Path, question: Question) -> str:
    """Return the answer in a file.

    Raises:
        EvidenceError: The file has no answer, or its answer does not fit the question.
    """
    answer = question.read(reading.text(path))
    if answer is None:
        raise EvidenceError("has no valid answer of the operator", where=str(path))
    return answer
