"""How often true states are kept: at the first end of a window in each interval."""

from collections.abc import Callable, Mapping
from typing import Final

from sim_backends.cosim.observer import IpObserver, Window, WindowObserver
from sim_backends.network.ip import Fragment
from sim_backends.world.motion import State

EVERY_NS: Final = 100_000_000


class Sampling:
    """Says at which ends of windows states are kept.

    Args:
        every_ns: How often, in simulated nanoseconds.
    """

    def __init__(self, every_ns: int = EVERY_NS) -> None:
        self._every_ns = every_ns
        self._due_ns = every_ns

    def is_due(self, end_ns: int) -> bool:
        """Return whether those at the end of this window are kept."""
        if end_ns < self._due_ns:
            return False
        self._due_ns = (end_ns // self._every_ns + 1) * self._every_ns
        return True


class StateSamples:
    """An observer that keeps the states which a recording has, and hands on what it is told.

    Args:
        recorder: Whom it tells; None for nobody.

    Attributes:
        states: When, whose, and what, as `Recording.states`.
        log_ip: The recorder's, if it takes IP packets.
    """

    log_ip: Callable[[int, str, Fragment], None]

    def __init__(self, recorder: WindowObserver | None = None) -> None:
        self._recorder = recorder
        self._sampling = Sampling()
        self.states: list[tuple[int, str, State]] = []
        if isinstance(recorder, IpObserver):
            self.log_ip = recorder.log_ip

    def begin(self, states: Mapping[str, State]) -> None:
        """See `WindowObserver.begin`."""
        self.states += [(0, name, state) for name, state in states.items()]
        if self._recorder is not None:
            self._recorder.begin(states)

    def window(self, window: Window) -> None:
        """See `WindowObserver.window`."""
        if self._sampling.is_due(window.end_ns):
            self.states += [(window.end_ns, name, state) for name, state in window.states.items()]
        if self._recorder is not None:
            self._recorder.window(window)
