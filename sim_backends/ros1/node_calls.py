"""Calls between ROS 1 nodes and their master: XML-RPC with timeouts.

Sources: wiki.ros.org/ROS/Master_API, wiki.ros.org/ROS/Slave_API.
"""

import http.client
import threading
from contextlib import suppress
from typing import Any, Final
from xmlrpc.client import Error as XmlRpcError
from xmlrpc.client import ServerProxy, Transport
from xmlrpc.server import SimpleXMLRPCRequestHandler, SimpleXMLRPCServer

from typing_extensions import override

SUCCESS: Final = 1
FAILURE: Final = 0
"""Statuses of a successful and of a failed call."""
CALL_S: Final = 5.0
"""Timeout of a call."""


class MasterError(ConnectionError):
    """A master or node refused a call."""


class _TimedTransport(Transport):
    """Calls of XML-RPC with a time limit."""

    def make_connection(self, host: Any) -> http.client.HTTPConnection:  # noqa: ANN401 (of the base class)
        connection = super().make_connection(host)
        connection.timeout = CALL_S
        return connection


class RosNodeRequests(SimpleXMLRPCRequestHandler):
    """Accepts the calls of masters and of other nodes."""

    rpc_paths = ("/", "/RPC2")
    timeout = CALL_S


class RosNodeServer(SimpleXMLRPCServer):
    """The XML-RPC server of a node; each call has its own thread, so that a slow call does not delay others."""

    @override
    def process_request(self, request: Any, client_address: Any) -> None:
        threading.Thread(target=self._process, args=(request, client_address), daemon=True).start()

    def _process(self, request: Any, client_address: Any) -> None:  # noqa: ANN401 (of the base class)
        with suppress(OSError, ValueError):
            self.finish_request(request, client_address)
        self.shutdown_request(request)


def call(uri: str, method: str, *arguments: object) -> Any:  # noqa: ANN401 (a value of XML-RPC)
    """Call a method of a master or node, and return the value of its answer.

    Raises:
        OSError: The master or node cannot be reached.
        MasterError: The master or node refused the call, or its answer is not valid in ROS 1.
    """
    try:
        answer = getattr(ServerProxy(uri, transport=_TimedTransport()), method)(*arguments)
        status, message, value = answer
    except (XmlRpcError, http.client.HTTPException, TypeError, ValueError) as error:
        raise MasterError(f"{uri} gave no valid answer to {method}: {error}") from error
    if status != SUCCESS:
        raise MasterError(f"{uri} refused {method}: {message}")
    return value
