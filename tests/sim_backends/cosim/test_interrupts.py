"""SIGINT at any point of a window: recording and event hash contain the same windows."""

import os
import signal
from collections.abc import Mapping

import pytest

from sim_backends.cosim import build, load_scenario
from sim_backends.cosim.commands.execution import between_windows
from sim_backends.cosim.run_record import EventDigest, Window
from sim_backends.world.motion import State

INTERRUPTED_WINDOW = 7


class Counting:
    """An observer that counts windows, and can interrupt one."""

    def __init__(self, *, interrupts: bool) -> None:
        self.windows = 0
        self._interrupts = interrupts

    def begin(self, states: Mapping[str, State]) -> None:
        pass

    def window(self, window: Window) -> None:
        if self._interrupts and self.windows == INTERRUPTED_WINDOW:
            os.kill(os.getpid(), signal.SIGINT)
        self.windows += 1


@pytest.mark.parametrize("interrupts", [True, False], ids=["while it is recorded", "while it is hashed"])
def test_a_window_is_both_hashed_and_recorded_or_neither(
    monkeypatch: pytest.MonkeyPatch, *, interrupts: bool
) -> None:
    observer = Counting(interrupts=interrupts)
    simulation = build(load_scenario("field_30ft"), recorder=observer)
    coordinator = simulation.coordinator
    if not interrupts:
        add_window = EventDigest.add_window

        def interrupted(digest: EventDigest, *arguments: object) -> None:
            add_window(digest, *arguments)  # type: ignore[arg-type]
            os.kill(os.getpid(), signal.SIGINT)

        monkeypatch.setattr(EventDigest, "add_window", interrupted)
    with pytest.raises(KeyboardInterrupt), between_windows(coordinator):
        simulation.run()
    digest = coordinator._digest
    assert observer.windows == digest._windows + len(digest.quiet_ends_ns) == len(coordinator.run.windows_ns) > 0
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
