"""Serves a physics or network class to a coordinator: the federate's side of the protocol."""

import os
import time
from contextlib import closing
from typing import Any, Final

from sim_backends.federates.answering import FederateService, MakeFederate, serve_channel
from sim_backends.federates.channels import DeadlineError, StreamChannel
from sim_backends.federates.transports.contract import TransportAddress, read_token
from sim_backends.federates.transports.joining import join
from sim_backends.federates.transports.transport_table import FORMS, parse_address

_CONNECT_S: Final = 60.0
"""Longest wait until the coordinator listens."""
_HELLO_S: Final = 10.0
"""Maximum wait for the first message after a program connects; other programs are queued meanwhile."""


def serve(make: MakeFederate, *, address: str | None = None, runs: int | None = None, **properties: Any) -> None:  # noqa: ANN401 (see `FederateService`)
    """Serve a physics or network class.

    Args:
        make: The class of the federate, or a function that returns a federate. It is called with the `Hello` of each
            run.
        address: None for standard input and output, which then carry only frames; everything that the federate prints
            goes to standard error. Otherwise an address of a transport (`transports.transport_table`).
        runs: Number of runs after which to return; None means one run if this side does not listen, otherwise no
            limit. Over standard input and output there is always one run.
        **properties: Other attributes of `FederateService`.

    Raises:
        ConfigurationError: The address is invalid or cannot be used, or the token is missing.
        SystemExit: The last run failed, no coordinator or ROS master answered in time, or standard input is a
            terminal.
        ValueError: The address does not begin with the scheme of a transport.
    """
    serve_service(FederateService(make, **properties), address=address, runs=runs)


def serve_service(service: FederateService, *, address: str | None = None, runs: int | None = None) -> None:
    """Serve a federate that is declared with its properties.

    Arguments and errors are those of `serve`.
    """
    transport_address = None if address is None else parse_address(address)
    if address is not None and transport_address is None:
        raise ValueError(f"{address!r} is not an address; use {', '.join(FORMS)}")
    if transport_address is None:
        with closing(_standard_channel()) as channel:
            succeeded = serve_channel(channel, service)
    elif transport_address.listens is not False:
        succeeded = _listen(transport_address, service, runs)
    else:
        succeeded = _connect(transport_address, service, 1 if runs is None else runs)
    if not succeeded:
        raise SystemExit(1)


def _listen(address: TransportAddress, service: FederateService, runs: int | None) -> bool:
    token = read_token(address)
    succeeded, finished_runs = True, 0
    try:
        with address.listen() as listener:
            while runs is None or finished_runs < runs:
                with closing(listener.accept(None)) as channel:
                    succeeded = serve_channel(channel, service, token, _HELLO_S)
                finished_runs += 1
    except DeadlineError as error:  # only the transport over ROS 1 raises it, if the master does not answer
        raise SystemExit(str(error)) from error
    return succeeded


def _connect(address: TransportAddress, service: FederateService, runs: int) -> bool:
    token = read_token(address)
    succeeded = True
    for _ in range(runs):
        deadline_s = time.monotonic() + _CONNECT_S
        try:
            channel = address.connect(deadline_s)
        except DeadlineError as error:
            raise SystemExit(str(error)) from error
        with closing(channel):
            join(channel, token, deadline_s)
            succeeded = serve_channel(channel, service, token)
    return succeeded


def _standard_channel() -> StreamChannel:
    """Return the channel over standard input and output, and redirect both, so that no other code uses the channel.

    Raises:
        SystemExit: Standard input is a terminal.
    """
    if os.isatty(0):
        raise SystemExit("this program is a federate: fieldkit cosim run SCENARIO --physics COMMAND starts it")
    channel = StreamChannel(os.dup(0), os.dup(1))
    null = os.open(os.devnull, os.O_RDONLY)
    os.dup2(null, 0)
    os.close(null)
    os.dup2(2, 1)
    return channel
