"""A testbed without real robots, for tests of the parts of a trial that need no robot."""

from collections.abc import Mapping
from contextlib import AbstractContextManager

from fieldkit.backends.protocols import Oracle
from fieldkit.core.model import Fault, Move, Placement, Role
from fieldkit.core.prompts import DONE, UNATTENDED, Answer, Operator
from fieldkit.remote.shell import Shell


class IdleTestbed:
    """Accepts placements and has no oracle; operations that a test must not use raise an error.

    Args:
        shells: Its robots.
    """

    oracle: Oracle | None = None
    operator: Operator = UNATTENDED

    def __init__(self, shells: Mapping[Role, Shell] | None = None) -> None:
        self.shells = shells or {}

    def place(self, placement: Placement) -> Answer:
        return DONE

    def inject(self, fault: Fault) -> float | None:
        raise AssertionError(fault)

    def moving(self, move: Move) -> AbstractContextManager[None]:
        raise AssertionError(move)

    def bring_back(self, role: Role, *, has_returned: bool) -> None:
        raise AssertionError(role)
