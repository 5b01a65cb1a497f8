"""Evidence that was not fetched, which a file in the attempt's local folder records.

It stays on its robot, unless the robot itself is removed at the end of this run of fieldkit.
"""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

from fieldkit.core import laptop_files
from fieldkit.core.model import Role, Status
from fieldkit.core.text import encodable
from fieldkit.trial.journal import Attempt
from fieldkit.trial.plan import Plan


def unfetched_file(role: Role) -> str:
    """Return the name of the file with the reason why the evidence of the robot in `role` was not fetched."""
    return f"{role}-{laptop_files.UNFETCHED}"


class UnfetchedEvidence:
    """The unfetched evidence of a trial.

    Args:
        plan: The trial.
        roles: Roles of the trial.
        transient: True if the robots and their files are removed at the end of this run of fieldkit.

    Attributes:
        folders: Folders of attempts with unfetched evidence on the robot in each role.
    """

    def __init__(self, plan: Plan, roles: Iterable[Role], *, transient: bool) -> None:
        self._plan = plan
        self._transient = transient
        self.folders: dict[Role, list[str]] = {role: [] for role in roles}

    def mark(self, role: Role, remote: str, into: Path, reason: str) -> None:
        """Record that an attempt's evidence was not fetched from a robot, with its path and the reason.

        The record is a file in the attempt's local folder, and an entry in `folders`, so that `Robots` does not
        delete the folder on the robot.

        Args:
            role: Role of the robot.
            remote: The attempt's folder on the robot.
            into: The local folder.
            reason: Reason why the evidence was not fetched.
        """
        if remote not in self.folders[role]:
            self.folders[role].append(remote)
        verb = "was" if self._transient else "is"
        end = ", and was removed with the robot" if self._transient else ""
        text = f"{reason}\nthe evidence {verb} on {self._plan.cast[role].name} in ~/{remote}{end}\n"
        (into / unfetched_file(role)).write_text(encodable(text), encoding="utf-8")

    def mark_all(self, remote: str, into: Path, reason: str) -> None:
        """Call `mark` for all robots, with the same arguments."""
        for role in self.folders:
            self.mark(role, remote, into, reason)

    def restore(self, ended: Attempt, stored_folder: Path) -> None:
        """Add an attempt of an earlier run to `folders` for each role with a file of `mark` in its stored folder.

        Nothing is added for a valid attempt, whose evidence was fetched, or if robots are transient.
        """
        if ended.status is not Status.VALID and not self._transient:
            for role, folders in self.folders.items():
                if (stored_folder / unfetched_file(role)).is_file():
                    folders.append(ended.remote_folder(self._plan.trial))

    def by_robot(self) -> Mapping[str, Sequence[str]]:
        """Return the remote folders with evidence that was not fetched, by the robot's name; none if transient."""
        if self._transient:
            return {}
        return {self._plan.cast[role].name: folders for role, folders in self.folders.items() if folders}
