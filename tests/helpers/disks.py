"""Disks whose power can be cut: file systems on loop files, and images of what has reached them at a moment.

A file system's device is a file here. What a program wrote and nobody synced is in the memory of the kernel and not
in that file, so a copy of the file is the disk as a power cut would leave it at that moment.
"""

import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Final

SIZE_BYTES: Final = 512 << 20  # the files are sparse; xfs wants 300 MiB
_TRIES: Final = 200


@dataclass(frozen=True)
class FileSystem:
    """A kind of file system.

    Attributes:
        name: What it is called in tests.
        kind: What `mount` calls it.
        make: Command that makes it, but for the file.
        options: How it is mounted. None commits by itself while a test runs, so what is not asked for stays away from
            the disk: xfs writes its log every 30 s, ext4 and btrfs would every 5 s and 30 s.
        mend: Command that must mend it after a cut, but for the file; empty where mounting does.
    """

    name: str
    kind: str
    make: tuple[str, ...]
    options: str
    mend: tuple[str, ...] = ()


FILE_SYSTEMS: Final = (
    FileSystem("ext4", "ext4", ("mkfs.ext4", "-q", "-F"), "loop,commit=300"),
    # It brings nothing to disk but what is named, where a journal brings all that happened before with it.
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
def workplace(folder: Path) -> Iterator[Path]:
    """Yield `folder` with a file system in memory, for disks and images.

    Call it where mounts are of one's own (`host.namespaces_of_our_own`): whatever is mounted there, and the loop
    devices under it, go with the thread that owns them, however it ends.
    """
    _call("mount", "-t", "tmpfs", "-o", "size=8g", "power", str(folder))
    try:
        yield folder
    finally:
        _call("umount", str(folder))


class Disk:
    """A disk with a file system.

    Args:
        file_system: Its kind.
        file: Holds it.
    """

    def __init__(self, file_system: FileSystem, file: Path) -> None:
        self._file_system = file_system
        self.file = file

    @classmethod
    def make(cls, file_system: FileSystem, file: Path) -> "Disk":
        """Make a disk in a new file."""
        with file.open("xb") as created:
            created.truncate(SIZE_BYTES)
        _call(*file_system.make, str(file))
        return cls(file_system, file)

    def mend(self) -> "Disk":
        """Do what a machine does that boots after a power cut, before it mounts the disk."""
        if command := self._file_system.mend:
            done = subprocess.run((*command, str(self.file)), capture_output=True, text=True, check=False)
            assert done.returncode in {0, 1}, done.stdout  # e2fsck(8): 1 is mended
        return self

    @contextmanager
    def mounted(self, at: Path) -> Iterator[Path]:
        """Mount the disk while the body runs; `umount` lets go of its loop device too."""
        at.mkdir(exist_ok=True)
        words = ("-t", self._file_system.kind, "-o", self._file_system.options)
        _call("mount", *words, str(self.file), str(at))
        try:
            yield at
        finally:
            _call("umount", str(at))

    def image(self, mounted: Path, file: Path) -> "Disk":
        """Return a copy of the disk as it is now while it is mounted, as a power cut would leave it.

        The kernel may write meanwhile; a copy counts that nothing was written beside.
        """
        for _ in range(_TRIES):
            before = _written(mounted)
            _call("cp", "--sparse=always", str(self.file), str(file))
            if _written(mounted) == before:
                return Disk(self._file_system, file)
        raise AssertionError("the disk never rests")


def _written(mounted: Path) -> tuple[str, ...]:
    """Return how much a mounted disk was written, and what is under way.

    Columns of /sys/block/*/stat (kernel, Documentation/block/stat.rst): writes, sectors written, requests in flight.
    """
    for line in Path("/proc/thread-self/mountinfo").read_text(encoding="utf-8").splitlines():
        words = line.split()
        if words[4] == str(
            mounted
        ):  # btrfs has a device number of its own, so the name tells which loop device it is
            name = Path(words[words.index("-") + 2]).name
            fields = Path(f"/sys/block/{name}/stat").read_text(encoding="ascii").split()
            return fields[4], fields[6], fields[8]
    raise AssertionError(f"{mounted} is not mounted")


def _call(*words: str) -> None:
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    assert done.returncode == 0, f"{' '.join(words)}: {done.stderr}"
