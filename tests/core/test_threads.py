"""Concurrent calls: the error that is raised if several calls fail."""

from threading import Event

import pytest

from fieldkit.core.errors import RobotError
from fieldkit.core.threads import run_parallel

TIMEOUT_S = 60.0


@pytest.mark.parametrize(
    ("second_error", "expected_message"),
    [(RobotError("it was stopped"), "exited with 7"), (KeyError("hops"), "hops")],
)
def test_a_programming_error_in_a_call_is_not_hidden_by_the_first_error(
    second_error: Exception, expected_message: str
) -> None:
    is_ended = Event()

    def call(is_first: bool) -> None:
        if is_first:
            raise RobotError("exited with 7")
        assert is_ended.wait(TIMEOUT_S)
        raise second_error

    with pytest.raises((RobotError, KeyError), match=expected_message):
        run_parallel(call, (True, False), end_others=is_ended.set)
