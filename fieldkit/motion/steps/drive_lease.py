"""The lease of the program that drives a robot, and the status that the program reports.

The lease is the time after which an order expires unless the laptop renews it (`fieldkit.motion.steps.lease`).
"""

import json
import math
from collections.abc import Callable
from contextlib import suppress
from typing import Any, Final

from typing_extensions import override

from fieldkit.agent.driving import drive_plan
from fieldkit.core.deadline import Deadline
from fieldkit.core.errors import LinkError, RobotError
from fieldkit.core.text import JSON_ERRORS, shorten
from fieldkit.motion.logs import drive_log
from fieldkit.motion.origins import MotionOrigin
from fieldkit.motion.steps.lease import LeaseKeeper
from fieldkit.remote.jobs import Job
from fieldkit.remote.shell import Shell

START_S: Final = 40.0
"""Timeout for the first status: the program starts the middleware, and connects to the topics of velocity and
odometry."""
_RENEWALS: Final = 5
"""Number of renewals within the duration of a lease."""
_STATUS_TIMEOUT_S: Final = 10.0
"""After this time without a new status, the driver is regarded as stopped."""
STATUS: Final = "drive.status"
"""File with the status of the driver. In the job's folder its name has the step's name as a prefix, such as
`up.drive.status`."""


class DriveLease(LeaseKeeper):
    """Keeps the lease of the program that drives a robot. The first order is to wait.

    Args:
        shell: Connection to the robot.
        job: The running program.
        name_pattern: Pattern of the names of the step's files, with `{}` in place of the name without the prefix.
        lease_s: Duration of the lease; the robot stops if it is not renewed in this time.
    """

    def __init__(self, shell: Shell, job: Job, name_pattern: str, lease_s: float) -> None:
        super().__init__(
            shell,
            job,
            output_file=name_pattern.format(STATUS),
            order=drive_plan.WAIT,
            lease_s=lease_s,
            renewals=_RENEWALS,
        )

    def turn_back(self) -> None:
        """Order the robot back to its place.

        If the order is lost, the next renewal repeats it; without renewals the robot stops.
        """
        with suppress(LinkError, RobotError):
            self.give_order(drive_plan.BACK)

    @property
    def is_ready(self) -> bool:
        """Whether the robot is stationary at its start position."""
        return self.status.get("ready") is True

    @property
    def is_refused(self) -> bool:
        """Whether the robot refused to start because it is not at its start position."""
        return self.status.get("refused") is True

    @property
    def pose(self) -> MotionOrigin | None:
        """The last reported pose of the robot in the frame of its odometry; None if there is no valid report."""
        status = self.status
        try:
            x_m, y_m, yaw_rad = map(float, status["pose"])
            frame_id = status["frame_id"]
        except (KeyError, TypeError, ValueError):
            return None
        if not isinstance(frame_id, str) or not all(map(math.isfinite, (x_m, y_m, yaw_rad))):
            return None
        return MotionOrigin("odometry", shorten(frame_id), x_m, y_m, yaw_rad)

    @property
    def status(self) -> dict[str, Any]:
        """The last status of the program; empty before the first one."""
        return _parse_status(self.output)

    @property
    def final_state(self) -> str:
        """State of the robot after the drive: `home` if it is at its place, otherwise the reason why it stopped.

        Empty before the end of the drive. The driver writes its status ten times a second. If there is no new status,
        the driver has exited or cannot be reached.
        """
        status, silent_s = self.status, self.unchanged_s
        if isinstance(state := status.get("ended"), str) and state:
            return shorten(state)
        if silent_s > (_STATUS_TIMEOUT_S if status else START_S):
            return f"its driver sent no status for {silent_s:.0f} s"
        return super().end_reason

    @property
    @override
    def end_reason(self) -> str:
        return "" if self.final_state in {"", drive_log.HOME} else f"it stopped on its path: {self.final_state}"

    def wait(self, condition: Callable[[], object], deadline: Deadline) -> None:
        """Wait until a condition is true or the deadline has passed."""
        while not condition() and not deadline.expired:
            self.wait_for_next_poll()
            # Without the link the robot stops automatically and its driver reports why; the link may be restored.
            with suppress(LinkError, RobotError):
                self.renew()


def _parse_status(text: bytes) -> dict[str, Any]:
    """Return the status that a driver wrote; empty if it is incomplete."""
    try:
        status = json.loads(text)
    except JSON_ERRORS:
        return {}
    return status if isinstance(status, dict) else {}
