"""Interface of the harness to robots that move automatically: the entry point `control` of `fieldkit.motion`."""

from typing import Final

from fieldkit.motion.running.permission import MotionPermission, require_one_place
from fieldkit.trial.running.motion_control import MotionSupport


class MotionControl:
    """Implementation of `fieldkit.trial.running.motion_control.MotionSupport`."""

    require_one_place = staticmethod(require_one_place)
    permission = MotionPermission


CONTROL: Final[MotionSupport] = MotionControl()
