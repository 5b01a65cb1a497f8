"""Dead reckoning of robots: extrapolation with constant velocity.

This is the algorithm DRM FPW of IEEE Std 1278.1-2012, annex E.
"""

from collections.abc import Iterator, Mapping

from sim_backends.world.motion import State, TiltedState


def extrapolate(state: State, seconds: float) -> State:
    """Return the state after this time, at constant velocity."""
    (e, n, u), velocity_m_s, heading_rad = state
    v_e, v_n, v_u = velocity_m_s
    position_m = e + seconds * v_e, n + seconds * v_n, u + seconds * v_u
    if isinstance(state, TiltedState):
        return TiltedState.of(position_m, velocity_m_s, heading_rad, state.tilt_rad)
    return State(position_m, velocity_m_s, heading_rad)


class _ExtrapolatedStates(Mapping[str, State]):
    """States extrapolated by some seconds, each computed on request."""

    def __init__(self, states: Mapping[str, State], seconds: float) -> None:
        self._states = states
        self._seconds = seconds

    def __getitem__(self, name: str) -> State:
        return extrapolate(self._states[name], self._seconds)

    def __iter__(self) -> Iterator[str]:
        return iter(self._states)

    def __len__(self) -> int:
        return len(self._states)


class DeadReckoned(Mapping[str, State]):
    """States at a reference time, and extrapolated to later times. The mapping has the states at the reference time.

    Args:
        states: The states.
        since_ns: The reference time.
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
        self._current = states

    def at(self, now_ns: int) -> Mapping[str, State]:
        """Return the states at `now_ns`, at or after the reference time; the same object during a whole step."""
        steps = (now_ns - self.since_ns) // self.step_ns
        if steps != self._steps:
            self._steps = steps
            self._current = _ExtrapolatedStates(self._states, steps * self.step_ns / 1e9) if steps else self._states
        return self._current

    def __getitem__(self, name: str) -> State:
        return self._states[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._states)

    def __len__(self) -> int:
        return len(self._states)
