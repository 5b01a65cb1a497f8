"""Time exchanges between the laptop and robots, to estimate clock offsets."""

import time

from fieldkit.core.deadline import Deadline
from fieldkit.measure.robot_clock import Exchange, parse_date
from fieldkit.remote.shell import Shell

EXCHANGES = 5
"""Number of requests; the exchange with the shortest round-trip time is used."""


def exchanges(shell: Shell, within_s: float) -> list[Exchange]:
    """Query the time of a robot several times. Exchanges with an invalid output of `date` are omitted.

    Args:
        shell: Connection to the robot.
        within_s: Timeout of each query in seconds.

    Raises:
        LinkError: The robot did not answer.
    """
    results = []
    for _ in range(EXCHANGES):
        request_ns = time.time_ns()
        output = shell.run(("date", "-u", "+%s.%N"), deadline=Deadline.after(within_s), check=False).stdout
        response_ns = time.time_ns()
        if (date := parse_date(output.decode("ascii", "replace"))) is not None:
            results.append(Exchange(request_ns, date[0], response_ns, resolution_ns=date[1]))
    return results
