"""Every command with its help line; what it takes is in `cli.arguments`, what runs it in a module here.

Both are imported when they are needed, and the first without the second: Python imports what a module names at its
top, which is half a second for some commands, and neither help nor the Tab key shall pay for it.
"""

import argparse
from collections.abc import Callable, Mapping
from functools import partial
from importlib import import_module
from types import MappingProxyType
from typing import Final

from fieldkit.cli.parser import Commands, Parser

COMMANDS: Final[Mapping[str, str]] = MappingProxyType(
    {
        "init": "write a commented site file",
        "enroll": "pin a robot's host key in the site file",
        "check": "look at everything that a trial needs",
        "trial": "run a procedure at one or more distances",
        "campaign": "run the trials of a campaign file, or go on with them",
        "resume": "go on with a trial that stopped",
        "abort": "end every job of fieldkit on the robots and break their locks",
        "lab": "bring robots up on this machine to play with",
        "aggregate": "put the repeats of many trials together, with intervals",
        "compare": "compare two runs: field against simulation, or before and after",
        "report": "make one page of figures and tables from trials",
        "export": "write trials for pandas, R or Foxglove",
        "bag": "look into bags of ROS 1 and ROS 2, check, repair and convert them",
        "bridge": "carry topics between ROS 1, DDS and Zenoh",
        "robots": "list robots, or show NAME",
        "procedures": "list procedures, or show NAME",
        "columns": "list the CSV columns, those of PROCEDURE, or show NAME",
        "positions": "say where robots really stood, from GPX or CSV, or list who tells it",
        "rebuild": "make trial.csv and summary.csv again from raw evidence",
        "verify": "compare a trial's files with its manifest",
        "completion": "print what completes fieldkit's words in a shell",
    }
)
"""In the order in which the help lists them."""


def add_all(commands: Commands) -> None:
    """Add a parser for each command; it learns what it takes when it is used first."""
    for name, meaning in COMMANDS.items():
        parser: Parser = commands.add_parser(name, help=meaning)
        parser.declare = partial(_declare, name)


def load(target: str) -> Callable[[argparse.Namespace], int]:
    """Return the function that runs a command, `module:function`."""
    module, _, function = target.partition(":")
    run: Callable[[argparse.Namespace], int] = getattr(import_module(f"{__name__}.{module}"), function)
    return run


def _declare(name: str, parser: Parser) -> None:
    import_module(f"fieldkit.cli.arguments.{name}").add(parser)
