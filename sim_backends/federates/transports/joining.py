"""The message `join`: the first message of a federate that connects to a listening coordinator. It has the token."""

import time
from typing import Final

from sim_backends.federates.channels import ClosedError, DeadlineError, FrameChannel
from sim_backends.federates.frames import MAX_JOIN_BYTES, MalformedFrameError, MessageKind, encode
from sim_backends.federates.handshake import decode_join, encode_join
from sim_backends.federates.transports.contract import TransportAddress, is_same_token

_JOIN_S: Final = 5.0
"""Longest wait for the first message of a connection, which may come from any program."""


def accept_federate(address: TransportAddress, expected_token: str, deadline_s: float) -> FrameChannel:
    """Return the channel of a federate that begins with `join` and the token; other channels are closed.

    Args:
        address: Address at which to listen.
        expected_token: The token.
        deadline_s: Time of `time.monotonic` until which to wait.

    Raises:
        ConfigurationError: The address cannot be used.
        DeadlineError: No federate with this token has connected; the message contains the reason of the last
            rejection.
    """
    rejection = ""
    with address.listen() as listener:
        while True:
            try:
                channel = listener.accept(deadline_s)
            except DeadlineError as error:
                raise DeadlineError(f"no federate has connected to {address}{rejection}") from error
            try:
                frame = channel.receive(min(deadline_s, time.monotonic() + _JOIN_S), MAX_JOIN_BYTES)
                if frame.header.kind is MessageKind.JOIN and is_same_token(decode_join(frame.body), expected_token):
                    return channel
                rejection = " (a program without the right token was rejected)"
            except (ClosedError, DeadlineError, MalformedFrameError) as error:
                rejection = f" (a connection was rejected: {error})"
            channel.close()


def join(channel: FrameChannel, token: str, deadline_s: float) -> None:
    """Send the first message of a federate that has connected."""
    channel.send(encode(MessageKind.JOIN, 0, 0, encode_join(token)), deadline_s)
