"""Conformance checks of both roles: handshake, ping, rejected requests, end of a session, undeclared forks."""

from sim_backends.federates.conformance.probe import CheckError, NotDeclaredError, Target
from sim_backends.federates.exchanges import encode_fork
from sim_backends.federates.frames import MessageKind
from sim_backends.federates.handshake import FederateCapability
from sim_backends.federates.records import COMMAND_TYPES


def check_handshake(target: Target) -> None:
    """The handshake: name, step, types of commands and transmitters are valid."""
    welcome = target.open().welcome
    if not welcome.name:
        raise CheckError("welcome has no name")
    unknown_types = set(welcome.commands) - set(COMMAND_TYPES)
    if unknown_types:
        raise CheckError(f"welcome has unknown types of commands: {sorted(unknown_types)}")
    if any(index >= len(target.hello.agents) for index in welcome.transmitters):
        raise CheckError(f"welcome has transmitters that are not agents: {list(welcome.transmitters)}")


def check_ping(target: Target) -> None:
    """A ping is answered with its value."""
    probe = target.open()
    for value in (0, 1, (1 << 62) + 5):
        if (answer := probe.ping(value)) != value:
            raise CheckError(f"the ping {value} was answered with {answer}")


def check_malformed(target: Target) -> None:
    """A frame that ends too early is refused with an error."""
    kind, answer_kind = (
        (MessageKind.ADVANCE_PHYSICS, MessageKind.STATES)
        if target.is_physics
        else (MessageKind.ADVANCE_NETWORK, MessageKind.OUTCOMES)
    )
    target.open().expect_error(kind, bytes(9), answer_kind, "a frame that ends too early")


def check_counts(target: Target) -> None:
    """A count that is larger than the frame is refused with an error."""
    bytes_before_count, kind, answer_kind = (
        (16, MessageKind.ADVANCE_PHYSICS, MessageKind.STATES)
        if target.is_physics
        else (24, MessageKind.ADVANCE_NETWORK, MessageKind.OUTCOMES)
    )
    target.open().expect_error(
        kind, bytes(bytes_before_count) + b"\xff" * 4, answer_kind, "a count that is larger than the frame"
    )


def check_fork_absence(target: Target) -> None:
    """A federate that does not declare fork refuses a request to fork."""
    probe = target.open()
    if probe.has(FederateCapability.FORK):
        raise NotDeclaredError("it declares FORK")
    probe.expect_error(MessageKind.FORK, encode_fork(1), MessageKind.DONE, "fork, which it does not declare")


def check_bye(target: Target) -> None:
    """The federate closes the connection after bye."""
    target.open().end()
