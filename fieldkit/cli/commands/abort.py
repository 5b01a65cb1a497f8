"""`fieldkit abort`: end what fieldkit left on the robots, from any laptop."""

import argparse
from typing import Final

from fieldkit.cli import options
from fieldkit.cli.display import show_error, watching
from fieldkit.cli.terminal import confirmed
from fieldkit.core.errors import FieldkitError, RobotError
from fieldkit.core.events import Note
from fieldkit.core.units import format_count
from fieldkit.trial.running import locks

_NONE: Final = "no robot stands without fieldkit on this backend: its robots end with their lab"


def run(arguments: argparse.Namespace) -> int:
    """Abort, and print what was ended robot by robot."""
    with watching(as_json=False) as sink:
        _, backend = options.backend(arguments, sink)
        with backend.standing(sink=sink) as robots:
            if not robots:
                sink(Note(_NONE))
                return 0
            question = f"end every job of fieldkit on {', '.join(robots)}"
            if not arguments.yes and not confirmed(question, unasked="fieldkit abort --yes"):
                print("nothing was ended")
                return FieldkitError.exit_code
            ended = locks.abort(robots, locks.me())
    for robot, one in ended.items():
        count = f"{format_count(len(one.jobs), 'job')} ended"
        if one.error is None:
            print(f"{robot}: {'lock broken' if one.locked else 'not locked'}, {count}")
        elif one.jobs:
            print(f"{robot}: {count}")
        print("".join(f"  {job}\n" for job in one.jobs), end="")
        if one.error is not None:
            show_error(str(one.error))
    return RobotError.exit_code if any(aborted.error for aborted in ended.values()) else 0
