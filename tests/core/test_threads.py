"""Concurrent calls: which error is raised if several calls fail."""

from threading import Event

import pytest

from fieldkit.core.errors import RobotError
from fieldkit.core.threads import run_parallel

TIMEOUT_S = 60.0


@pytest.mark.parametrize(
    ("consequence", "raised"), [(RobotError("it was stopped"), "exited with 7"), (KeyError("hops"), "hops")]
)
def test_a_mistake_in_a_call_is_not_hidden_by_the_first_error(consequence: Exception, raised: str) -> None:
    ended = Event()

    def call(is_first: bool) -> None:
        if is_first:
            raise RobotError("exited with 7")
        assert ended.wait(TIMEOUT_S)
        raise consequence

    with pytest.raises((RobotError, KeyError), match=raised):
        run_parallel(call, (True, False), end_others=ended.set)
