"""Protocols of what a co-simulation brings together: physics, network, and the programs of the agents.

Time is an integer number of nanoseconds since the beginning. A federate is asked with times that never go back.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

from fieldkit.core.errors import ConfigurationError
from sim_backends.network.packets import Arrival, Datagram, Drop, Packet, Received
from sim_backends.world.motion import State


class PhysicsFederate(Protocol):
    """Moves the agents.

    Attributes:
        step_ns: Its own step; its states are those at whole steps.
        limits_m_s2: The most that each agent's velocity changes per second, in m/s^2. Asked for once; its values may
            change as the physics goes on.
    """

    step_ns: int
    limits_m_s2: Mapping[str, float]

    def advance(self, to_ns: int, commands: Mapping[str, Any]) -> Mapping[str, State]:
        """Return the state of each agent at its last own step that is not after `to_ns`.

        Args:
            to_ns: Until when.
            commands: What each agent's program asks of its body from now on, which is the time that was asked for
                last; an agent without one goes on as it was told before.
        """
        ...


def check_physics(physics: object) -> None:
    """Refuse what is no physics federate, before anything is asked of it.

    Raises:
        ConfigurationError: It lacks something; says what.
    """
    step_ns = getattr(physics, "step_ns", None)
    lacks = ""
    if not isinstance(step_ns, int) or isinstance(step_ns, bool) or step_ns <= 0:
        lacks = f"no step_ns, an integer above 0 (it is {step_ns!r})"
    elif not isinstance(getattr(physics, "limits_m_s2", None), Mapping):
        lacks = "no limits_m_s2, a mapping from each agent to a number"
    elif not callable(getattr(physics, "advance", None)):
        lacks = "no method advance(to_ns, commands)"
    if lacks:
        raise ConfigurationError(
            f"the physics {type(physics).__name__} has {lacks}",
            remedy="see what a physics class needs: fieldkit docs cosim-api",
        )


def check_states(states: Mapping[str, object]) -> None:
    """Refuse what a physics gives at time 0 if it is no mapping of states.

    Raises:
        ConfigurationError: There is something else in it; says what.
    """
    for name, state in states.items():
        if not isinstance(state, State):
            raise ConfigurationError(
                f"the physics gave {state!r} for {name}, which is no State",
                remedy="see what a physics class needs: fieldkit docs cosim-api",
            )


class NetworkFederate(Protocol):
    """Carries packets.

    One in which agents forward or interfere names them by an attribute `transmitters`, and the places of what
    interferes without being an agent by `fixed_emitters_m`: `error_bounded` and the errors of places include them.
    """

    def advance(
        self, to_ns: int, packets: Sequence[Packet], states: Mapping[str, State]
    ) -> tuple[list[Arrival], list[Drop]]:
        """Let everything happen up to `to_ns`; return what arrived and what never will, in order of time.

        One that can let agents move on by dead reckoning says so by an attribute `extrapolates` that is True; then
        states may be `DeadReckoned`, and it takes those of their own time for everything that happens.

        Args:
            to_ns: Until when.
            packets: What enters the network until then, in order of `enters_ns`.
            states: Where the agents are and how they move, as far as the network knows, from now on.
        """
        ...

    def next_event_ns(self) -> int | None:
        """Return when something happens next in it, None when nothing is under way."""
        ...


@dataclass(frozen=True)
class Action:
    """What a program does when it wakes.

    Attributes:
        datagrams: What it sends.
        command: What it asks of its agent's body; None for what it asked before.
    """

    datagrams: Sequence[Datagram] = ()
    command: Any = None


class Program(Protocol):
    """Software of one agent: it senses its own state, hears what the network delivers, sends, and steers."""

    def next_wake_ns(self) -> int | None:
        """Return when it wakes next by itself; None when only a datagram wakes it. It changes by waking alone."""
        ...

    def wake(self, now_ns: int, own: State, received: Sequence[Received]) -> Action:
        """Return what it does now.

        Args:
            now_ns: Now.
            own: The state of its agent, at the body's last own step.
            received: What arrived since it woke last.
        """
        ...


def next_send_ns(program: Program) -> int | None:
    """Return before when a program surely sends nothing by itself; None where it never will, but for mail.

    A program may say it by a method of this name, or else sends whenever it wakes.
    """
    return getattr(program, "next_send_ns", program.next_wake_ns)()
