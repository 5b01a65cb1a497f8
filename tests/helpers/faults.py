"""Faults of emulated robots that last until the test has looked, however long that takes on a busy machine."""

import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field
from threading import Event

import pytest

from fieldkit.core.deadline import Deadline
from fieldkit.core.model import Fault
from sim_backends.emulated import testbed
from sim_backends.emulated.testbed import EmulatedTestbed
from tests.helpers.sshd import wait_until

_LONG_S = 120.0


@dataclass
class _Clock:
    """What a fault sleeps by: from when it began to when somebody has seen enough of it."""

    began: Event = field(default_factory=Event)
    seen: Event = field(default_factory=Event)

    def sleep(self, _duration_s: float) -> None:
        self.began.set()
        assert self.seen.wait(_LONG_S)

    def monotonic(self) -> float:
        return time.monotonic()


@contextmanager
def lasting(up: EmulatedTestbed, fault: Fault) -> Iterator[None]:
    """Let `fault` last as long as the context, whatever its own time; it has begun when the context is entered."""
    clock = _Clock()
    with pytest.MonkeyPatch.context() as patch, ThreadPoolExecutor(1) as pool:
        patch.setattr(testbed, "time", clock)
        injected = pool.submit(up.inject, fault)
        try:
            wait_until(lambda: clock.began.is_set() or injected.done(), Deadline.after(_LONG_S))
            yield
        finally:
            clock.seen.set()
        injected.result()
