"""The interface of a sync policy, and the data from which it determines the next window.

A sync policy determines how long physics and network run without an exchange of data (a window).
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Final, Protocol, TypeGuard

from fieldkit.core.errors import ConfigurationError
from fieldkit.core.model import Vector
from sim_backends.world.motion import State

Pair = tuple[str, str]
"""Names of a sender and a receiver; the paper (cited in docs/index.md) calls them publisher and subscriber."""


@dataclass(slots=True)
class Situation:
    """The input of a policy. A co-simulation has one object, which it updates as it advances.

    Attributes:
        now_ns: Time that physics has reached. While a policy extends a window, the network is still at its beginning.
        states: States of the agents that are present now.
        pairs: Sender and receiver of each possible transmission between agents that are present.
        next_wake_ns: A function; returns the next time at which a program wakes, or an agent appears or disappears;
            None without such a time.
        next_event_ns: A function; returns the time of the next event in the network, or None.
        physics_step_ns: Time step of the physics simulator.
        limits_m_s2: Largest change of each agent's velocity per second; agents that appeared during the run may be
            missing.
        next_send_ns: Time before which no program sends, or None if no program will send; only set for policies that
            look ahead.
        assumed_states: The current states of the agents as assumed by the network, which extrapolates from them; only
            set for policies that look ahead. None means that the agents stay at their positions.
        other_agents: Agents that forward or interfere, and agents that have sent packets but are not in `pairs`.
        fixed_emitters_m: Positions of sources of interference that are not agents.
    """

    now_ns: int
    states: Mapping[str, State]
    pairs: Sequence[Pair]
    next_wake_ns: Callable[[], int | None]
    next_event_ns: Callable[[], int | None]
    physics_step_ns: int
    limits_m_s2: Mapping[str, float]
    next_send_ns: int | None = None
    assumed_states: Mapping[str, State] | None = None
    other_agents: tuple[str, ...] = ()
    fixed_emitters_m: tuple[Vector, ...] = ()

    @property
    def next_ns(self) -> int | None:
        """The time of the next event of programs or network, or None; `now_ns` if an event is due now."""
        times_ns = [at_ns for at_ns in (self.next_wake_ns(), self.next_event_ns()) if at_ns is not None]
        return max(min(times_ns), self.now_ns) if times_ns else None

    @property
    def next_use_ns(self) -> int | None:
        """The earliest time at which the network may need the position of an agent, or None."""
        times_ns = [at_ns for at_ns in (self.next_send_ns, self.next_event_ns()) if at_ns is not None]
        return max(min(times_ns), self.now_ns) if times_ns else None


class SyncPolicy(Protocol):
    """Determines the length of each window, and when data passes from one window to the next.

    The constructor may have the parameters `window_s`, `longest_s`, `bound_m`, `bound_db` and `exponent`: the values
    of `policy` in a scenario. A policy may have a text `decided_by` that describes what determined the last window;
    recordings contain it. A policy with the methods of `LookingAhead` (in the same module) looks ahead: physics and
    programs advance before the network does.

    Attributes:
        name: Its name in scenarios and tables.
        exact: True if every event is at the end of a window, so that all data is used without delay.
        defers_sends: True if a packet enters the network at the end of the window in which it was sent.
        uses_end_states: True if the network uses the states at the end of a window for the whole window; events at
            the end time then belong to the window. Otherwise the network uses the states at the beginning.
        defers_arrivals: True if an arrival counts from the end of its window; otherwise it counts from its actual
            time, which is already in the past of the receiver.
    """

    name: str
    exact: bool
    defers_sends: bool
    uses_end_states: bool
    defers_arrivals: bool

    def next_window(self, situation: Situation) -> int | None:
        """Return the end of the next window, an integer of at least `situation.now_ns`; it is called once per window.

        The end may be between physics steps. None means that the window lasts until the end of the run. The run fails
        after more than 1000 successive windows of length 0.

        Raises:
            PolicyError: The policy cannot determine a window for this situation.
        """
        ...


class LookingAhead(SyncPolicy, Protocol):
    """A policy that advances physics and programs ahead of the network, and determines how far.

    It defers arrivals. They count from the end of the window, so nothing before the end depends on the network.
    """

    def reckoning_step_ns(self, situation: Situation) -> int:
        """Return the step of the network's dead reckoning (extrapolation of positions) in the window that begins now.

        Args:
            situation: The current situation; `assumed_states` has the velocities with which the network will
                extrapolate.
        """
        ...

    def extended_end_ns(self, situation: Situation) -> int:
        """Return the time to which the current window can be extended; the agents have reached `situation.now_ns`.

        Args:
            situation: The current situation of physics and programs. The network is still at the beginning of the
                window, so `next_event_ns` returns its first event after the beginning. If a program has sent a packet
                in the window, `next_use_ns` is `now_ns`, because the network may need positions immediately.

        Returns:
            The time up to which the agents may advance before the next call; `situation.now_ns` if the window must
            end now.
        """
        ...


def looks_ahead(policy: SyncPolicy) -> TypeGuard[LookingAhead]:
    """Return True if a policy has the methods of `LookingAhead`."""
    # `isinstance` with a runtime-checkable protocol takes 20 us, which is significant in a run in real time: it calls
    # `Coordinator.advance` for each window.
    return hasattr(policy, "reckoning_step_ns") and hasattr(policy, "extended_end_ns")


_MEMBERS: Final = ("name", "exact", "defers_sends", "uses_end_states", "defers_arrivals", "next_window")
"""Members that every sync policy must have."""


def missing_members(policy: object) -> list[str]:
    """Return the names of the members of `SyncPolicy` that an object or a class lacks."""
    return [member for member in _MEMBERS if not hasattr(policy, member)]


class PolicyError(ConfigurationError):
    """A policy cannot determine a window, or one of its parameters is invalid."""


def window_ns(policy: str, window_s: float) -> float:
    """Return the length of a window in nanoseconds, which need not be a whole number.

    Raises:
        PolicyError: `window_s` is not a positive finite time.
    """
    if not 0 < window_s < math.inf:
        raise PolicyError(
            f"a window of {window_s:g} s is not a positive time",
            where=policy,
            remedy="use some milliseconds, for example 0.01 s",
        )
    return window_s * 1e9
