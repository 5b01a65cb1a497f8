"""Interfaces of the steps that start before a step and of the steps that contain it."""

from collections.abc import Mapping
from typing import ClassVar, Protocol

from fieldkit.core.model import Role


class EarlierStep(Protocol):
    """A step that starts before another one."""

    def files(self) -> tuple[str, ...]:
        """Return the names of the files that it writes, see `Step.files`."""


class EnclosingStep(Protocol):
    """A step that contains another one, see `Nest`.

    Attributes:
        disturbs: Whether it may make the steps inside fail.
        parallel: Whether the steps inside run at the same time.
        has_path: Whether it has a path whose duration steps inside can use.
    """

    disturbs: ClassVar[bool]
    parallel: ClassVar[bool]
    has_path: ClassVar[bool]

    def captures(self) -> Mapping[Role, str]:
        """Return the capture file of each robot that captures while the steps inside run."""
