"""Protocol of the observer of a run, which is called once per window."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple, Protocol, runtime_checkable

from sim_backends.cosim.run import Fate
from sim_backends.network.ip import Fragment
from sim_backends.world.motion import State


class Window(NamedTuple):
    """The events of a window.

    Attributes:
        begin_ns: Its beginning.
        end_ns: Its end.
        decided_by: What determined its length, for example a pair of agents; empty if the policy does not report it.
        entered: Fates of the packets that entered the network in it, in order. Most are not decided yet; the same
            objects are in `ended` of a later window.
        ended: Fates that were decided in it, in order.
        states: States of the agents at its end.
        assumed: States that the network assumed throughout it, or at its beginning if it extrapolates
            (`DeadReckoned`).
        wall_s: Wall time that it took, by part, as in `Run`.
    """

    begin_ns: int
    end_ns: int
    decided_by: str
    entered: Sequence[Fate]
    ended: Sequence[Fate]
    states: Mapping[str, State]
    assumed: Mapping[str, State]
    wall_s: Mapping[str, float]


class WindowObserver(Protocol):
    """Observes a run. It must not change its arguments; the recorded wall time does not include its time."""

    def begin(self, states: Mapping[str, State]) -> None:
        """Receive the states of the agents at time 0, before the first window."""
        ...

    def window(self, window: Window) -> None:
        """Receive a window, right after it has ended."""
        ...


@runtime_checkable
class IpObserver(Protocol):
    """An observer that also receives IP packets."""

    def log_ip(self, at_ns: int, name: str, fragment: Fragment) -> None:
        """Receive an IP packet, or a fragment of one, that an agent sent or that arrived at it."""
        ...
