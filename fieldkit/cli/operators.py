"""Operators that read answers: the person at the terminal, and a file or pipe with answers."""

import sys
from collections.abc import Iterator

from typing_extensions import override

from fieldkit.core import prompts
from fieldkit.core.errors import ConfigurationError
from fieldkit.core.events import Answered, Asked, Entered, Request, Sink
from fieldkit.core.prompts import Answer, Question


class Terminal:
    """An operator who answers at this terminal.

    Args:
        sink: Receives each request, which it shows, and the answer.
    """

    def __init__(self, sink: Sink) -> None:
        self._sink = sink

    def ask(self, request: str, *, may_skip: bool = False) -> Answer:
        """Ask the operator to do something; see `Operator.ask`."""
        _require_terminal(
            f"a person must {request}",
            "place the robots first, then add --yes; or give the answers by --answers FILE",
        )
        self._sink(Request(request, may_skip))
        while (answer := prompts.parse(_read_line(), may_skip=may_skip)) is None:
            print(prompts.answer_hint(may_skip=may_skip), file=sys.stderr)
        self._sink(Answered(answer.skip, answer.note))
        return answer

    def enter(self, question: Question) -> str:
        """Ask the operator for a value; see `Operator.enter`."""
        _require_terminal(
            f"a person must answer: {question.text}",
            "give the answers by --answers FILE; with --yes no question is asked",
        )
        self._sink(Asked(question.text, question.answer_hint))
        while (answer := question.read(_read_line())) is None:
            print(question.answer_hint, file=sys.stderr)
        self._sink(Entered(answer))
        return answer


def _require_terminal(what: str, remedy: str) -> None:
    if not sys.stdin.isatty():
        raise ConfigurationError(f"{what}, but standard input is not a terminal", remedy=remedy)


def confirm(question: str, *, remedy: str) -> bool:
    """Return True if the person at the terminal answers yes.

    Args:
        question: In the imperative, without a question mark: `pin it`.
        remedy: The remedy if there is no terminal.

    Raises:
        ConfigurationError: Standard input is not a terminal.
    """
    if not sys.stdin.isatty():
        raise ConfigurationError(f"a person must confirm: {question}", remedy=remedy)
    print(f"{question}? yes or no", file=sys.stderr)
    while (answer := _read_line().strip().lower()) not in {"yes", "no"}:
        print("yes or no", file=sys.stderr)
    return answer == "yes"


def _read_line() -> str:
    """Return a line from the terminal. The prompt is written to standard error, so it is not part of the output."""
    print("> ", end="", file=sys.stderr, flush=True)
    try:
        return input()
    except EOFError as error:
        raise ConfigurationError(
            "the terminal was closed during a question", remedy="run the command again"
        ) from error


class Script(prompts.Operator):
    """Operator whose answers are lines of a file or pipe, one per request.

    An empty line means done, `s` means postponed, and `n TEXT` means done with a note. A line is read only after its
    request was reported, so that a program at the other end of a pipe can answer it.

    Args:
        lines: The answers.
        source: Source of the lines, for messages.
        sink: Receives each request and its answer.
    """

    def __init__(self, lines: Iterator[str], source: str, sink: Sink) -> None:
        self._lines = lines
        self._source = source
        self._sink = sink
        self._line_number = 0

    @override
    def ask(self, request: str, *, may_skip: bool = False) -> Answer:
        self._sink(Request(request, may_skip))
        line = self._next_line(request)
        answer = prompts.parse(line, may_skip=may_skip)
        if answer is None:
            raise self._invalid_answer_error(line, request, prompts.answer_hint(may_skip=may_skip))
        self._sink(Answered(answer.skip, answer.note))
        return answer

    @override
    def enter(self, question: Question) -> str:
        self._sink(Asked(question.text, question.answer_hint))
        line = self._next_line(question.text)
        answer = question.read(line)
        if answer is None:
            raise self._invalid_answer_error(line, question.text, question.answer_hint)
        self._sink(Entered(answer))
        return answer

    def _next_line(self, request: str) -> str:
        self._line_number += 1
        line = next(self._lines, None)
        if line is None:
            raise ConfigurationError(
                f"there is no further answer for: {request}", where=self._where, remedy="add a line per request"
            )
        return line

    def _invalid_answer_error(self, line: str, request: str, remedy: str) -> ConfigurationError:
        return ConfigurationError(
            f"{line.strip()!r} is not an answer to: {request}", where=self._where, remedy=remedy
        )

    @property
    def _where(self) -> str:
        return f"{self._source}:{self._line_number}"
