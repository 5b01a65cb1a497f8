"""Programs of agents, and checks of federates (the simulators of physics and network).

The protocols of federates are in `sim_backends.federates`.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

from fieldkit.core.errors import ConfigurationError
from sim_backends.federates.protocols import (
    AnswerTimeoutError,
    FederateError,
    NetworkFederate,
    PhysicsFederate,
    UnansweredError,
    advance_text,
    federate_error,
    seconds_text,
)
from sim_backends.network.packets import Datagram, ReceivedDatagram
from sim_backends.world.motion import State

# The other modules of the co-simulation import these names from here.
__all__ = [
    "Action",
    "AnswerTimeoutError",
    "FederateError",
    "NetworkFederate",
    "PhysicsFederate",
    "Program",
    "UnansweredError",
    "advance_text",
    "check_physics",
    "check_states",
    "federate_error",
    "next_send_ns",
    "seconds_text",
]


def check_physics(physics: object) -> None:
    """Check that an object is a physics federate, before it is used.

    Raises:
        ConfigurationError: The object lacks an attribute or method, which the message names.
    """
    step_ns = getattr(physics, "step_ns", None)
    problem = ""
    if not isinstance(step_ns, int) or isinstance(step_ns, bool) or step_ns <= 0:
        problem = f"no step_ns, an integer above 0 (it is {step_ns!r})"
    elif not isinstance(getattr(physics, "limits_m_s2", None), Mapping):
        problem = "no limits_m_s2, a mapping from each agent to a number"
    elif not callable(getattr(physics, "advance", None)):
        problem = "no method advance(to_ns, commands)"
    if problem:
        raise ConfigurationError(
            f"the physics federate {type(physics).__name__} has {problem}",
            remedy="see what a physics class needs: fieldkit docs cosim-api",
        )


def check_states(states: Mapping[str, object]) -> None:
    """Check the states that a physics federate returns for time 0.

    Raises:
        ConfigurationError: A value is not a `State`; the message names it.
    """
    for name, state in states.items():
        if not isinstance(state, State):
            raise ConfigurationError(
                f"the physics federate returned {state!r} for {name}, which is not a State",
                remedy="see what a physics class needs: fieldkit docs cosim-api",
            )


@dataclass(frozen=True)
class Action:
    """The output of a program when it wakes.

    Attributes:
        datagrams: Datagrams to send.
        command: Command to the agent's body, or None to keep the previous command.
    """

    datagrams: Sequence[Datagram] = ()
    command: Any = None


class Program(Protocol):
    """Software of one agent: it reads the agent's state, receives and sends datagrams, and steers the body."""

    def next_wake_ns(self) -> int | None:
        """Return the time when its timer fires next, or None if no timer is set; only `wake` changes this time."""
        ...

    def wake(self, now_ns: int, own_state: State, received_datagrams: Sequence[ReceivedDatagram]) -> Action:
        """Return the action at this time.

        Args:
            now_ns: The current time.
            own_state: State of the program's agent at the last physics step.
            received_datagrams: Datagrams that have arrived since the previous call.
        """
        ...


def next_send_ns(program: Program) -> int | None:
    """Return a time before which a program sends only in reply to a received datagram, or None if it always does.

    A program may have a method `next_send_ns`; otherwise it is assumed to send whenever it wakes.
    """
    return getattr(program, "next_send_ns", program.next_wake_ns)()
