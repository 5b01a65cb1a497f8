"""Ask robots for the time, against the laptop's."""

import time

from fieldkit.core.deadline import Deadline
from fieldkit.measure.offsets import Exchange, parse_date
from fieldkit.remote.shell import Shell

EXCHANGES = 5
"""Of so many questions the one that was answered soonest is trusted."""


def exchanges(shell: Shell, within_s: float) -> list[Exchange]:
    """Return answers of a robot to the question for the time; none where its `date` tells no time.

    Args:
        shell: The robot.
        within_s: How long it may take to one.

    Raises:
        LinkError: It did not answer.
    """
    found = []
    for _ in range(EXCHANGES):
        asked_ns = time.time_ns()
        said = shell.run(("date", "-u", "+%s.%N"), deadline=Deadline.after(within_s), check=False).stdout
        answered_ns = time.time_ns()
        if (read := parse_date(said.decode("ascii", "replace"))) is not None:
            found.append(Exchange(asked_ns, read[0], answered_ns, resolution_ns=read[1]))
    return found
