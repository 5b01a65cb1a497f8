"""`fieldkit stop`: stop robots that fieldkit moves, immediately.

The operator waits for this command, so it imports only the code that connects to robots: neither pydantic nor the
modules of profiles, steps and trials.
"""

import argparse
import threading
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Final

from fieldkit.backends import field_shells
from fieldkit.cli import lab_shells
from fieldkit.cli import shared_arguments as shared
from fieldkit.cli.parser import Parser
from fieldkit.config import documents, robot_access
from fieldkit.config.locations import SITE_FILE
from fieldkit.config.robot_access import RobotAccess
from fieldkit.core.errors import ConfigurationError, FieldkitError, LinkError, RobotError, did_you_mean
from fieldkit.core.runtime import user_at_host
from fieldkit.core.text import print_text
from fieldkit.lab import folder
from fieldkit.motion import halting
from fieldkit.motion.halting import HaltResult
from fieldkit.remote.motion_states import STATE_TEXTS, UNCONFIRMED_STATES
from fieldkit.remote.shell import Shell


def add(parser: Parser) -> None:
    """Declare the arguments of `fieldkit stop`."""
    parser.description = (
        "Stop all robots that fieldkit drives or flies, immediately, in parallel and without questions, even if "
        "another instance of fieldkit moves them, or that instance has exited: ground robots stop, drones land, or "
        "return and land. Nothing is sent to a robot that no program of fieldkit moves. A trial that has locked one "
        "of the robots ends, with exit code 3. Prints a line per robot. Exit code 3 if a robot was not reached or "
        "has not confirmed; the other robots are stopped nevertheless."
    )
    shared.add_site(parser)
    selection = parser.add_mutually_exclusive_group(required=True)
    selection.add_argument("robots", nargs="*", default=[], metavar="ROBOT", help="a robot of the site file")
    selection.add_argument("--all", action="store_true", help="all robots of the site file")
    parser.set_defaults(run=f"{__name__}:run")


_WITHIN_S: Final = 10.0
"""Time limit for each robot; a reachable robot answers within a second."""
_FIELD: Final = "field"
_EMULATED_REMEDY: Final = (
    "emulated robots of a trial belong to the fieldkit process of that trial: stop that process by Ctrl-C"
)

Robots = Mapping[str, Shell | FieldkitError]
"""The connection to each robot by its name, or the error that prevents it."""


def run(arguments: argparse.Namespace) -> int:
    """Stop the robots, print the state of each, and return 3 if one was not reached or has not confirmed.

    Raises:
        ConfigurationError: There are no robots that can be stopped, or one of the named robots does not exist.
    """
    print_lock = threading.Lock()

    def report(name: str, result: HaltResult) -> None:
        with print_lock:
            print_text(f"{name}: {_state_text(result)}", flush=True)

    with _robots(arguments) as robots:
        if not robots:
            raise ConfigurationError(
                "there are no robots here that another program can stop", remedy=_EMULATED_REMEDY
            )
        for name in arguments.robots:
            if name not in robots:
                raise ConfigurationError(
                    f"there is no robot {name!r}", remedy=did_you_mean(name, robots, ", ".join(robots))
                )
        selected_robots = {name: shell for name, shell in robots.items() if arguments.all or name in arguments.robots}
        results = halting.halt_all(selected_robots, user_at_host(), _WITHIN_S, report)
    return RobotError.exit_code if any(map(_has_failed, results.values())) else 0


@contextmanager
def _robots(arguments: argparse.Namespace) -> Iterator[Robots]:
    """Yield the robots that the options or the site file select: real robots, or those of a lab or of a backend."""
    path: Path | None = arguments.site
    if path is None and Path(SITE_FILE).is_file():
        path = Path(SITE_FILE)
    document = None if path is None else documents.read(path)
    backend = arguments.backend or (None if document is None else robot_access.configured_backend(document))
    with ExitStack() as stack:
        if backend == _FIELD and document is not None:
            yield stack.enter_context(_field_robots(robot_access.read_access(document)))
            return
        robots: Robots = stack.enter_context(lab_shells.open_shells(folder.of_directory(Path.cwd())))
        yield robots or stack.enter_context(_other_robots(backend, path))


@contextmanager
def _field_robots(accesses: Mapping[str, RobotAccess | ConfigurationError]) -> Iterator[Robots]:
    with ExitStack() as stack:
        robots: dict[str, Shell | FieldkitError] = {}
        for name, access in accesses.items():
            try:
                if isinstance(access, ConfigurationError):
                    raise access
                shell = field_shells.open_shell(name, access, field_shells.find_password(name, access))
                stack.callback(shell.close)
                robots[name] = shell
            except FieldkitError as error:
                robots[name] = error
        yield robots


@contextmanager
def _other_robots(backend: str | None, path: Path | None) -> Iterator[Robots]:
    """Yield the robots of any backend; this reads the complete site file."""
    from fieldkit.backends.registry import load_backend
    from fieldkit.cli.sites import DEFAULT_BACKEND
    from fieldkit.config.site import load_site

    site, document = (None, None) if path is None else load_site(path)
    with load_backend(backend or DEFAULT_BACKEND, site, document).persistent_shells(sink=lambda _: None) as robots:
        yield robots


def _has_failed(result: HaltResult) -> bool:
    return result.error is not None or result.state in UNCONFIRMED_STATES


def _state_text(result: HaltResult) -> str:
    """Return the state of a robot after the order to stop, in one line."""
    if result.error is None:
        return STATE_TEXTS[result.state]
    if isinstance(result.error, LinkError):
        return f"NOT REACHED: stop it by hand ({result.error.what})"
    state_text = STATE_TEXTS[result.state] if result.programs else "NOT CONFIRMED: stop it by hand"
    return f"{state_text}; {result.error.what}"
