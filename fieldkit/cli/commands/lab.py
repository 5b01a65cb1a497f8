"""`fieldkit lab`: emulated robots on this machine that run until they are taken down."""

import argparse
import os
import shutil
import sys
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Final

from fieldkit.cli import shared_arguments as shared
from fieldkit.cli.display import print_table, show_error, show_note
from fieldkit.cli.parser import Commands, Parser
from fieldkit.core import files
from fieldkit.core.errors import ConfigurationError, FieldkitError, shell_command
from fieldkit.core.events import Event, Note
from fieldkit.core.model import Vector
from fieldkit.core.text import json_text, print_text
from fieldkit.core.units import format_count, format_duration, parse_offset_m
from fieldkit.lab import folder
from fieldkit.lab.folder import LabFolder

if TYPE_CHECKING:
    from fieldkit.lab.protocol import Lab, LabBackend, LabLateness, Overview


def add(parser: Parser) -> None:
    """Declare the arguments of `fieldkit lab`."""
    parser.description = "Emulated robots that run until they are stopped; a directory can have one lab."
    actions = parser.add_commands(title="commands", metavar="COMMAND")
    action = actions.add_parser(
        "up",
        help="start the robots of the site file, or N equal robots",
        description="Start every robot of the site file, with any roles and backend, or N equal robots with "
        "--robots, and return when all can be reached. They are placed on a square grid in the middle of the world, "
        "with at most 5 m between neighbours, and communicate directly with each other; `emulated` in the site file "
        "sets radio, world and ROS. SSH does not use the radio: `control: radio` is ignored, with a note. No program "
        "listens on the network of this machine; the files that other programs need to reach the robots are in a "
        "folder of this user, in memory if there is /run/user. The lab exists as long as its process.",
    )
    shared.add_robots(action)
    action.add_argument(
        "--seed", type=shared.natural, default=1, metavar="N", help="seed of all random draws (default 1)"
    )
    action.add_choice("--wifi", ("model", "linux"), help="Wi-Fi of the robots (default: the site file's, or model)")
    action.add_argument("--foreground", action="store_true", help="run in this terminal; Ctrl-C stops the robots")
    action.set_defaults(run=up)
    listing = actions.add_parser(
        "ps",
        help="list the robots with positions and programs",
        description="List the robots: profile, roles, address on the radio, position, programs. --json prints one "
        "object: pid and up_s of the lab, and robots, each with name, profile, roles, address, place_m (metres east, "
        "north, up) and programs, which is empty for a robot that has stopped; and lateness of a co-simulation "
        "(docs: lab-cosim).",
    )
    listing.add_argument("--json", action="store_true", help="print them as JSON")
    listing.set_defaults(run=list_robots)
    action = actions.add_parser(
        "shell",
        help="log in on a robot, or run a command there as ssh does",
        description="Log in on a robot, or run COMMAND there as ssh does: the words are joined for the robot's "
        "shell, and fieldkit returns the exit code of COMMAND.",
    )
    action.add_argument("robot", metavar="ROBOT", help="name of the robot")
    action.add_argument("command", nargs=argparse.REMAINDER, metavar="COMMAND", help="command for its shell")
    action.set_defaults(run=shell)
    _add_move(actions)
    _add_sdf(actions)
    config = actions.add_parser("ssh-config", help="print a configuration for ssh -F, scp -F, rsync and Ansible")
    config.set_defaults(run=print_ssh_config)
    actions.add_parser("down", help="stop the robots").set_defaults(run=down)
    action = actions.add_parser(
        "plot",
        help="draw the robots of the lab from above, with the SNR of their links",
        description="Draw the lab from above, with the mean SNR of each link without shadowing, and the obstacles "
        "that it crosses; frames do not arrive over a dotted link. If no lab is up, or with --robots, --site or "
        "--backend, draw the robots that `up` would start.",
    )
    shared.add_robots(action)
    action.add_argument(
        "-o", "--out", type=Path, default=Path("lab.svg"), metavar="FILE", help="SVG, PDF or PNG (default lab.svg)"
    )
    action.set_defaults(run=plot)


def _add_sdf(actions: Commands) -> None:
    parser: Parser = actions.add_parser(
        "sdf",
        help="print the world of the robots for Gazebo",
        description="Print the world of the site file and its robots as SDF, for `physics: gazebo` of labs and "
        "trials. The SDF does not contain robots that Gazebo does not move.",
        epilog="example: fieldkit lab sdf > lab.sdf",
    )
    parser.add_choice(
        "--gazebo",
        ("fortress", "garden"),
        default="fortress",
        help="use the plugin names of fortress (default), or of garden and later versions",
    )
    shared.add_robots(parser)
    parser.set_defaults(run=print_sdf)


