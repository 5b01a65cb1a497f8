"""`fieldkit lab`: robots to play with, on this machine, as long as one likes."""

import argparse
import os
import shutil
import sys
from contextlib import suppress
from pathlib import Path
from typing import Final

from fieldkit.backends.registry import load_backend
from fieldkit.cli import options
from fieldkit.cli.display import show_error, show_note, table
from fieldkit.config.site import Site, SiteRobot
from fieldkit.core import files
from fieldkit.core.errors import ConfigurationError, FieldkitError
from fieldkit.core.events import Event, Note
from fieldkit.core.model import Vector
from fieldkit.core.units import format_count, format_duration, parse_offset_m
from fieldkit.lab import background, client, folder, protocol, server
from fieldkit.lab.folder import LabFolder
from fieldkit.lab.protocol import Destination, Lab, LabBackend, Overview

_EXAMPLE: Final = "fieldkit lab move ROBOT --to 20m 10m, or --by 0m -30ft, and 5m for UP where it flies"
_NEXT: Final = "fieldkit lab ps | shell ROBOT | move ROBOT | ssh-config | down"


def up(arguments: argparse.Namespace) -> int:
    """Bring the robots up; return at once, or when they are down."""
    here, backend = folder.of_directory(Path.cwd()), _backend(arguments)

    def stay(robots: Lab) -> None:
        print(f"{format_count(len(robots.members), 'robot')} up, until Ctrl-C", flush=True)

    if arguments.foreground:
        server.run(here, backend, seed=arguments.seed, sink=_tell, ready=stay)
        return 0

    def work(leave: background.Leave) -> int:
        def ready(robots: Lab) -> None:
            print(f"{format_count(len(robots.members), 'robot')} up; next: {_NEXT}")
            leave(here.log)

        try:
            server.run(here, backend, seed=arguments.seed, sink=_tell, ready=ready)
        except FieldkitError as error:
            show_error(str(error))
            return error.exit_code
        return 0

    return background.detached(work)


def list_robots(_: argparse.Namespace) -> int:
    """List the robots."""
    state = client.state(_here())
    rows = [
        (
            robot.name,
            robot.profile,
            ", ".join(robot.roles),
            robot.address,
            _place(robot.place_m),
            ", ".join(robot.programs) or "ended",
        )
        for robot in state.robots
    ]
    table(("robot", "profile", "roles", "address", "east, north, up (m)", "runs"), rows)
    print(f"up for {format_duration(state.up_s)}, pid {state.pid}")
    return 0


def move(arguments: argparse.Namespace) -> int:
    """Move the robot and say where it is."""
    relative = arguments.to is None
    option, words = ("--by", arguments.by) if relative else ("--to", arguments.to)
    if len(words) not in {2, 3}:
        raise ConfigurationError(f"{option} takes EAST NORTH [UP], not {' '.join(words)!r}", remedy=_EXAMPLE)
    east_m, north_m, *up_m = map(parse_offset_m, words)
    to = Destination(east_m, north_m, up_m[0] if up_m else None, relative)
    place_m = client.move(_here(), arguments.robot, to)
    print(f"{arguments.robot} is at {_place(place_m)} (m east, north, up)")
    return 0


def shell(arguments: argparse.Namespace) -> int:
    """Become ssh."""
    here = _here()
    names = [robot.name for robot in client.state(here).robots]
    if arguments.robot not in names:
        raise protocol.unknown_robot(arguments.robot, names)
    program = shutil.which("ssh")
    if program is None:
        raise ConfigurationError("there is no ssh", remedy="sudo apt-get install openssh-client")
    terminal = ["-t"] if arguments.command and sys.stdin.isatty() and sys.stdout.isatty() else []
    argv = [program, "-F", str(here.ssh_config), *terminal, arguments.robot, *arguments.command]
    os.execv(program, argv)  # noqa: S606 (its own words, no shell)


def print_ssh_config(_: argparse.Namespace) -> int:
    """Print the configuration."""
    here = _here()
    client.state(here)
    print(here.ssh_config.read_text(encoding="utf-8"), end="")
    return 0


def down(_: argparse.Namespace) -> int:
    """End the robots."""
    client.end(_here())
    print("the robots are down")
    return 0


def plot(arguments: argparse.Namespace) -> int:
    """Draw the lab."""
    # matplotlib takes half a second to import, which no other command shall pay.
    from fieldkit.report import figures, theme  # noqa: PLC0415

    out: Path = arguments.out
    form = theme.format_of(out, "--out")
    files.write(out, figures.overview(_overview(arguments), form))
    print(out)
    return 0


def _place(place_m: Vector) -> str:
    """Return a place for people, to the centimetre: `198.5, 200, 0.2`."""
    return ", ".join(f"{round(metres, 2):.10g}" for metres in place_m)


def _overview(arguments: argparse.Namespace) -> Overview:
    """Return the lab that is up; what `up` would bring up if none is, or if the options say which robots."""
    if arguments.robots is None and arguments.site is None and arguments.backend is None:
        with suppress(client.NoLabError):
            return client.overview(_here())
    return _backend(arguments).overview()


def _here() -> LabFolder:
    return folder.of_directory(Path.cwd())


def _backend(arguments: argparse.Namespace) -> LabBackend:
    """Return what brings up the robots that the options choose."""
    site, document = options.lab_site(arguments)
    name = arguments.backend or options.DEFAULT_BACKEND
    if arguments.robots is not None:
        if arguments.robots < 1:
            raise ConfigurationError("--robots: a lab has at least one", remedy="fieldkit lab up --robots 2")
        robots = {
            f"robot-{number}": SiteRobot(profile=arguments.profile) for number in range(1, arguments.robots + 1)
        }
        site = (
            Site(robots=robots, roles={}) if site is None else site.model_copy(update={"robots": robots, "roles": {}})
        )
    return protocol.of(name, load_backend(name, site, document))


def _tell(event: Event) -> None:
    if isinstance(event, Note):
        show_note(event.text)
