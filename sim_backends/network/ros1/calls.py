"""Calls between nodes and their master by XML-RPC: requests and answers over TCP, and trying again."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

from sim_backends.network.ros1.streams import TcpStreams
from sim_backends.network.wire import Wire


@dataclass(frozen=True, slots=True)
class CallAnswer:
    """What a call is answered.

    Attributes:
        size_bytes: Of the answer.
        told: What the caller does when it has it.
    """

    size_bytes: int
    told: Callable[[], None]


@dataclass(frozen=True, slots=True)
class CallRetry:
    """When a call is tried again whose connection was given up.

    Attributes:
        first_ns: After how long at first; each time after twice as long.
        longest_ns: But never longer than this.
    """

    first_ns: int
    longest_ns: int


class RemoteCalls:
    """Makes calls. One without an answer stays open until a connection is given up, its own or that of the answer.

    Args:
        wire: Keeps the time.
        streams: What calls go over. A host keeps its connection to another, but for calls that have their own.
    """

    def __init__(self, wire: Wire, streams: TcpStreams) -> None:
        self._wire = wire
        self._streams = streams

    def call(
        self,
        caller: str,
        callee: str,
        size_bytes: int,
        serve: Callable[[], CallAnswer],
        retry: CallRetry | None,
        *,
        about: str = "",
    ) -> None:
        """Call from one host to another.

        Args:
            caller: Who calls.
            callee: Who is called.
            size_bytes: Of the request.
            serve: What the callee does, which gives the answer; a call that is tried again may be served twice.
            retry: When it is tried again; None for never.
            about: What it is about, if it has a connection of its own.
        """
        connection = f"xmlrpc {caller} {callee} {about}".rstrip()

        def fail(reason: str) -> None:  # noqa: ARG001 (see Lost)
            if retry is not None:
                later = CallRetry(min(2 * retry.first_ns, retry.longest_ns), retry.longest_ns)
                again = partial(self.call, caller, callee, size_bytes, serve, later, about=about)
                self._wire.at(self._wire.now_ns + retry.first_ns, caller, again)

        def arrive() -> None:
            answer = serve()
            self._streams.send((callee, caller), connection, answer.size_bytes, answer.told, fail, back=True)

        self._streams.send((caller, callee), connection, size_bytes, arrive, fail)
