"""Sections of procedures: keys that installed packages add, with methods that are called during a trial."""

from collections.abc import Iterator, Mapping
from contextlib import AbstractContextManager, nullcontext
from typing import Protocol

from fieldkit.backends.protocols import Robot
from fieldkit.core import model
from fieldkit.core.model import Role
from fieldkit.steps.scene import Refusal, Scene, Shells


class ProcedureOutline(Protocol):
    """The part of a procedure that sections use."""

    def moved_roles(self) -> frozenset[Role]:
        """Return the roles of the robots that steps move."""

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
    """Base class of the models of procedure sections. Every method has a default."""

    def roles(self) -> frozenset[Role]:
        """Return the roles that the section names. Steps must use these roles as well."""
        return frozenset()

    def refusals(self, plan: TrialOutline) -> Iterator[Refusal]:  # noqa: ARG002 (some sections support all robots)
        """Yield the reasons why the section cannot be used with the robots of a trial."""
        return iter(())

    def dry_run_notes(self, plan: TrialOutline) -> Iterator[str]:  # noqa: ARG002 (subclasses need it)
        """Yield a line for each action that is not a command on a robot. `--dry-run` prints these lines."""
        return iter(())

    def abort_notes(self, plan: TrialOutline) -> Iterator[str]:  # noqa: ARG002 (subclasses need it)
        """Yield a sentence about the reaction of each moving robot if an attempt is stopped immediately.

        If there are such sentences, a request to stop takes effect immediately.
        """
        return iter(())

    def around_steps(self, plan: TrialOutline, scene: Scene, shells: Shells) -> AbstractContextManager[None]:  # noqa: ARG002
        """Return the context in which the steps of an attempt run.

        Raises:
            LinkError: A robot did not answer.
            RobotError: A robot cannot do what the section needs.
        """
        return nullcontext()
