"""Sharing of a processor by a thread and its child process; the expected processors are read from the kernel."""

import os
import subprocess
import sys
from collections.abc import Iterator

import pytest

from sim_backends.federates import processor_sharing
from sim_backends.federates.processor_sharing import ProcessorSharing, current_processor

ALLOWED = os.sched_getaffinity(0)
pytestmark = pytest.mark.skipif(len(ALLOWED) < 2, reason="it needs two processors")


@pytest.fixture
def child() -> Iterator["subprocess.Popen[bytes]"]:
    with subprocess.Popen((sys.executable, "-c", "input()"), stdin=subprocess.PIPE) as process:
        yield process
        assert process.stdin is not None
        process.stdin.close()
    assert os.sched_getaffinity(0) == ALLOWED


def test_thread_and_child_share_a_processor_only_during_an_exchange(
    child: "subprocess.Popen[bytes]", monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(processor_sharing, "_PERIOD_S", 3600.0)
    sharing = ProcessorSharing(child.pid)
    with sharing:
        assert os.sched_getaffinity(0) == ALLOWED  # the first exchange may use any processor
    for _ in range(3):
        (processor,) = os.sched_getaffinity(child.pid)
        assert os.sched_getaffinity(0) == ALLOWED
        with sharing:
            assert os.sched_getaffinity(0) == {processor} == {current_processor()}


def test_the_processor_is_chosen_again_after_an_exchange_on_any_processor(
    child: "subprocess.Popen[bytes]", monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(processor_sharing, "_PERIOD_S", 0.0)
    sharing, were_shared = ProcessorSharing(child.pid), []
    for _ in range(4):
        with sharing:
            were_shared.append(len(os.sched_getaffinity(0)) == 1)
    assert were_shared == [False, True, False, True]


def test_this_thread_may_use_all_processors_after_an_exchange_that_fails(child: "subprocess.Popen[bytes]") -> None:
    sharing = ProcessorSharing(child.pid)
    with sharing:
        pass

    def fail() -> None:
        with sharing:
            assert len(os.sched_getaffinity(0)) == 1
            raise TimeoutError

    with pytest.raises(TimeoutError):
        fail()
    assert os.sched_getaffinity(0) == ALLOWED


def test_a_child_that_has_exited_changes_nothing(child: "subprocess.Popen[bytes]") -> None:
    sharing = ProcessorSharing(child.pid)
    child.kill()
    child.wait()
    for _ in range(2):
        with sharing:
            assert os.sched_getaffinity(0) == ALLOWED
