"""Permissions of the operator, without which robots do not drive or fly; each is an option `--allow-NAME`."""

from typing import Final

from fieldkit.core.permissions import Permission

MOVE: Final = "motion"
MOVE_AFTER_FAULT: Final = "motion-after-fault"

MOTION: Final = Permission(
    "allow fieldkit to drive and fly real robots in steps that move them (safety: `fieldkit docs motion`)",
    is_repeated=True,
)
AFTER_FAULT: Final = Permission(
    "after a fault stopped a robot, let robots move again from their positions without a confirmation"
)
