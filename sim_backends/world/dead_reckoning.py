"""Dead reckoning: extrapolation with constant velocity (IEEE Std 1278.1-2012, annex E, DRM FPW)."""

from collections.abc import Iterator, Mapping

from sim_backends.world.motion import State


def moved_on(state: State, seconds: float) -> State:
    """Return the state after this time, at constant velocity."""
    (e, n, u), (v_e, v_n, v_u) = state.position_m, state.velocity_m_s
    return state._replace(position_m=(e + seconds * v_e, n + seconds * v_n, u + seconds * v_u))


class _Extrapolated(Mapping[str, State]):
    """States extrapolated by some seconds, each computed on request."""

    def __init__(self, states: Mapping[str, State], seconds: float) -> None:
        self._states = states
        self._seconds = seconds

    def __getitem__(self, name: str) -> State:
        return moved_on(self._states[name], self._seconds)

    def __iter__(self) -> Iterator[str]:
        return iter(self._states)

    def __len__(self) -> int:
        return len(self._states)


class DeadReckoned(Mapping[str, State]):
    """States known at a time, and extrapolated later; as a mapping, it contains those of that time.

    Args:
        states: The states.
        since_ns: Their time.
        step_ns: The extrapolation moves in whole steps of this length, counted from `since_ns`.

    Attributes:
        since_ns: Time of the states.
        step_ns: Length of a step.
    """

    def __init__(self, states: Mapping[str, State], since_ns: int, step_ns: int) -> None:
        self._states = states
        self.since_ns = since_ns
        self.step_ns = step_ns
        self._steps = 0
        self._now = states

    def at(self, now_ns: int) -> Mapping[str, State]:
        """Return the states at a time that is not before theirs; the same object for a whole step."""
        steps = (now_ns - self.since_ns) // self.step_ns
        if steps != self._steps:
            self._steps = steps
            self._now = _Extrapolated(self._states, steps * self.step_ns / 1e9) if steps else self._states
        return self._now

    def __getitem__(self, name: str) -> State:
        return self._states[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._states)

    def __len__(self) -> int:
        return len(self._states)
