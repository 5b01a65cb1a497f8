"""Windows of one fixed length, as several policies have them."""

from sim_backends.cosim.policies.base import PolicyError, Situation, window_ns
from sim_backends.cosim.windows import Windows


class FixedWindow:
    """The ends of windows of one length.

    Args:
        window_s: Their length in seconds; what is less than a nanosecond is carried over.

    Raises:
        PolicyError: It is no positive time.
    """

    name: str
    exact = False

    def __init__(self, window_s: float) -> None:
        self._window_ns = window_ns(self.name, window_s)
        self._windows = Windows()

    def next_window(self, situation: Situation) -> int:
        """See `SyncPolicy.next_window`.

        Raises:
            PolicyError: The window is shorter than the physics' own step.
        """
        if self._window_ns < situation.physics_step_ns:
            raise PolicyError(
                f"a window of {self._window_ns:g} ns is shorter than the physics' own step of "
                f"{situation.physics_step_ns} ns: nothing changes in it",
                where=self.name,
                remedy="take a longer window, or physics with a shorter step",
            )
        return self._windows.end_ns(situation.now_ns, self._window_ns)
