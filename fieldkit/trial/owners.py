"""Owners of the files of an attempt: the robot that may write each file, from the jobs and the role in its name."""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Self

from fieldkit.core.model import Role
from fieldkit.steps.nest import own_jobs
from fieldkit.steps.scene import Scene
from fieldkit.trial.procedure import Procedure


@dataclass(frozen=True)
class FileOwners:
    """The role that may write each file. Names are compared without regard to case.

    Attributes:
        by_name: Role of each declared file.
        roles: Roles of the procedure.
    """

    by_name: Mapping[str, Role]
    roles: frozenset[Role]

    @classmethod
    def of_procedure(cls, procedure: Procedure, scene: Scene) -> Self:
        """Return the owners of the files of a procedure."""
        owners: dict[str, Role] = {}
        for placed in procedure.walk():
            for planned in own_jobs(placed.step, scene):
                for name in (planned.job.log, planned.job.stdout):
                    if name:
                        owners[name.casefold()] = planned.role
        owners |= {file.name.casefold(): role for role, files in scene.recordings.items() for file in files}
        return cls(owners, procedure.roles())

    def refusal(self, role: Role, name: str) -> str | None:
        """Return the reason why the robot in a role may not provide a file of this name, or None if it may."""
        key = name.casefold()
        owner = self.by_name.get(key) or self._role_in_name(key)
        return None if owner in {None, role} else f"only the robot in role {owner} may write a file of this name"

    def _role_in_name(self, name: str) -> Role | None:
        """Return the role in a name such as `up.sender-capture.log` or `sender.pcap`."""
        match = re.match(r"(?:[^./]*\.)?([^./-]+)[.-]", name)
        return next((role for role in self.roles if match and role.casefold() == match[1]), None)
