"""Windows of one fixed length, the base of several policies."""

from sim_backends.cosim.policies.base import PolicyError, Situation, window_ns
from sim_backends.cosim.windows import Windows


class FixedWindow:
    """Windows of one length.

    Args:
        window_s: Their length in seconds; fractions of a nanosecond are carried over.

    Raises:
        PolicyError: It is not a positive time.
    """

    name: str
    exact = False

    def __init__(self, window_s: float) -> None:
        self._window_ns = window_ns(self.name, window_s)
        self._windows = Windows()

    def next_window(self, situation: Situation) -> int:
        """Return the end of the next window.

        Raises:
            PolicyError: The window is shorter than the step of the physics.
        """
        if self._window_ns < situation.physics_step_ns:
            raise PolicyError(
                f"a window of {self._window_ns:g} ns is shorter than the physics' own step of "
                f"{situation.physics_step_ns} ns, so that nothing changes in it",
                where=self.name,
                remedy="use a longer window, or physics with a shorter step",
            )
        return self._windows.end_ns(situation.now_ns, self._window_ns)
