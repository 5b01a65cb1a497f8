"""Sampling of true states: at the first end of a window in each interval."""

from collections.abc import Callable, Mapping
from typing import Final

from sim_backends.cosim.observer import IpObserver, Window, WindowObserver
from sim_backends.network.ip import Fragment
from sim_backends.world.motion import State

EVERY_NS: Final = 100_000_000


class Sampling:
    """Selects the ends of windows at which states are recorded.

    Args:
        every_ns: Sampling interval, in simulated nanoseconds.
    """

    def __init__(self, every_ns: int = EVERY_NS) -> None:
        self._every_ns = every_ns
        self._due_ns = every_ns

    def is_due(self, end_ns: int) -> bool:
        """Return True if the states at the end of this window are recorded; called once per window, in order."""
        if end_ns < self._due_ns:
            return False
        self._due_ns = (end_ns // self._every_ns + 1) * self._every_ns
        return True


class StateSamples:
    """An observer that keeps the sampled states of a recording in memory, and forwards all calls to a recorder.

    Args:
        recorder: The recorder, or None.

    Attributes:
        states: Time in nanoseconds, agent, state, as `Recording.states`.
        log_ip: The recorder's method; missing if the recorder does not accept IP packets.
    """

    log_ip: Callable[[int, str, Fragment], None]

    def __init__(self, recorder: WindowObserver | None = None) -> None:
        self._recorder = recorder
        self._sampling = Sampling()
        self.states: list[tuple[int, str, State]] = []
        if isinstance(recorder, IpObserver):
            self.log_ip = recorder.log_ip

    def begin(self, states: Mapping[str, State]) -> None:
        """Add the states at time 0."""
        self.states += [(0, name, state) for name, state in states.items()]
        if self._recorder is not None:
            self._recorder.begin(states)

    def window(self, window: Window) -> None:
        """Add the states at the end of a window if they are due."""
        if self._sampling.is_due(window.end_ns):
            self.states += [(window.end_ns, name, state) for name, state in window.states.items()]
        if self._recorder is not None:
            self._recorder.window(window)
