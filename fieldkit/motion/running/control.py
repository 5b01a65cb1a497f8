"""The control of robots that move by themselves, as the harness calls it: the entry point of `fieldkit.motion`."""

from typing import Final

from fieldkit.motion.running.permission import MotionPermission, require_one_place
from fieldkit.trial.running.motion_control import MotionSupport


class MotionControl:
    """Implementation of `fieldkit.trial.running.motion_control.MotionSupport`."""

    require_one_place = staticmethod(require_one_place)
    permission = MotionPermission


CONTROL: Final[MotionSupport] = MotionControl()
