"""A lab whose robots nobody asks anything, for tests of what a trial does around them."""

from collections.abc import Mapping
from contextlib import AbstractContextManager
from pathlib import Path

from fieldkit.core.model import DelayParts, Fault, Move, Placement, Role
from fieldkit.core.prompts import DONE, Answer
from fieldkit.remote.shell import Shell


class IdleLab:
    """It places robots and knows nothing; what it must not be asked fails.

    Args:
        shells: Its robots.
    """

    def __init__(self, shells: Mapping[Role, Shell] | None = None) -> None:
        self.shells = shells or {}

    def place(self, placement: Placement) -> Answer:
        return DONE

    def inject(self, fault: Fault) -> float | None:
        raise AssertionError(fault)

    def delays(self, source: Role, destination: Role) -> DelayParts | None:
        return None

    def moving(self, move: Move) -> AbstractContextManager[None]:
        raise AssertionError(move)

    def track(self, since_utc_ns: int) -> None:
        return None

    def lateness(self) -> None:
        return None

    def record_air(self, folder: Path | None) -> None:
        pass
