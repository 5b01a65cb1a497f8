"""`fieldkit lab`: robots to play with, on this machine, as long as one likes."""

import argparse
import os
import shutil
import sys
from contextlib import suppress
from pathlib import Path
from typing import Final

from fieldkit.backends.registry import load_backend
from fieldkit.cli import lab_move, session
from fieldkit.cli.display import show_error, show_note, table
from fieldkit.cli.listing import Commands
from fieldkit.config.profiles import Site, SiteRobot
from fieldkit.core import files
from fieldkit.core.errors import ConfigurationError, FieldkitError
from fieldkit.core.events import Event, Note
from fieldkit.core.units import format_count, format_duration
from fieldkit.lab import background, client, folder, protocol, server
from fieldkit.lab.folder import LabFolder
from fieldkit.lab.protocol import Lab, LabBackend, Overview

_PROFILE: Final = "turtlebot3_burger"
_NEXT: Final = "fieldkit lab ps | shell ROBOT | move ROBOT | ssh-config | down"


def add(commands: Commands) -> None:
    """Add the subcommand with its own."""
    parser = commands.add_parser(
        "lab",
        help="bring robots up on this machine to play with",
        description="Emulated robots that stay up until they are taken down: one lab per directory.",
    )
    actions = parser.add_subparsers(title="commands", metavar="COMMAND", required=True)
    up = actions.add_parser("up", help="bring the robots of the site file up, all in one place, or N alike")
    _add_robots(up)
    up.add_argument("--seed", type=int, default=1, metavar="N", help="seed of everything random (default 1)")
    up.add_argument("--foreground", action="store_true", help="keep this terminal; Ctrl-C takes the robots down")
    up.set_defaults(run=_up)
    actions.add_parser("ps", help="list the robots: where they are, what runs on them").set_defaults(run=_ps)
    shell = actions.add_parser("shell", help="log in on a robot, or run a command there as ssh does")
    shell.add_argument("robot", metavar="ROBOT", help="name of the robot")
    shell.add_argument("command", nargs=argparse.REMAINDER, metavar="COMMAND", help="what its shell runs")
    shell.set_defaults(run=_shell)
    lab_move.add(actions)
    config = actions.add_parser("ssh-config", help="print a configuration for ssh -F, scp -F, rsync and Ansible")
    config.set_defaults(run=_ssh_config)
    actions.add_parser("down", help="end the robots").set_defaults(run=_down)
    plot = actions.add_parser(
        "plot", help="draw the robots that are up, or would be, from above, and how well they hear each other"
    )
    _add_robots(plot)
    plot.add_argument(
        "-o", "--out", type=Path, default=Path("lab.svg"), metavar="FILE", help="SVG, PDF or PNG (default lab.svg)"
    )
    plot.set_defaults(run=_plot)


def _add_robots(parser: argparse.ArgumentParser) -> None:
    session.add_site(parser)
    parser.add_argument(
        "--robots", type=int, metavar="N", help="robots robot-1 to robot-N instead of those in the site file"
    )
    parser.add_argument("--profile", metavar="NAME", default=_PROFILE, help=f"what they are (default {_PROFILE})")


def _up(arguments: argparse.Namespace) -> int:
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


def _ps(_: argparse.Namespace) -> int:
    """List the robots."""
    state = client.state(_here())
    rows = [
        (
            one.name,
            one.profile,
            ", ".join(one.roles),
            one.address,
            lab_move.shown(one.place_m),
            ", ".join(one.programs) or "ended",
        )
        for one in state.robots
    ]
    table(("robot", "profile", "roles", "address", "east, north, up (m)", "runs"), rows)
    print(f"up for {format_duration(state.up_s)}, pid {state.pid}")
    return 0


def _shell(arguments: argparse.Namespace) -> int:
    """Become ssh."""
    here = _here()
    names = [one.name for one in client.state(here).robots]
    if arguments.robot not in names:
        raise protocol.unknown_robot(arguments.robot, names)
    program = shutil.which("ssh")
    if program is None:
        raise ConfigurationError("there is no ssh", remedy="apt-get install openssh-client")
    terminal = ["-t"] if arguments.command and sys.stdin.isatty() and sys.stdout.isatty() else []
    argv = [program, "-F", str(here.ssh_config), *terminal, arguments.robot, *arguments.command]
    os.execv(program, argv)  # noqa: S606 (its own words, no shell)


def _ssh_config(_: argparse.Namespace) -> int:
    """Print the configuration."""
    here = _here()
    client.state(here)
    print(here.ssh_config.read_text(encoding="utf-8"), end="")
    return 0


def _down(_: argparse.Namespace) -> int:
    """End the robots."""
    client.end(_here())
    print("the robots are down")
    return 0


def _plot(arguments: argparse.Namespace) -> int:
    """Draw the lab."""
    # matplotlib takes half a second to import, which no other command shall pay.
    from fieldkit.report import figures  # noqa: PLC0415

    out: Path = arguments.out
    form = next((form for form in figures.FORMATS if out.suffix == f".{form}"), None)
    if form is None:
        raise ConfigurationError(
            f"--out: what {out.name!r} should be is not clear", remedy=f"end it in .{', .'.join(figures.FORMATS)}"
        )
    files.write(out, figures.overview(_overview(arguments), form))
    print(out)
    return 0


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
    site, document = session.lab_site(arguments)
    name = arguments.backend or session.DEFAULT_BACKEND
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
