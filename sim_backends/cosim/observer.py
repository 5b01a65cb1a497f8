"""Protocol of who watches a run: called once per window with what happened in it."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple, Protocol, runtime_checkable

from sim_backends.cosim.run import Fate
from sim_backends.network.ip import Fragment
from sim_backends.world.motion import State


class Window(NamedTuple):
    """What happened in a window.

    Attributes:
        begin_ns: When it began.
        end_ns: When it ended.
        decided_by: What decided its length, for example a pair of agents; empty where the policy does not say.
        entered: Fates of the packets that the network got in it, in order; most are not known yet, and the same
            object comes again in `ended` when it is.
        ended: Fates that became known in it, in order.
        states: Where the agents are at its end.
        known: Where the network took them to be throughout, or at its begin if it let them move on (`DeadReckoned`).
        wall_s: Wall time that it took, by part, as in `Run`.
    """

    begin_ns: int
    end_ns: int
    decided_by: str
    entered: Sequence[Fate]
    ended: Sequence[Fate]
    states: Mapping[str, State]
    known: Mapping[str, State]
    wall_s: Mapping[str, float]


class WindowObserver(Protocol):
    """Watches a run; it must change nothing in what it is shown, and its own time counts in no part of wall time."""

    def begin(self, states: Mapping[str, State]) -> None:
        """Take note of where the agents are at time 0, before the first window."""
        ...

    def window(self, window: Window) -> None:
        """Take note of a window, right after it ended."""
        ...


@runtime_checkable
class IpObserver(Protocol):
    """An observer that takes IP packets, too."""

    def log_ip(self, at_ns: int, name: str, fragment: Fragment) -> None:
        """Take note of an IP packet, or a fragment of one, that an agent sent or that arrived at it."""
        ...
