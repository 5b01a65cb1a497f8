"""Faults of emulated robots that last until the test ends them, so that they also work on a slow machine."""

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

_TIMEOUT_S = 120.0


@dataclass
class _Clock:
    """Replaces the clock of the testbed; `sleep` returns when the test releases the fault."""

    started: Event = field(default_factory=Event)
    released: Event = field(default_factory=Event)

    def sleep(self, _duration_s: float) -> None:
        self.started.set()
        assert self.released.wait(_TIMEOUT_S)

    def monotonic(self) -> float:
        return time.monotonic()


@contextmanager
def inject_until_exit(emulation: EmulatedTestbed, fault: Fault) -> Iterator[None]:
    """Inject `fault` for the duration of the context instead of its configured duration; it is active in the body."""
    clock = _Clock()
    with pytest.MonkeyPatch.context() as patch, ThreadPoolExecutor(1) as pool:
        patch.setattr(testbed, "time", clock)
        injection = pool.submit(emulation.inject, fault)
        try:
            wait_until(lambda: clock.started.is_set() or injection.done(), Deadline.after(_TIMEOUT_S))
            yield
        finally:
            clock.released.set()
        injection.result()
