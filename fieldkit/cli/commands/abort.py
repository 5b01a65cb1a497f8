"""`fieldkit abort`: stop all programs of fieldkit on the robots; it can be run on any laptop."""

import argparse
from typing import Final

from fieldkit.cli import shared_arguments as shared
from fieldkit.cli.display import show_error, showing_events
from fieldkit.cli.operators import confirm
from fieldkit.cli.parser import Parser
from fieldkit.core import runtime
from fieldkit.core.errors import FieldkitError, RobotError
from fieldkit.core.events import Note
from fieldkit.core.text import print_text
from fieldkit.core.units import format_count


def add(parser: Parser) -> None:
    """Declare the arguments of `fieldkit abort`."""
    parser.description = (
        "Stop every job of fieldkit on every robot of the site file, of all trials and all laptops, and remove "
        "the robots' locks. A program that lands a drone continues; abort prints its state and the conditions "
        "under which it ends. For each robot, print the stopped jobs, and stopped processes whose folder was "
        "deleted; `not locked` means that no trial held the lock. A trial on these robots stops, and reports the "
        "user who aborted it. Exit code 3 if a robot was not reached, a job was not terminated or, on a "
        "full disk, a lock was not removed; 1 if you answer no. The other robots are processed nevertheless. "
        "Emulated robots stop with their lab, so nothing is done for them."
    )
    shared.add_site(parser)
    parser.add_argument("--yes", action="store_true", help="do not ask; required without a terminal")
    parser.set_defaults(run=run)


_NO_ROBOTS: Final = "the robots of this backend run only while their lab runs, so there is nothing to abort"

_LANDING_END: Final = (
    "The program terminates when the drone has landed or a person or another program flies it, 60 s after the last "
    "heartbeat of its autopilot, or after 10 min"
)


def run(arguments: argparse.Namespace) -> int:
    """Abort, and print the terminated jobs robot by robot."""
    from fieldkit.cli import cli_options
    from fieldkit.remote.motion_states import STATE_TEXTS, MotionState
    from fieldkit.trial.running import locks

    with showing_events(as_json=False) as sink:
        _, backend = cli_options.backend(arguments, sink)
        with backend.persistent_shells(sink=sink) as robots:
            if not robots:
                sink(Note(_NO_ROBOTS))
                return 0
            question = f"terminate every job of fieldkit on {', '.join(robots)}"
            if not arguments.yes and not confirm(question, remedy="fieldkit abort --yes"):
                print_text("nothing was terminated")
                return FieldkitError.exit_code
            results = locks.abort(robots, runtime.user_at_host())
    for robot, result in results.items():
        count = f"{format_count(len(result.jobs), 'job')} terminated"
        if result.error is None:
            print_text(f"{robot}: {'lock removed' if result.locked else 'not locked'}, {count}")
        elif result.jobs:
            print_text(f"{robot}: {count}")
        print_text("".join(f"  {job}\n" for job in result.jobs), end="")
        for program, state in result.landing:
            print_text(
                f"  {program.rpartition('/')[2]} still runs: {STATE_TEXTS[MotionState(state)]}. {_LANDING_END}"
            )
        if result.error is not None:
            show_error(str(result.error))
    return RobotError.exit_code if any(result.error for result in results.values()) else 0
