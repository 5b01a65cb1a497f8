"""Confirmations by a person that robots are at their places, and that they may move again after a fault."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path
from typing import Final

from fieldkit.backends.protocols import Attended, Backend, Testbed, Transient
from fieldkit.core.errors import ConfigurationError, MotionHeldError
from fieldkit.core.events import Note, Sink
from fieldkit.core.model import Role
from fieldkit.core.permissions import option
from fieldkit.core.prompts import Operator, Question, Unattended
from fieldkit.motion import permissions
from fieldkit.motion.origins import MemoryOrigins, Origins
from fieldkit.motion.profile_sections import can_drive, can_fly
from fieldkit.motion.running import motion_journal
from fieldkit.motion.running.motion_journal import JournaledOrigins, MotionJournal
from fieldkit.trial.plan import Plan

CONFIRM: Final = "confirm"
_STOP: Final = "stop"


def require_one_place(plans: Sequence[Plan], backend: Backend, operator: Operator) -> None:
    """Check that self-moving robots stay at one place in all trials, or that a person moves them.

    Raises:
        ConfigurationError: A robot must be at another place in a later trial, and with `--yes` no person moves it.
    """
    if not backend.by_hand or not isinstance(operator, Unattended):
        return
    for earlier, later in pairwise(plans):
        for role in _self_moving_roles(later):
            if motion_journal.place_of(role, earlier.placement) != motion_journal.place_of(role, later.placement):
                raise ConfigurationError(
                    f"{later.cast[role].name} moves automatically and must be at another place for "
                    f"{later.distance}, and with --yes no person moves it there",
                    remedy="run it without --yes, or one distance per command",
                )


def _self_moving_roles(plan: Plan) -> tuple[Role, ...]:
    moving_roles = plan.procedure.moved_roles()
    return tuple(
        role for role, robot in plan.cast.items() if role in moving_roles and (can_drive(robot) or can_fly(robot))
    )


class MotionPermission:
    """Permission of the robots of a trial to move.

    Args:
        plan: The trial.
        testbed: The trial's robots. In a transient testbed they are back at their places after each motion.
        folder: The trial's folder.

    Attributes:
        origins: Origins of the trial's robots, for the steps.

    Raises:
        EvidenceError: The journal of motions is damaged.
    """

    def __init__(self, plan: Plan, testbed: Testbed, folder: Path) -> None:
        self.origins: Origins
        self._moving = {role: plan.cast[role].name for role in _self_moving_roles(plan)}
        self._testbed = testbed
        self._journaled_origins: JournaledOrigins | None = None
        if isinstance(testbed, Transient):
            self.origins = MemoryOrigins()
            return
        self._journal = MotionJournal(motion_journal.journal_of(folder))
        may_return = isinstance(testbed, Attended) and permissions.MOVE_AFTER_FAULT in testbed.permissions
        robots = {role: robot.name for role, robot in plan.cast.items()}
        self.origins = self._journaled_origins = JournaledOrigins(
            self._journal, folder, robots, plan.placement, may_return=may_return
        )

    def require(self) -> None:
        """Check that robots may move in the next attempt.

        After a fault, a person must type `confirm`, or the operator must have set `--allow-motion-after-fault`.

        Raises:
            ConfigurationError: For the same reasons as `Operator.enter`.
            MotionHeldError: No person has confirmed, or a robot must be at a new place and no person was asked to
                move it there.
            OSError: The disk is full or was removed.
        """
        if self._journaled_origins is None or not self._moving:
            return
        self._require_placed(self._journaled_origins)
        if self._journal.holds:
            self._require_confirmed(self._journaled_origins)

    @contextmanager
    def reporting_holds(self, sink: Sink) -> Iterator[None]:
        """Run the body; if the operator stops it, report each robot that must not move without a confirmation."""
        try:
            yield
        except KeyboardInterrupt:
            for hold in self._journal.holds if self._journaled_origins is not None else ():
                instruction = f"before {hold.robot} moves again, a person must put it at its place and type {CONFIRM}"
                sink(Note(f"{hold.reason}: {instruction}"))
            raise

    def _require_placed(self, origins: JournaledOrigins) -> None:
        """Raise an error if a robot must be at a new place but no person was asked: its origin would be wrong."""
        testbed = self._testbed
        if isinstance(testbed, Attended) and not isinstance(testbed.operator, Unattended):
            return  # a person was asked to move it there
        for role, name in self._moving.items():
            if origins.is_new_place(role):
                raise MotionHeldError(
                    f"{name} must be at another place than before, and --yes does not confirm that it is there",
                    remedy="put it at its place for this trial, clear its path, then repeat this without --yes",
                )

    def _require_confirmed(self, origins: JournaledOrigins) -> None:
        """Let the held robots move again if an option or a person allows it; otherwise raise an error."""
        testbed = self._testbed
        if isinstance(testbed, Attended):
            if permissions.MOVE_AFTER_FAULT in testbed.permissions:
                self._journal.confirm(option(permissions.MOVE_AFTER_FAULT), at_place=False)
                return
            reasons = "; ".join(f"{hold.robot}: {hold.reason}" for hold in self._journal.holds)
            names = " and ".join(hold.robot for hold in self._journal.holds)
            text = (
                f"a fault stopped a robot ({reasons}); put {names} at the start with the initial heading, and clear "
                f"the path; type {CONFIRM} to let robots move again"
            )
            if testbed.operator.enter(Question(text, choices=(CONFIRM, _STOP), usual=_STOP)) == CONFIRM:
                self._journal.confirm("a person confirmed", at_place=True)
                return
        origins.require()
