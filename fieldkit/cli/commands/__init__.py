"""Every command with its help line, in a module of its name: `add` declares its arguments, `run` runs it.

A module is imported when its command is named. What takes long to import is imported by the function that needs
it, because neither help nor the Tab key may wait for it.
"""

from collections.abc import Mapping
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
        "stop": "stop robots that move by themselves, now",
        "abort": "end every job of fieldkit on the robots and break their locks",
        "lab": "bring robots up on this machine to play with",
        "aggregate": "put the repeats of many trials together, with intervals",
        "compare": "compare two runs: field against simulation, or before and after",
        "report": "make one page of figures and tables from trials",
        "export": "write trials for pandas, R or Foxglove",
        "bag": "look into bags of ROS 1 and ROS 2, check, repair and convert them",
        "middleware": "recommend a middleware's configuration from measured trials",
        "bridge": "carry topics between ROS 1, DDS and Zenoh",
        "robots": "list robots, or show NAME",
        "procedures": "list procedures, or show NAME",
        "columns": "list the CSV columns, those of PROCEDURE, or show NAME",
        "positions": "say where robots really stood, from GPX or CSV, or list who tells it",
        "rebuild": "make trial.csv and summary.csv again from raw evidence",
        "verify": "compare a trial's files with its manifest",
        "docs": "open this documentation in a browser, without a network",
        "completion": "print what completes fieldkit's words in a shell",
    }
)
"""In the order in which the help lists them."""


def add_all(commands: Commands) -> None:
    """Add a parser for each command; it learns what it takes when it is used first."""
    for name, meaning in COMMANDS.items():
        parser: Parser = commands.add_parser(name, help=meaning)
        parser.declare = partial(_declare, name)


def _declare(name: str, parser: Parser) -> None:
    import_module(f"{__name__}.{name}").add(parser)
