"""Sections of procedures: keys that installed packages add, and what they contribute to a trial."""

from collections.abc import Iterator, Mapping
from contextlib import AbstractContextManager, nullcontext
from typing import Protocol

from fieldkit.backends.protocols import Robot
from fieldkit.core import model
from fieldkit.core.model import Role
from fieldkit.steps.scene import Refusal, Scene, Shells


class ProcedureOutline(Protocol):
    """The part of a procedure that sections use."""

    def moved(self) -> frozenset[Role]:
        """Return the roles whose robots are moved by steps."""

    def expected_s(self, protocol: model.Protocol) -> float:
        """Return the approximate duration of an attempt on a good link, in seconds."""


class TrialOutline(Protocol):
    """The part of a plan that sections use."""

    @property
    def cast(self) -> Mapping[Role, Robot]:
        """The robot in each role."""

    @property
    def procedure(self) -> ProcedureOutline:
        """The procedure."""


class ProcedureSection:
    """Base of the models of sections of a procedure; every method has a default."""

    def roles(self) -> frozenset[Role]:
        """Return the roles that the section names; steps must use these roles, too."""
        return frozenset()

    def refusals(self, plan: TrialOutline) -> Iterator[Refusal]:  # noqa: ARG002 (some work with every robot)
        """Yield the reasons why it cannot work with the robots of a trial."""
        return iter(())

    def dry_run_notes(self, plan: TrialOutline) -> Iterator[str]:  # noqa: ARG002 (some have no such actions)
        """Yield a line for each action that is not a command on a robot; `--dry-run` prints them."""
        return iter(())

    def abort_notes(self, plan: TrialOutline) -> Iterator[str]:  # noqa: ARG002 (most move no robot)
        """Yield a sentence for each robot on what it does if an attempt is stopped immediately.

        If there is such a robot, a request to stop takes effect immediately.
        """
        return iter(())

    def around_steps(self, plan: TrialOutline, scene: Scene, shells: Shells) -> AbstractContextManager[None]:  # noqa: ARG002
        """Return the context in which the steps of an attempt run.

        Raises:
            LinkError: A robot did not answer.
            RobotError: A robot cannot do what the section needs.
        """
        return nullcontext()
