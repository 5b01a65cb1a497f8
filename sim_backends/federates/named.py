"""Federates that have a name, for example `mujoco`: installed simulators, found by their entry points."""

import re
import shlex
import shutil
import sys
from collections.abc import Callable
from dataclasses import dataclass
from importlib.metadata import EntryPoint
from typing import Any, Final

from fieldkit.core import plugins
from fieldkit.core.errors import ConfigurationError, did_you_mean
from sim_backends.federates.answering import FederateService
from sim_backends.federates.frames import ROLES
from sim_backends.federates.simulator_options import SimulatorOptions

_WORD: Final = re.compile(r"[\w.-]+")


@dataclass(frozen=True)
class ProgramFederate:
    """A federate that is a program.

    Attributes:
        role: `PHYSICS` or `NETWORK`.
        command: Returns its command line; it builds the program first if necessary. It raises `ConfigurationError` if
            something is not installed; the remedy is the command that installs it.
        summary: What it is, in one line.
        options: Model of its options in a scenario; None if it has any options, which are not validated.
        writes_captures: True for a network that writes the captures that `captures` of its configuration describes.
        is_single_threaded: True if it has one thread, which computes only during requests. It then shares the
            processor of the coordinator (`ProcessorSharing`).
    """

    role: int
    command: Callable[[], str]
    summary: str = ""
    options: type[SimulatorOptions] | None = None
    writes_captures: bool = False
    is_single_threaded: bool = False


@dataclass(frozen=True)
class PythonFederate:
    """A federate that is a Python class. A run uses it in its own process.

    Attributes:
        role: `PHYSICS` or `NETWORK`.
        load: Imports the simulator, and returns the class with its properties. It raises `ConfigurationError` if
            something is not installed; the remedy is the command that installs it.
        summary: What it is, in one line.
        options: As for `ProgramFederate`.
    """

    role: int
    load: Callable[[], FederateService]
    summary: str = ""
    options: type[SimulatorOptions] | None = None


NamedFederate = ProgramFederate | PythonFederate
"""Target of an entry point of the group `fieldkit.federates`."""


def federates() -> dict[str, NamedFederate]:
    """Return all federates by name; simulators are not imported.

    Raises:
        ConfigurationError: The package of a federate cannot be loaded.
    """
    return {point.name: _load(point) for point in plugins.entry_points(plugins.FEDERATES)}


def named_federate(where: str, role: int) -> NamedFederate | None:
    """Return the federate with a name; None if `where` is a command or an address.

    Args:
        where: A name, command or address.
        role: The expected role.

    Raises:
        ConfigurationError: The package of the federate cannot be loaded, or the federate has another role.
    """
    point = next((point for point in plugins.entry_points(plugins.FEDERATES) if point.name == where), None)
    if point is None:
        return None
    federate = _load(point)
    if federate.role != role:
        raise ConfigurationError(
            f"{where} is a {ROLES[federate.role]}, not a {ROLES[role]}",
            remedy=f"use --{ROLES[federate.role]} {where}",
        )
    return federate


def default_options(where: str, role: int) -> dict[str, Any]:
    """Return the default options of the federate with a name; empty if `where` is a command or an address.

    Raises:
        ConfigurationError: As for `named_federate`.
    """
    federate = named_federate(where, role)
    return {} if federate is None or federate.options is None else federate.options().to_json()


def _load(point: EntryPoint) -> NamedFederate:
    federate = plugins.load(point)
    if isinstance(federate, NamedFederate):
        return federate
    raise ConfigurationError(
        "it is not a ProgramFederate or PythonFederate", where=plugins.location(point), remedy=plugins.REMEDY
    )


def is_single_threaded(where: str, role: int) -> bool:
    """Return True if `where` is the name of a program that declares one thread; False for a command or an address.

    Raises:
        ConfigurationError: As for `named_federate`.
    """
    federate = named_federate(where, role)
    return isinstance(federate, ProgramFederate) and federate.is_single_threaded


def command_line(where: str, role: int) -> str:
    """Return the command that starts the federate with a name, or `where` itself if it is a command or an address.

    Raises:
        ConfigurationError: The federate cannot be used; the remedy states how to install what is missing.
    """
    federate = named_federate(where, role)
    if isinstance(federate, ProgramFederate):
        return federate.command()
    if isinstance(federate, PythonFederate):
        federate.load()
        return shlex.join((sys.executable, "-P", "-m", "sim_backends.federates", ROLES[role], where))
    if _WORD.fullmatch(where) and shutil.which(where) is None:
        names = [point.name for point in plugins.entry_points(plugins.FEDERATES)]
        choices = f"simulators: {', '.join(names)}; or a command, or an address: fieldkit docs federates"
        raise ConfigurationError(
            f"there is no {ROLES[role]} and no program {where!r}", remedy=did_you_mean(where, names, choices)
        )
    return where
