"""A robot loses power immediately after a command: its confirmed records are on the disk."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from fieldkit.core.errors import RobotError
from fieldkit.core.model import Role
from fieldkit.remote import evidence, jobs
from fieldkit.trial.running.locks import Holder, locked
from tests.helpers.disks import FILE_SYSTEMS, STRICTEST, Disk, FileSystem, mount_workspace
from tests.helpers.host import NamespaceComparison
from tests.helpers.userlands import LocalShell, userland_path

pytestmark = pytest.mark.emulated

ANNA = Holder("trial-a", "anna@one", "trial-a")
BERT = Holder("trial-b", "bert@two", "trial-b")
FOLDER = jobs.work_folder("trial-a", "tcp-01-1")


@pytest.fixture
def workspace(tmp_path: Path, untouched: NamespaceComparison) -> Iterator[Path]:
    """Return a folder in memory, in a separate mount namespace."""
    with mount_workspace(tmp_path) as folder:
        yield folder


@pytest.mark.parametrize(
    ("file_system", "userland"),
    [*((file_system, "debian") for file_system in FILE_SYSTEMS), (STRICTEST, "busybox"), (STRICTEST, "bash")],
    ids=lambda value: value.name if isinstance(value, FileSystem) else value,
)
def test_robot_is_locked_after_a_power_failure(workspace: Path, file_system: FileSystem, userland: str) -> None:
    path = userland_path(userland, workspace / "bin")
    disk = Disk.make(file_system, workspace / "disk.img")
    with disk.mounted(workspace / "disk") as mounted:
        robot = LocalShell(mounted, path, "turtlebot-1")
        with locked({Role.SENDER: robot}, ANNA, sink=lambda _: None):
            images = [disk.image(mounted, workspace / "locked.img")]
            evidence.begin(robot, FOLDER, "sender", "lo", token=ANNA.token)
            images.append(disk.image(mounted, workspace / "begun.img"))
    for image in images:
        with image.repair().mounted(workspace / "disk") as mounted:
            robot = LocalShell(mounted, path, "turtlebot-1")
            with (
                pytest.raises(RobotError, match="anna@one locked it"),
                locked({Role.SENDER: robot}, BERT, sink=lambda _: None),
            ):
                pass
            with locked({Role.SENDER: robot}, ANNA, sink=lambda _: None):
                evidence.begin(robot, FOLDER, "sender", "lo", token=ANNA.token)
