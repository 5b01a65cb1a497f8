"""The person at the terminal where pytest runs, who carries real robots."""

import sys
from collections.abc import Callable
from typing import TypeVar

import pytest

from fieldkit.cli.terminal import Terminal
from fieldkit.core.errors import ConfigurationError
from fieldkit.core.events import Asked, Event, Request, Sink
from fieldkit.core.prompts import NOBODY, Answer, Operator, Question
from fieldkit.pytest.options import LabOptions

T = TypeVar("T")


def operator_of(config: pytest.Config, options: LabOptions, sink: Sink) -> Operator:
    """Return who is asked: nobody where the options say so, else who sits at the terminal."""
    return NOBODY if options.yes else Uncaptured(config, sink)


class Uncaptured:
    """Asks past pytest's capture, which keeps output and closes the input.

    Args:
        config: Pytest's.
        sink: Told each request and its answer.
    """

    def __init__(self, config: pytest.Config, sink: Sink) -> None:
        self._capture = config.pluginmanager.getplugin("capturemanager")
        self._sink = sink
        self._terminal = Terminal(self._show)

    def ask(self, request: str, *, may_skip: bool = False) -> Answer:  # noqa: ARG002 (a test that is left out is no test)
        """See `Operator.ask`."""
        return self._asking(request, lambda: self._terminal.ask(request))

    def enter(self, question: Question) -> str:
        """See `Operator.enter`."""
        return self._asking(f"say: {question.text}", lambda: self._terminal.enter(question))

    def _asking(self, what: str, ask: Callable[[], T]) -> T:
        if self._capture is not None:
            self._capture.suspend(in_=True)
        try:
            if not sys.stdin.isatty():
                raise ConfigurationError(
                    f"somebody must {what}, and there is no terminal to ask at",
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
