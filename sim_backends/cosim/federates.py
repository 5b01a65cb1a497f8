"""Protocols of federates and programs, and the errors that name the one that failed or did not answer."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

from fieldkit.core.errors import ConfigurationError, FieldkitError
from sim_backends.network.packets import Arrival, Datagram, Drop, Packet, Received
from sim_backends.world.motion import State


class FederateError(FieldkitError):
    """A federate or program failed or gave an impossible answer; the message names it, the time and the request."""


class UnansweredError(FederateError):
    """A federate or program did not answer within its deadline."""

    exit_code = 3


class AnswerTimeoutError(TimeoutError):
    """Raised by a federate or program that has waited for longer than its deadline, in wall time.

    Attributes:
        limit_s: The deadline, in seconds of wall time.
    """

    def __init__(self, limit_s: float) -> None:
        super().__init__(f"no answer for {limit_s:g} s")
        self.limit_s = limit_s


def federate_error(error: BaseException, federate: str, request: str) -> FederateError:
    """Return the error that names the federate or program that raised `error`.

    Args:
        error: The error.
        federate: Name of the federate or program, for the message.
        request: The requested action, with simulated times: `advance from 0 s to 1 s`.
    """
    if isinstance(error, FederateError):
        return error
    if isinstance(error, AnswerTimeoutError):
        return UnansweredError(
            f"{federate} has not answered for {error.limit_s:g} s: request to {request}",
            remedy="find out why it waits, or set a longer deadline",
        )
    return FederateError(
        f"{federate} failed at the request to {request}: {type(error).__name__}: {error}",
        remedy=error.remedy if isinstance(error, FieldkitError) else "",
    )


def seconds_text(time_ns: int) -> str:
    """Return a simulated time in seconds as text, with all its digits."""
    whole, rest = divmod(time_ns, 10**9)
    return f"{whole}.{rest:09d}".rstrip("0").rstrip(".") + " s"


class PhysicsFederate(Protocol):
    """Moves the agents.

    Attributes:
        step_ns: Time step; there are states at whole steps only.
        limits_m_s2: Largest change of each agent's velocity per second, in m/s^2. The mapping is read once; its
            values may change during the run.
    """

    step_ns: int
    limits_m_s2: Mapping[str, float]

    def advance(self, to_ns: int, commands: Mapping[str, Any]) -> Mapping[str, State]:
        """Return the state of each agent at the last step that is not after `to_ns`.

        Args:
            to_ns: Time to advance to.
            commands: Command of each agent's program to its body. It applies from the time of the previous call on;
                an agent without a command keeps its last one.
        """
        ...


def check_physics(physics: object) -> None:
    """Check that an object is a physics federate, before it is used.

    Raises:
        ConfigurationError: It lacks an attribute or method; the message names it.
    """
    step_ns = getattr(physics, "step_ns", None)
    missing = ""
    if not isinstance(step_ns, int) or isinstance(step_ns, bool) or step_ns <= 0:
        missing = f"no step_ns, an integer above 0 (it is {step_ns!r})"
    elif not isinstance(getattr(physics, "limits_m_s2", None), Mapping):
        missing = "no limits_m_s2, a mapping from each agent to a number"
    elif not callable(getattr(physics, "advance", None)):
        missing = "no method advance(to_ns, commands)"
    if missing:
        raise ConfigurationError(
            f"the physics {type(physics).__name__} has {missing}",
            remedy="see what a physics class needs: fieldkit docs cosim-api",
        )


def check_states(states: Mapping[str, object]) -> None:
    """Check the states that a physics returns for time 0.

    Raises:
        ConfigurationError: A value is not a `State`; the message names it.
    """
    for name, state in states.items():
        if not isinstance(state, State):
            raise ConfigurationError(
                f"the physics gave {state!r} for {name}, which is not a State",
                remedy="see what a physics class needs: fieldkit docs cosim-api",
            )


class NetworkFederate(Protocol):
    """Carries packets.

    If agents forward or interfere, an attribute `transmitters` has their names; if objects that are not agents
    interfere, an attribute `fixed_emitters_m` has their positions. `error_bounded` and the position errors include
    them.
    """

    def advance(
        self, to_ns: int, packets: Sequence[Packet], states: Mapping[str, State]
    ) -> tuple[list[Arrival], list[Drop]]:
        """Simulate up to `to_ns`, and return the arrivals and drops in order of time.

        A network that supports dead reckoning has an attribute `extrapolates` that is True. Then `states` may be
        `DeadReckoned`, and the network evaluates them at the time of each event.

        Args:
            to_ns: Time to advance to.
            packets: Packets that enter the network up to then, in order of `enters_ns`.
            states: Positions and velocities of the agents that the network assumes from now on.
        """
        ...

    def next_event_ns(self) -> int | None:
        """Return the time of its next event, or None if nothing is scheduled."""
        ...


@dataclass(frozen=True)
class Action:
    """The output of a program when it wakes.

    Attributes:
        datagrams: Datagrams that it sends.
        command: Command to its agent's body, or None to keep the previous one.
    """

    datagrams: Sequence[Datagram] = ()
    command: Any = None


class Program(Protocol):
    """Software of one agent: it reads the agent's state, receives datagrams, sends, and steers."""

    def next_wake_ns(self) -> int | None:
        """Return the time when its timer wakes it next, or None without a timer; only a wake changes this time."""
        ...

    def wake(self, now_ns: int, own_state: State, received: Sequence[Received]) -> Action:
        """Return the action at this time.

        Args:
            now_ns: The current time.
            own_state: State of its agent at the last step of the physics.
            received: Datagrams that have arrived since it woke last.
        """
        ...


def next_send_ns(program: Program) -> int | None:
    """Return a time before which a program sends nothing unless it receives a datagram, or None if it never will.

    A program may have a method `next_send_ns`; otherwise it is assumed to send whenever it wakes.
    """
    return getattr(program, "next_send_ns", program.next_wake_ns)()
