"""Interfaces of federates (the simulators of a co-simulation), and errors that name the federate that failed."""

from collections.abc import Mapping, Sequence
from typing import Any, Protocol

from fieldkit.core.errors import FieldkitError
from sim_backends.network.packets import Arrival, Drop, Packet
from sim_backends.world.motion import State


class FederateError(FieldkitError):
    """A federate or program failed or returned an invalid answer; the message names it, the time and the request."""


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
    seconds, nanoseconds = divmod(time_ns, 10**9)
    return f"{seconds}.{nanoseconds:09d}".rstrip("0").rstrip(".") + " s"


def advance_text(from_ns: int, to_ns: int) -> str:
    """Return the text of a request to advance; the start is omitted unless it is before the end."""
    start = f" from {seconds_text(from_ns)}" if from_ns < to_ns else ""
    return f"advance{start} to {seconds_text(to_ns)}"


class PhysicsFederate(Protocol):
    """A physics simulator: it moves the agents.

    If an attribute `agents_disappear` is True, an agent may be missing in the states: it has disappeared, and may
    appear again. Otherwise the run ends with an error if an agent is missing.

    If it has an attribute `path_losses_db`, with mean losses in dB by transmitter and receiver, the radio of the
    built-in network uses these instead of the losses of the world.

    Attributes:
        step_ns: Time step; there are states at whole steps only.
        limits_m_s2: Largest change of each agent's velocity per second, in m/s^2; `math.inf` if unknown. Only the
            sync policy `error_bounded` uses it. If a value is too small, position errors may exceed the bound of this
            policy; if it is infinity, more exchanges are needed. The mapping is read once; its values may change
            during the run.
    """

    step_ns: int
    limits_m_s2: Mapping[str, float]

    def advance(self, to_ns: int, commands: Mapping[str, Any]) -> Mapping[str, State]:
        """Return the state of each agent at the last step that is not after `to_ns`.

        Args:
            to_ns: Time to advance to.
            commands: Command of each agent's program to its body. It applies from the time of the previous call; an
                agent without a command keeps its last command.
        """
        ...


class NetworkFederate(Protocol):
    """A network simulator: it carries the packets of the agents.

    If agents forward or interfere, an attribute `transmitters` has their names; if objects that are not agents
    interfere, an attribute `fixed_emitters_m` has their positions. The sync policy `error_bounded` and the position
    errors of a run include them.
    """

    def advance(
        self, to_ns: int, packets: Sequence[Packet], states: Mapping[str, State]
    ) -> tuple[list[Arrival], list[Drop]]:
        """Simulate up to `to_ns`, and return the arrivals and drops in order of time.

        A network that supports dead reckoning has an attribute `extrapolates` that is True. Then `states` may be
        `DeadReckoned`, and the network evaluates them at the time of each event.

        Args:
            to_ns: Time to advance to.
            packets: Packets that enter the network up to `to_ns`, in order of `enters_ns`.
            states: Positions and velocities of the agents that the network assumes from now on. An agent without a
                state is absent, and neither sends nor receives; the coordinator drops its packets.
        """
        ...

    def next_event_ns(self) -> int | None:
        """Return a lower bound of the time of the next event without new packets, or None if there is no event.

        Before this time, no packet arrives or is dropped, and no position is used.
        """
        ...