def _add_move(actions: Commands) -> None:
    parser: Parser = actions.add_parser(
        "move",
        help="move a robot immediately",
        usage="%(prog)s [-h] ROBOT (--to EAST NORTH [UP] | --by EAST NORTH [UP])",
        description="Move a robot immediately, and print its position. --to is a position in the world: lengths east "
        "and north of its corner (20m, 30ft), and the height of the antenna; without UP the robot is on the ground. "
        "--by is relative to its position, and may be negative; without UP the height above the ground is kept. A "
        "position outside of the world's area_m, below the ground or above 100 km is refused.",
    )
    parser.takes_lengths = True
    parser.add_argument("robot", metavar="ROBOT", help="name of the robot")
    group = parser.add_mutually_exclusive_group(required=True)
    group.add_argument(
        "--to",
        nargs="+",
        type=str.strip,
        metavar="LENGTH",
        help="EAST NORTH [UP] in the world; on the ground without UP",
    )
    group.add_argument(
        "--by",
        nargs="+",
        type=str.strip,
        metavar="LENGTH",
        help="EAST NORTH [UP] from its position; UP changes its height above the ground",
    )
    parser.set_defaults(run=move)


_MAX_ROBOTS: Final = 10_000
"""Largest number of equal robots; the limits of backends are smaller."""
_EXAMPLE: Final = "fieldkit lab move ROBOT --to 20m 10m, or --by 0m -30ft, and 5m for UP if it flies"
_NEXT: Final = "fieldkit lab ps | shell ROBOT | move ROBOT | ssh-config | down"


def up(arguments: argparse.Namespace) -> int:
    """Start the robots, and return when they are up, or with --foreground when they are down."""
    from fieldkit.lab import daemon

    lab_folder, backend = folder.of_directory(Path.cwd()), _backend(arguments)

    def announce(lab: "Lab") -> None:
        print_text(f"{format_count(len(lab.members), 'robot')} up, until Ctrl-C", flush=True)

    if arguments.foreground:
        daemon.run(lab_folder, backend, seed=arguments.seed, sink=_show_note, on_ready=announce)
        return 0

    def serve(detach: daemon.OnReady) -> int:
        def ready(lab: "Lab") -> None:
            print_text(f"{format_count(len(lab.members), 'robot')} up; next: {_NEXT}")
            detach(lab_folder.log)

        try:
            daemon.run(lab_folder, backend, seed=arguments.seed, sink=_show_note, on_ready=ready)
        except FieldkitError as error:
            show_error(str(error))
            return error.exit_code
        return 0

    return daemon.run_detached(serve)


def list_robots(arguments: argparse.Namespace) -> int:
    """List the robots."""
    from fieldkit.lab import requests

    state = requests.state(_lab_folder())
    if arguments.json:
        print_text(json_text(asdict(state)))
        return 0
    rows = [
        (
            robot.name,
            robot.profile,
            ", ".join(robot.roles),
            robot.address,
            _place_text(robot.place_m),
            ", ".join(robot.programs) or "stopped",
        )
        for robot in state.robots
    ]
    print_table(("robot", "profile", "roles", "address", "east, north, up (m)", "runs"), rows)
    print_text(f"up for {format_duration(state.up_s)}, pid {state.pid}")
    if state.lateness is not None:
        _show_lateness(state.lateness)
    return 0


def _show_lateness(lateness: "LabLateness") -> None:
    """Print the lateness of a co-simulation, and a note if it was above its bound."""
    parts = (("packets", lateness.packet_max_s), ("windows", lateness.window_max_s))
    texts = [f"{name} at most {max_late_s * 1e3:.3g} ms" for name, max_late_s in parts if max_late_s is not None]
    print_text(f"late: {', '.join(texts) or 'nothing'}; {format_count(lateness.windows, 'window')}")
    if lateness.late:
        show_note(
            f"the co-simulation could not keep up: {lateness.late} of its packets and windows later than "
            f"{lateness.bound_s * 1e3:g} ms, so a trial would be void; reduce the load of this machine, or set a "
            "longer window in emulated.sync"
        )


def move(arguments: argparse.Namespace) -> int:
    """Move the robot and print its position."""
    from fieldkit.lab import requests
    from fieldkit.lab.robots import Destination

    is_relative = arguments.to is None
    option, words = ("--by", arguments.by) if is_relative else ("--to", arguments.to)
    if len(words) not in {2, 3}:
        raise ConfigurationError(f"{option} takes EAST NORTH [UP], not {' '.join(words)!r}", remedy=_EXAMPLE)
    east_m, north_m, *up_m = map(parse_offset_m, words)
    destination = Destination(east_m, north_m, up_m[0] if up_m else None, is_relative)
    place_m = requests.move(_lab_folder(), arguments.robot, destination)
    print_text(f"{arguments.robot} is at {_place_text(place_m)} (m east, north, up)")
    return 0


