"""Questions to the person at the terminal of pytest, who carries real robots."""

import sys
from collections.abc import Callable
from typing import TypeVar

import pytest

from fieldkit.cli.terminal import Terminal
from fieldkit.core.errors import ConfigurationError
from fieldkit.core.events import Asked, Event, Request, Sink
from fieldkit.core.prompts import UNATTENDED, Answer, Operator, Question
from fieldkit.pytest.options import LabOptions

T = TypeVar("T")


def operator_of(config: pytest.Config, options: LabOptions, sink: Sink) -> Operator:
    """Return the operator: none if the options say so, else the person at the terminal."""
    return UNATTENDED if options.yes else Uncaptured(config, sink)


class Uncaptured:
    """Asks questions at the terminal although pytest captures the output and closes the input.

    Args:
        config: The configuration of pytest.
        sink: Receives each request and its answer.
    """

    def __init__(self, config: pytest.Config, sink: Sink) -> None:
        self._capture = config.pluginmanager.getplugin("capturemanager")
        self._sink = sink
        self._terminal = Terminal(self._show)

    def ask(self, request: str, *, may_skip: bool = False) -> Answer:  # noqa: ARG002 (a test cannot be skipped here)
        """Ask a person to do something, as `Operator.ask`."""
        return self._uncaptured(request, lambda: self._terminal.ask(request))

    def enter(self, question: Question) -> str:
        """Ask a person a question, as `Operator.enter`."""
        return self._uncaptured(f"answer: {question.text}", lambda: self._terminal.enter(question))

    def _uncaptured(self, task: str, ask: Callable[[], T]) -> T:
        if self._capture is not None:
            self._capture.suspend(in_=True)
        try:
            if not sys.stdin.isatty():
                raise ConfigurationError(
                    f"a person must {task}, but there is no terminal to ask at",
                    remedy="place the robots first, then add --fieldkit-yes",
                )
            return ask()
        finally:
            if self._capture is not None:
                self._capture.resume()

    def _show(self, event: Event) -> None:
        self._sink(event)
        match event:
            case Request(text):
                sys.stderr.write(f"\n{text}, then Enter\n")
            case Asked(text, how):
                sys.stderr.write(f"\n{text}? {how}\n")
