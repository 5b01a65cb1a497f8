"""Protocol of a sync policy, and what it is told and answers."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

from fieldkit.core.errors import ConfigurationError
from fieldkit.core.model import Vector
from sim_backends.world.motion import State

Pair = tuple[str, str]
"""Publisher and subscriber."""


@dataclass(slots=True)
class Situation:
    """What a policy decides by. It is alive: a co-simulation has one, which goes on with it.

    Attributes:
        now_ns: Both simulators have reached this time.
        states: Of the agents, now.
        pairs: Who may send to whom.
        next_wake_ns: Asks when a program wakes next by itself; None for never.
        next_event_ns: Asks when something happens next in the network; None for never.
        physics_step_ns: Own step of the physics.
        limits_m_s2: The most that each agent's velocity changes per second.
        next_send_ns: Before when surely no program sends anything; told to policies that look ahead.
        known: Where the network takes the agents to be now, and how to go on; told to policies that look ahead, and
            None for where they are, standing.
        others: Agents that forward or interfere, or sent without being in `pairs`.
        fixed_m: Places of what interferes without being an agent.
    """

    now_ns: int
    states: Mapping[str, State]
    pairs: Sequence[Pair]
    next_wake_ns: Callable[[], int | None]
    next_event_ns: Callable[[], int | None]
    physics_step_ns: int
    limits_m_s2: Mapping[str, float]
    next_send_ns: int | None = None
    known: Mapping[str, State] | None = None
    others: tuple[str, ...] = ()
    fixed_m: tuple[Vector, ...] = ()

    @property
    def next_ns(self) -> int | None:
        """When anything happens next, None for never."""
        known = [at_ns for at_ns in (self.next_wake_ns(), self.next_event_ns()) if at_ns is not None]
        return max(min(known), self.now_ns) if known else None

    @property
    def next_use_ns(self) -> int | None:
        """When the network may next have to know where anybody is, None for never."""
        known = [at_ns for at_ns in (self.next_send_ns, self.next_event_ns()) if at_ns is not None]
        return max(min(known), self.now_ns) if known else None


class SyncPolicy(Protocol):
    """Decides how long each window is, and what crosses its borders how.

    One that can say what decided the last window has a text `decided_by`, which is asked for where a run is recorded.
    One that has `goes_on` is a `LookingAhead`.

    Attributes:
        name: As scenarios and tables have it.
        exact: Whether no event lies within a window but at its end, so that nothing is known late.
        holds_sends: Whether a packet enters the network only when the window ends in which it was sent.
        knows_end: Whether the network knows, for a whole window, where agents are at its end, which then belongs to
            it; else at its beginning.
        holds_arrivals: Whether an arrival counts from the end of its window; else from its own time, which the
            receiver has passed already.
    """

    name: str
    exact: bool
    holds_sends: bool
    knows_end: bool
    holds_arrivals: bool

    def next_window(self, situation: Situation) -> int | None:
        """Return when the next window ends, called once for each; None where nothing will ever happen.

        Raises:
            PolicyError: The policy has no window for this situation.
        """
        ...


@runtime_checkable
class LookingAhead(SyncPolicy, Protocol):
    """A policy that lets physics and programs go ahead of the network, and sees how far they may.

    It holds arrivals: as they count from the window's end, nothing before it depends on what the network does.
    """

    def moves_on_every_ns(self, situation: Situation) -> int:
        """Return in which steps the network lets agents move on in the window that begins now.

        Args:
            situation: How things are now; `known` tells the velocities at which agents will move on.
        """
        ...

    def goes_on(self, situation: Situation) -> int:
        """Return until when a window goes on that physics and programs have come to `situation.now_ns` in.

        Args:
            situation: How things are now, but for the network, which is at the window's begin: what it will do next
                is told as it was then, and who sent anything in the window may ask for places at once.

        Returns:
            When to look again; now, to let the window end here.
        """
        ...


class PolicyError(ConfigurationError):
    """A policy has no window: says when, for whom, and why."""


def window_ns(policy: str, window_s: float) -> float:
    """Return the length of a window in nanoseconds, which need not be whole.

    Raises:
        PolicyError: It is no positive time.
    """
    if not 0 < window_s < math.inf:
        raise PolicyError(
            f"a window of {window_s:g} s is no positive time",
            where=policy,
            remedy="give it some milliseconds, for example 0.01 s",
        )
    return window_s * 1e9
