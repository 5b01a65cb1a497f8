"""Which robot writes which file of an attempt, by the jobs of the procedure and the role in the file's name."""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Self

from fieldkit.core.model import Role
from fieldkit.steps.scene import Scene
from fieldkit.trial.procedure import Procedure


@dataclass(frozen=True)
class FileOwners:
    """Owners of the files that robots write; names are compared without regard to case.

    Attributes:
        by_name: The role of each declared file.
        roles: The roles of the procedure.
    """

    by_name: Mapping[str, Role]
    roles: frozenset[Role]

    @classmethod
    def of(cls, procedure: Procedure, scene: Scene) -> Self:
        """Return the owners of the files of a procedure."""
        found: dict[str, Role] = {}
        for placed in procedure.walk():
            for planned in placed.step.own_jobs(scene):
                for name in (planned.job.log, planned.job.stdout):
                    if name:
                        found[name.casefold()] = planned.role
        found |= {file.name.casefold(): role for role, files in scene.recorded.items() for file in files}
        return cls(found, procedure.roles())

    def refusal(self, role: Role, name: str) -> str | None:
        """Return why the robot in a role may not provide a file of this name; None if it may."""
        plain = name.casefold()
        owner = self.by_name.get(plain) or self._named(plain)
        return None if owner in {None, role} else f"only the robot in role {owner} writes a file of this name"

    def _named(self, name: str) -> Role | None:
        """Return the role in a name such as `up.sender-capture.log` or `sender.pcap`."""
        match = re.match(r"(?:[^./]*\.)?([^./-]+)[.-]", name)
        return next((role for role in self.roles if match and role.casefold() == match[1]), None)
