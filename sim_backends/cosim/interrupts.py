"""SIGINT during a run: it stops the run between two windows, never while a window is being recorded."""

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

from sim_backends.cosim.coordinator import Coordinator


@contextmanager
def between_windows(coordinator: Coordinator) -> Iterator[None]:
    """Let SIGINT raise `KeyboardInterrupt` as soon as no window is being hashed and recorded.

    Outside the main thread, or if SIGINT has another handler, nothing changes.

    Args:
        coordinator: The coordinator of the run.
    """
    in_main_thread = threading.current_thread() is threading.main_thread()
    if not in_main_thread or signal.getsignal(signal.SIGINT) is not signal.default_int_handler:
        yield
        return

    def interrupt(number: int, frame: FrameType | None) -> None:
        if coordinator.is_committing:
            coordinator.is_interrupted = True
        else:
            signal.default_int_handler(number, frame)

    coordinator.is_committing = coordinator.is_interrupted = False
    signal.signal(signal.SIGINT, interrupt)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, signal.default_int_handler)
