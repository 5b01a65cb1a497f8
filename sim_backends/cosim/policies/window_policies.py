"""The sync policies other than `error_bounded`, and a sum of window lengths without accumulated rounding errors."""

import math
from collections.abc import Sequence
from typing import Final

from sim_backends.cosim.policies.sync_policy import PolicyError, Situation, window_ns

_AS_PER_NS: Final = 10**9
"""Attoseconds per nanosecond. A length in whole attoseconds is wrong by at most 0.5 as, or 0.5 ns in 10^9 windows."""


class Windows:
    """Computes the ends of windows whose lengths are not whole nanoseconds.

    A window ends at the last whole nanosecond that the sum of all lengths so far has reached.
    """

    def __init__(self) -> None:
        self._length_ns = 0.0
        self._whole_ns = self._fraction_as = self._sum_of_fractions_as = 0

    def end_ns(self, begin_ns: int, length_ns: float) -> int:
        """Return the end of a window.

        Args:
            begin_ns: Its beginning, which is the end of the previous window.
            length_ns: Its length, which need not be a whole number.
        """
        if length_ns != self._length_ns:
            self._length_ns = length_ns
            self._whole_ns, self._fraction_as = divmod(round(length_ns * _AS_PER_NS), _AS_PER_NS)
        self._sum_of_fractions_as += self._fraction_as
        if self._sum_of_fractions_as < _AS_PER_NS:
            return begin_ns + self._whole_ns
        self._sum_of_fractions_as -= _AS_PER_NS
        return begin_ns + self._whole_ns + 1


class FixedWindow:
    """Base class of the policies whose windows all have the same length.

    Args:
        window_s: Length of the windows in seconds. Windows end at whole nanoseconds; the remaining fractions are
            added to later windows.

    Raises:
        PolicyError: The length is not a positive time.
    """

    name: str
    exact = False

    def __init__(self, window_s: float) -> None:
        self._window_ns = window_ns(self.name, window_s)
        self._windows = Windows()

    def next_window(self, situation: Situation) -> int:
        """Return the end of the next window.

        Raises:
            PolicyError: The window is shorter than the physics step.
        """
        if self._window_ns < situation.physics_step_ns:
            raise PolicyError(
                f"a window of {self._window_ns:g} ns is shorter than the physics step, "
                f"{situation.physics_step_ns} ns, so that no state changes in it",
                where=self.name,
                remedy="use a longer window, or physics with a shorter step",
            )
        return self._windows.end_ns(situation.now_ns, self._window_ns)


class TimeStepped(FixedWindow):
    """Data is exchanged only at the ends of windows."""

    name = "time_stepped"
    defers_sends = True
    uses_end_states = False
    defers_arrivals = True


class Scheduled(FixedWindow):
    """Packets enter the network immediately; arrivals count from the end of the window."""

    name = "scheduled"
    defers_sends = False
    uses_end_states = False
    defers_arrivals = True


class SlidingWindow(FixedWindow):
    """The network is simulated one window later than the physics."""

    name = "sliding_window"
    defers_sends = False
    uses_end_states = True
    defers_arrivals = False


class EventDriven:
    """A window lasts until the next event of a program or of the network. This is the exact reference."""

    name = "event_driven"
    exact = True
    defers_sends = False
    uses_end_states = True
    defers_arrivals = False

    def next_window(self, situation: Situation) -> int | None:
        """Return the time of the next event, or None if there are no more events."""
        return situation.next_ns


