"""Federates that have a name, for example `mujoco`: simulators of installed packages, declared as entry points."""

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
        command: Builds the program if necessary, and returns its command line. It raises `ConfigurationError` if
            required software is not installed; the remedy is the command that installs the software.
        summary: Description in one line.
        options: Model of its options in a scenario; None to accept any options without validation.
        writes_captures: True for a network that writes captures with the settings `captures` of its configuration.
        is_single_threaded: True if it has only one thread, and computes only during requests. It then shares the
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
    """A federate that is a Python class. A run uses the class in the process of the coordinator.

    Attributes:
        role: `PHYSICS` or `NETWORK`.
        load: Imports the simulator, and returns the class with its properties. It raises `ConfigurationError` if
            required software is not installed; the remedy is the command that installs the software.
        summary: Description in one line.
        options: Model of its options in a scenario; None to accept any options without validation.
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
    return {entry_point.name: _load(entry_point) for entry_point in plugins.entry_points(plugins.FEDERATES)}


def named_federate(endpoint: str, role: int) -> NamedFederate | None:
    """Return the federate with a name; None if `endpoint` is a command or an address.

    Args:
        endpoint: A name, command or address.
        role: The expected role.

    Raises:
        ConfigurationError: The package of the federate cannot be loaded, or the federate has another role.
    """
    entry_points = plugins.entry_points(plugins.FEDERATES)
    entry_point = next((candidate for candidate in entry_points if candidate.name == endpoint), None)
    if entry_point is None:
        return None
    federate = _load(entry_point)
    if federate.role != role:
        raise ConfigurationError(
            f"{endpoint} is a {ROLES[federate.role]} federate, not a {ROLES[role]} federate",
            remedy=f"use --{ROLES[federate.role]} {endpoint}",
        )
    return federate


def default_options(endpoint: str, role: int) -> dict[str, Any]:
    """Return the default options of the federate with a name.

    The result is empty if the federate declares no options, or if `endpoint` is a command or an address.

    Raises:
        ConfigurationError: The package of the federate cannot be loaded, or the federate has another role.
    """
    federate = named_federate(endpoint, role)
    return {} if federate is None or federate.options is None else federate.options().to_json()


def _load(entry_point: EntryPoint) -> NamedFederate:
    federate = plugins.load(entry_point)
    if isinstance(federate, NamedFederate):
        return federate
    raise ConfigurationError(
        "it is not a ProgramFederate or PythonFederate", where=plugins.location(entry_point), remedy=plugins.REMEDY
    )


def is_single_threaded(endpoint: str, role: int) -> bool:
    """Return True if `endpoint` is the name of a program that declares one thread, otherwise False.

    Raises:
        ConfigurationError: The package of the federate cannot be loaded, or the federate has another role.
    """
    federate = named_federate(endpoint, role)
    return isinstance(federate, ProgramFederate) and federate.is_single_threaded


def command_line(endpoint: str, role: int) -> str:
    """Return the command that starts the federate with a name, or `endpoint` itself if it is a command or an address.

    Raises:
        ConfigurationError: The federate cannot be used, then the remedy states how to install the missing software;
            or there is neither a federate nor a program with this name.
    """
    federate = named_federate(endpoint, role)
    if isinstance(federate, ProgramFederate):
        return federate.command()
    if isinstance(federate, PythonFederate):
        federate.load()
        return shlex.join((sys.executable, "-P", "-m", "sim_backends.federates.serve_named", ROLES[role], endpoint))
    if _WORD.fullmatch(endpoint) and shutil.which(endpoint) is None:
        names = [entry_point.name for entry_point in plugins.entry_points(plugins.FEDERATES)]
        choices = f"simulators: {', '.join(names)}; or a command, or an address: fieldkit docs federates"
        raise ConfigurationError(
            f"there is no {ROLES[role]} federate and no program with the name {endpoint!r}",
            remedy=did_you_mean(endpoint, names, choices),
        )
    return endpoint