def shell(arguments: argparse.Namespace) -> int:
    """Replace this process by ssh to the robot."""
    from fieldkit.lab import protocol, requests

    lab_folder = _lab_folder()
    names = [robot.name for robot in requests.state(lab_folder).robots]
    if arguments.robot not in names:
        raise protocol.unknown_robot_error(arguments.robot, names)
    program = shutil.which("ssh")
    if program is None:
        raise ConfigurationError("there is no ssh", remedy="sudo apt-get install openssh-client")
    terminal = ["-t"] if arguments.command and sys.stdin.isatty() and sys.stdout.isatty() else []
    argv = [program, "-F", str(lab_folder.ssh_config), *terminal, arguments.robot, *arguments.command]
    os.execv(program, argv)  # noqa: S606 (an argument list, no shell)


def print_ssh_config(_: argparse.Namespace) -> int:
    """Print the configuration."""
    from fieldkit.lab import requests

    lab_folder = _lab_folder()
    requests.state(lab_folder)
    print_text(lab_folder.ssh_config.read_text(encoding="utf-8"), end="")
    return 0


def print_sdf(arguments: argparse.Namespace) -> int:
    """Print the world for Gazebo."""
    from fieldkit.lab.protocol import GazeboWorlds

    backend = _backend(arguments)
    if not isinstance(backend, GazeboWorlds):
        raise ConfigurationError(
            "Gazebo does not move the robots of this backend", remedy="fieldkit lab sdf --backend emulated"
        )
    print_text(backend.gazebo_world(arguments.gazebo), end="")
    return 0


def down(_: argparse.Namespace) -> int:
    """Stop the robots."""
    from fieldkit.lab import requests

    requests.end(_lab_folder())
    print_text("the robots are down")
    return 0


def plot(arguments: argparse.Namespace) -> int:
    """Draw the lab."""
    # matplotlib takes half a second to import, so other commands must not import it.
    from fieldkit.report import figures, theme

    out: Path = arguments.out
    file_format = theme.format_of(out, "--out")
    files.write(out, figures.overview(_overview(arguments), file_format))
    print_text(out)
    return 0


def _place_text(place_m: Vector) -> str:
    """Return a position as text, to the centimetre: `198.5, 200, 0.2`."""
    return ", ".join(f"{round(metres, 2):.10g}" for metres in place_m)


def _overview(arguments: argparse.Namespace) -> "Overview":
    """Return the lab that is up, or the lab that `up` would start if none is up or options choose its robots."""
    from fieldkit.lab import requests

    if all(getattr(arguments, name) is None for name in ("robots", "profile", "site", "backend")):
        with suppress(requests.NoLabError):
            return requests.overview(_lab_folder())
    return _backend(arguments).overview()


def _lab_folder() -> LabFolder:
    return folder.of_directory(Path.cwd())


def _backend(arguments: argparse.Namespace) -> "LabBackend":
    """Return the backend of the lab that the options choose."""
    from fieldkit.backends.registry import load_backend
    from fieldkit.cli import sites
    from fieldkit.config.site import Site, SiteRobot
    from fieldkit.lab import protocol

    site, document = sites.lab_site(arguments)
    name = sites.DEFAULT_BACKEND if arguments.backend is None else arguments.backend
    if arguments.robots is None and arguments.profile is not None:
        raise ConfigurationError(
            "--profile is the profile of the robots of --robots, which is not given",
            remedy=shell_command("fieldkit", "lab", "up", "--robots", 2, "--profile", arguments.profile),
        )
    if arguments.robots is not None:
        if not 1 <= arguments.robots <= _MAX_ROBOTS:
            limit = "least one robot" if arguments.robots < 1 else f"most {_MAX_ROBOTS} robots"
            raise ConfigurationError(f"--robots: a lab has at {limit}", remedy="fieldkit lab up --robots 2")
        robot = SiteRobot(profile=shared.LAB_PROFILE if arguments.profile is None else arguments.profile)
        robots = {f"robot-{number}": robot for number in range(1, arguments.robots + 1)}
        site = (
            Site(robots=robots, roles={}) if site is None else site.model_copy(update={"robots": robots, "roles": {}})
        )
    backend = protocol.as_lab_backend(name, load_backend(name, site, document))
    wifi = getattr(arguments, "wifi", None)
    if wifi is not None:
        if not isinstance(backend, protocol.ChoosesWifi):
            raise ConfigurationError(f"--wifi: the backend {name} has one kind of Wi-Fi", remedy="remove --wifi")
        backend.use_wifi(wifi)
    return backend


def _show_note(event: Event) -> None:
    if isinstance(event, Note):
        show_note(event.text)
