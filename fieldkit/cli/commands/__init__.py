"""All commands with their help lines. A command has a module with its name: `add` declares arguments, `run` runs it.

Commands that list items share the module `listings`, with a pair of functions for each, such as `add_robots`.
A module is imported when its command is used. Slow imports are inside of the functions that need them, so that help
and Tab completion do not wait for them.
"""

from collections.abc import Callable, Mapping
from functools import partial
from importlib import import_module
from types import MappingProxyType
from typing import Final

from fieldkit.cli.parser import Commands, Parser, add_plugin_command, plugin_targets

COMMANDS: Final[Mapping[str, str]] = MappingProxyType(
    {
        "init": "write a commented site file",
        "enroll": "pin a robot's host key in the site file",
        "check": "check everything that a trial needs",
        "clocks": "list the clocks of all robots with their time sources",
        "trial": "run a procedure at one or more distances",
        "campaign": "run the trials of a campaign file, or continue them",
        "resume": "continue a trial that stopped",
        "stop": "immediately stop robots that fieldkit moves",
        "abort": "terminate all jobs of fieldkit on the robots and remove their locks",
        "lab": "start emulated robots on this machine for experiments",
        "aggregate": "aggregate the repeats of many trials, with intervals",
        "compare": "compare two runs, for example field and simulation, or before and after",
        "report": "write one page of figures and tables of trials",
        "export": "write trials for pandas, R or Foxglove",
        "bag": "inspect, check, repair and convert bags of ROS 1 and ROS 2",
        "middleware": "recommend a middleware's configuration from measured trials",
        "bridge": "forward topics between ROS 1, DDS and Zenoh",
        "robots": "list robots, or show NAME",
        "procedures": "list procedures, or show NAME",
        "columns": "list the CSV columns, those of PROCEDURE, or show NAME",
        "positions": "set measured positions of robots from GPX or CSV, or list their sources",
        "rebuild": "write trial.csv and summary.csv again from raw evidence",
        "verify": "compare a trial's files with its manifest",
        "docs": "open this documentation in a browser, offline",
        "completion": "print a shell script for Tab completion",
    }
)
"""The help lists the commands in this order."""
LISTINGS: Final = ("robots", "procedures", "columns")
"""Commands in the module `listings`."""

FROM_ENTRY_POINTS: Final = frozenset({"bag", "bridge", "middleware", "stop"})
"""Commands whose modules are found by entry points (`plugin_targets`).

The help omits a command whose entry point is not installed.
"""


def add_all(commands: Commands) -> None:
    """Add a parser for each command. Its arguments are declared at first use."""
    installed = plugin_targets()
    for name, help_line in COMMANDS.items():
        if name in FROM_ENTRY_POINTS:
            if name in installed:
                add_plugin_command(commands, name, installed[name], help_line)
            continue
        parser: Parser = commands.add_parser(name, help=help_line)
        parser.declare = partial(_declare, name)


def _declare(name: str, parser: Parser) -> None:
    if name in LISTINGS:
        add: Callable[[Parser], None] = getattr(import_module(f"{__name__}.listings"), f"add_{name}")
    else:
        add = import_module(f"{__name__}.{name}").add
    add(parser)