class VariableStepped:
    """A window lasts until the next physics step or the next event, whichever is first."""

    name = "variable_stepped"
    exact = True
    defers_sends = False
    uses_end_states = True
    defers_arrivals = False

    def next_window(self, situation: Situation) -> int:
        """Return the time of the next step or event."""
        step_ns = situation.physics_step_ns
        next_step_ns = (situation.now_ns // step_ns + 1) * step_ns
        next_ns = situation.next_ns
        return next_step_ns if next_ns is None else min(next_step_ns, next_ns)


NS_PER_M_S = 1e6
"""Change of the window per m/s of speed difference, in nanoseconds.

It is the constant 1/1000 s of the paper (cited in docs/index.md).
"""


class VelocityAwareRaw:
    """The smallest window `w + (Vp - Vs) / 1000` of any pair of publisher and subscriber: the rule of the paper.

    Vp and Vs are the speeds of the publisher and the subscriber in m/s; the window is in seconds. Without pairs, the
    window is w.

    Args:
        window_s: w, in seconds.

    Raises:
        PolicyError: w is not a positive time.
    """

    name = "velocity_aware_raw"
    exact = False
    defers_sends = False
    uses_end_states = True
    defers_arrivals = False

    def __init__(self, window_s: float = 0.001) -> None:
        self._window_ns = window_ns(self.name, window_s)
        self._windows = Windows()
        self._pair = "", ""

    def next_window(self, situation: Situation) -> int:
        """Return the end of the next window.

        Raises:
            PolicyError: The window that the rule gives for a pair is shorter than 1 ns.
        """
        speeds_m_s = {name: math.hypot(*state.velocity_m_s) for name, state in situation.states.items()}
        length_ns, publisher, subscriber = min(
            (
                (
                    self._window_ns + (speeds_m_s[publisher] - speeds_m_s[subscriber]) * NS_PER_M_S,
                    publisher,
                    subscriber,
                )
                for publisher, subscriber in situation.pairs
            ),
            default=(self._window_ns, "", ""),
        )
        if length_ns < 1:
            raise PolicyError(
                f"{publisher} publishes at {speeds_m_s[publisher]:g} m/s to {subscriber} at "
                f"{speeds_m_s[subscriber]:g} m/s: w + (Vp - Vs)/1000 is {length_ns / 1e9:g} s, so that time "
                f"{'stops' if length_ns >= 0 else 'runs backwards'}",
                where=f"{self.name} at {situation.now_ns / 1e9:g} s",
                remedy="use velocity_aware, whose windows are always positive",
            )
        self._pair = publisher, subscriber
        return self._windows.end_ns(situation.now_ns, length_ns)

    @property
    def decided_by(self) -> str:
        """Publisher and subscriber of the pair that determined the last window; empty without pairs."""
        return " to ".join(filter(None, self._pair))


class VelocityAware:
    """The smallest window `w + |Vp - Vs| / 1000` of any pair, at least a physics step.

    |Vp - Vs| is the relative speed of publisher and subscriber in m/s; the window is in seconds.

    Args:
        window_s: w, in seconds.
        longest_s: Longest window, in seconds, if that is at least a physics step; it also applies without pairs.

    Raises:
        PolicyError: One of these values is not a positive time.
    """

    name = "velocity_aware"
    exact = False
    defers_sends = False
    uses_end_states = True
    defers_arrivals = False

    def __init__(self, window_s: float = 0.001, longest_s: float = 0.1) -> None:
        self._window_ns = window_ns(self.name, window_s)
        self._longest_ns = window_ns(self.name, longest_s)
        self._windows = Windows()
        self._pair: Sequence[str] = ()

    def next_window(self, situation: Situation) -> int:
        """Return the end of the next window."""
        states = situation.states
        lowest_m_s, self._pair = min(
            (
                (math.dist(states[pair[0]].velocity_m_s, states[pair[1]].velocity_m_s), pair)
                for pair in situation.pairs
            ),
            default=(math.inf, ()),
        )
        length_ns = min(self._window_ns + lowest_m_s * NS_PER_M_S, self._longest_ns)
        return self._windows.end_ns(situation.now_ns, max(length_ns, situation.physics_step_ns))

    @property
    def decided_by(self) -> str:
        """The pair whose relative speed was the lowest at the beginning of the last window; empty without pairs."""
        return " and ".join(self._pair)
