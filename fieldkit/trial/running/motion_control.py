"""Interface to the package that moves robots during trials: it permits or refuses motion before each attempt.

The package has the entry point `control` of the group `fieldkit.motion`. It is imported only for trials in which
robots move.
"""

from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import Final, Protocol

from fieldkit.backends.protocols import Backend, Testbed
from fieldkit.core import laptop_files, plugins
from fieldkit.core.errors import ConfigurationError
from fieldkit.core.events import Sink
from fieldkit.core.prompts import Operator
from fieldkit.trial.plan import Plan


class MotionClearance(Protocol):
    """Permission of the robots of a trial to move. It is checked before each attempt."""

    @property
    def origins(self) -> object:
        """The value of `Scene.origins` for the steps."""
        ...

    def require(self) -> None:
        """Check that robots may move in the next attempt.

        Raises:
            ConfigurationError: For the same reasons as `Operator.enter`.
            MotionHeldError: A person must first confirm the motion.
            OSError: The disk is full or was removed.
        """
        ...

    def reporting_holds(self, sink: Sink) -> AbstractContextManager[None]:
        """Return a context manager.

        If the operator stops its body, it reports each robot that must not move until a person confirms the motion.
        """
        ...


class MotionSupport(Protocol):
    """The package that moves robots."""

    def require_one_place(self, plans: Sequence[Plan], backend: Backend, operator: Operator) -> None:
        """Check that each robot that moves automatically has the same place in all trials.

        The places may differ if a person brings the robots to them.

        Raises:
            ConfigurationError: A robot must be at another place in a later trial, and no person brings it there.
        """
        ...

    def permission(self, plan: Plan, testbed: Testbed, folder: Path) -> MotionClearance:
        """Return the permission of the robots of a trial to move.

        Raises:
            EvidenceError: The journal of motions is damaged.
        """
        ...


class _NoMotion:
    """Permission of a trial in which no robot moves."""

    origins: Final = None

    def require(self) -> None:
        """Allow the attempt."""

    @contextmanager
    def reporting_holds(self, sink: Sink) -> Iterator[None]:  # noqa: ARG002 (there is nothing to report)
        """Run the body."""
        yield


def require_one_place(plans: Sequence[Plan], backend: Backend, operator: Operator) -> None:
    """Call `MotionSupport.require_one_place` if robots move in one of the trials."""
    if any(plan.procedure.moved_roles() for plan in plans):
        _motion_support().require_one_place(plans, backend, operator)


def permission(plan: Plan, testbed: Testbed, folder: Path) -> MotionClearance:
    """Return the permission of a trial. Raises the same errors as `MotionSupport.permission`."""
    # Even if this trial has no moves, a fault in another trial of its campaign may have stopped a robot.
    has_journal = any((place / laptop_files.MOTION).exists() for place in (folder, folder.parent))
    return (
        _motion_support().permission(plan, testbed, folder)
        if plan.procedure.moved_roles() or has_journal
        else _NoMotion()
    )


def _motion_support() -> MotionSupport:
    for point in plugins.entry_points(plugins.MOTION):
        support: MotionSupport = plugins.load(point)
        return support
    raise ConfigurationError(
        "robots that move automatically need a package that is not installed",
        remedy=f"the entry point of the group {plugins.MOTION} is missing: install its package again",
    )
