"""The options that say which trial is meant, and the request that they make."""

import argparse
from typing import Final

from fieldkit.core.errors import ConfigurationError
from fieldkit.core.model import Distance, Protocol, Topology
from fieldkit.core.units import parse_duration_s
from fieldkit.trial.procedure import load_procedure
from fieldkit.trial.request import Request

_PROTOCOL_HELP: Final = "may be given more than once (default: the procedure's)"


def add(parser: argparse.ArgumentParser) -> None:
    """Add the options that change what the procedure says."""
    parser.add_argument("--topology", choices=[str(one) for one in Topology], help="default: the procedure's")
    parser.add_argument("--protocol", action="append", choices=[str(one) for one in Protocol], help=_PROTOCOL_HELP)
    parser.add_argument("--repeats", type=positive, metavar="N", help="per protocol (default: the procedure's)")
    parser.add_argument("--record", metavar="DURATION", help="length of every recording, for example 2s")


def request(arguments: argparse.Namespace, distance: Distance, *, seed: int = 1, notes: str = "") -> Request:
    """Return what the operator asked for at one distance.

    Raises:
        ConfigurationError: There is no such procedure, or the recording has no length.
    """
    record_s = None if arguments.record is None else parse_duration_s(arguments.record)
    if record_s == 0:
        raise ConfigurationError("a recording of 0 s records nothing", remedy="write for example --record 2s")
    return Request(
        procedure=load_procedure(arguments.procedure),
        distance=distance,
        topology=None if arguments.topology is None else Topology(arguments.topology),
        protocols=tuple(dict.fromkeys(Protocol(one) for one in arguments.protocol or ())),
        repeats=arguments.repeats,
        record_s=record_s,
        seed=seed,
        notes=notes,
    )


def natural(text: str) -> int:
    """Return a whole number from 0; argparse tells what is none."""
    if not text.isascii() or not text.isdigit():
        raise argparse.ArgumentTypeError(f"{text!r} is no whole number from 0")
    return int(text)


def positive(text: str) -> int:
    """Return a whole number from 1; argparse tells what is none."""
    if natural(text) < 1:
        raise argparse.ArgumentTypeError("must be at least 1")
    return int(text)
