"""Disks with simulated power cuts: file systems on loop files, and images of the data on disk at a given time.

The device of a file system is a file. Data that was written but not synced is in the page cache and not in this file,
so a copy of the file equals the disk after a power cut at that time.
"""

import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Final

SIZE_BYTES: Final = 512 << 20  # the files are sparse; xfs needs 300 MiB
_MAX_COPIES: Final = 200


@dataclass(frozen=True)
class FileSystem:
    """A kind of file system.

    Attributes:
        name: Name in tests.
        kind: Type for `mount`.
        make: Command that creates it, without the file.
        options: Mount options. The file system must not commit automatically during a test, so that only requested
            data reaches the disk: xfs writes its log every 30 s; by default ext4 commits every 5 s, btrfs every 30 s.
        repair: Command that must repair it after a cut, without the file; empty if mounting repairs it.
    """

    name: str
    kind: str
    make: tuple[str, ...]
    options: str
    repair: tuple[str, ...] = ()


FILE_SYSTEMS: Final = (
    FileSystem("ext4", "ext4", ("mkfs.ext4", "-q", "-F"), "loop,commit=300"),
    # A sync writes only the synced file; with a journal, it would also write all earlier changes.
    FileSystem(
        "ext4-without-journal",
        "ext4",
        ("mkfs.ext4", "-q", "-F", "-O", "^has_journal"),
        "loop",
        ("e2fsck", "-f", "-y"),
    ),
    FileSystem("xfs", "xfs", ("mkfs.xfs", "-q", "-f"), "loop"),
    FileSystem("btrfs", "btrfs", ("mkfs.btrfs", "-q", "-f"), "loop,commit=300"),
)
STRICTEST: Final = FILE_SYSTEMS[1]


@contextmanager
def mount_workspace(folder: Path) -> Iterator[Path]:
    """Yield `folder` with a file system in memory, for disks and images.

    Call it in a separate mount namespace (`host.separate_namespaces`): the kernel removes all mounts in it, and
    their loop devices, when the thread that owns the namespace ends.
    """
    _run("mount", "-t", "tmpfs", "-o", "size=8g", "power", str(folder))
    try:
        yield folder
    finally:
        _run("umount", str(folder))


class Disk:
    """A disk with a file system.

    Args:
        file_system: The kind of file system.
        file: The file with the content of the disk.
    """

    def __init__(self, file_system: FileSystem, file: Path) -> None:
        self._file_system = file_system
        self.file = file

    @classmethod
    def make(cls, file_system: FileSystem, file: Path) -> "Disk":
        """Create a disk in a new file."""
        with file.open("xb") as disk_file:
            disk_file.truncate(SIZE_BYTES)
        _run(*file_system.make, str(file))
        return cls(file_system, file)

    def repair(self) -> "Disk":
        """Repair the disk as at boot after a power cut, before it is mounted."""
        if command := self._file_system.repair:
            completed = subprocess.run((*command, str(self.file)), capture_output=True, text=True, check=False)
            assert completed.returncode in {0, 1}, completed.stdout  # e2fsck(8): 1 means that errors were corrected
        return self

    @contextmanager
    def mounted(self, mount_point: Path) -> Iterator[Path]:
        """Mount the disk during the body; `umount` also releases its loop device."""
        mount_point.mkdir(exist_ok=True)
        options = ("-t", self._file_system.kind, "-o", self._file_system.options)
        _run("mount", *options, str(self.file), str(mount_point))
        try:
            yield mount_point
        finally:
            _run("umount", str(mount_point))

    def image(self, mounted: Path, file: Path) -> "Disk":
        """A copy of a mounted disk as a power cut now would leave it.

        The kernel may write during the copy, so the copy is repeated until the kernel writes nothing during it.
        """
        for _ in range(_MAX_COPIES):
            before = _write_state(mounted)
            _run("cp", "--sparse=always", str(self.file), str(file))
            if _write_state(mounted) == before:
                return Disk(self._file_system, file)
        raise AssertionError("the disk is always being written")


def _write_state(mounted: Path) -> tuple[str, ...]:
    """The number of writes to a mounted disk and the requests in flight.

    Columns of /sys/block/*/stat (kernel, Documentation/block/stat.rst): writes, sectors written, requests in flight.
    """
    for line in Path("/proc/thread-self/mountinfo").read_text(encoding="utf-8").splitlines():
        mount_fields = line.split()
        if mount_fields[4] == str(mounted):
            # btrfs has a separate device number, so the loop device is identified by its name.
            name = Path(mount_fields[mount_fields.index("-") + 2]).name
            fields = Path(f"/sys/block/{name}/stat").read_text(encoding="ascii").split()
            return fields[4], fields[6], fields[8]
    raise AssertionError(f"{mounted} is not mounted")


def _run(*command: str) -> None:
    completed = subprocess.run(command, capture_output=True, text=True, check=False)
    assert completed.returncode == 0, f"{' '.join(command)}: {completed.stderr}"
