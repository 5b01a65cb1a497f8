"""Interface of the package that moves robots: permission to move, and guards of drones, during trials.

The package is found by the entry point `control` of the group `fieldkit.motion`, and imported only for trials in
which robots move or a drone has an action on abort.
"""

from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import Protocol

from fieldkit.backends.protocols import Backend, Testbed
from fieldkit.core import laptop_files, plugins
from fieldkit.core.errors import ConfigurationError
from fieldkit.core.events import Sink
from fieldkit.core.prompts import Operator
from fieldkit.steps.origins import MemoryOrigins, Origins
from fieldkit.steps.scene import Scene, Shells
from fieldkit.trial.plan import Plan


class Permission(Protocol):
    """Permission of the robots of a trial to move."""

    @property
    def origins(self) -> Origins:
        """Origins of the robots, for the steps."""
        ...

    def require(self) -> None:
        """Check that robots may move in the next attempt.

        Raises:
            ConfigurationError: As for `Operator.enter`.
            MotionHeldError: A person must confirm first.
            OSError: The disk is full or was removed.
        """
        ...

    def noting(self, sink: Sink) -> AbstractContextManager[None]:
        """Run the body; if the operator stops it, note each robot that may not move again without a confirmation."""
        ...


class MotionSupport(Protocol):
    """The package that moves robots."""

    def require_one_place(self, plans: Sequence[Plan], backend: Backend, operator: Operator) -> None:
        """Check that self-moving robots stay at one place in all trials, or that a person moves them.

        Raises:
            ConfigurationError: No person moves a robot that must be at another place.
        """
        ...

    def permission(self, plan: Plan, testbed: Testbed, folder: Path) -> Permission:
        """Return the permission of the robots of a trial to move.

        Raises:
            EvidenceError: The journal of motions is damaged.
        """
        ...

    def guarded(self, plan: Plan, scene: Scene, shells: Shells) -> AbstractContextManager[None]:
        """Guard every drone of `on_abort` that no step flies while the body runs.

        Raises:
            LinkError: A robot did not answer.
            RobotError: A guard did not start.
        """
        ...


class _NoMotion:
    """Permission of a trial in which no robot moves."""

    def __init__(self) -> None:
        self.origins: Origins = MemoryOrigins()

    def require(self) -> None:
        """Allow the attempt."""

    @contextmanager
    def noting(self, sink: Sink) -> Iterator[None]:  # noqa: ARG002 (there is nothing to note)
        """Run the body."""
        yield


def require_one_place(plans: Sequence[Plan], backend: Backend, operator: Operator) -> None:
    """Call `MotionSupport.require_one_place` if robots move in one of the trials."""
    if any(plan.procedure.moved() for plan in plans):
        _control().require_one_place(plans, backend, operator)


def permission(plan: Plan, testbed: Testbed, folder: Path) -> Permission:
    """Return the permission of a trial; raises as `MotionSupport.permission`."""
    # A campaign without moves in this trial may have a robot that a fault stopped in another one.
    has_journal = any((place / laptop_files.MOTION).exists() for place in (folder, folder.parent))
    return _control().permission(plan, testbed, folder) if plan.procedure.moved() or has_journal else _NoMotion()


@contextmanager
def guarded(plan: Plan, scene: Scene, shells: Shells) -> Iterator[None]:
    """Run the body within `MotionSupport.guarded` if the procedure has actions on abort."""
    if not plan.procedure.on_abort:
        yield
        return
    with _control().guarded(plan, scene, shells):
        yield


def _control() -> MotionSupport:
    for point in plugins.entry_points(plugins.MOTION):
        loaded: MotionSupport = plugins.load(point)
        return loaded
    raise ConfigurationError(
        "robots that move automatically need a package that is not installed",
        remedy=f"install fieldkit with its entry point of the group {plugins.MOTION}",
    )
