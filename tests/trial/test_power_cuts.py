"""Power cuts of the laptop at any moment of a trial lose nothing that was reported as finished.

The file systems of these tests lose all data that was not synced; see `tests/helpers/disks.py`. Run
`python -m tests.e2e.power_cuts` for a larger number of power cuts.
"""

import os
import random
import subprocess
import sys
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import pytest

from fieldkit.core.deadline import Deadline
from tests.helpers.cut_trials import (
    OUT,
    calls_of_a_trial,
    cuts_at_every_sync,
    lose_power_repeatedly,
    robots_with_much_evidence,
)
from tests.helpers.disks import FILE_SYSTEMS, STRICTEST, Disk, FileSystem, mount_workspace
from tests.helpers.host import NamespaceComparison
from tests.helpers.nightly import mark_nightly
from tests.helpers.paths import ROOT
from tests.helpers.power import PowerCut, VersionRecorder, assert_resumable, read_tree
from tests.helpers.sshd import wait_until

pytestmark = pytest.mark.emulated  # mounts need root

UNNECESSARY_SYNCS = {"store.create: files.sync_folder(out)"}
"""Syncs that these file systems do not need. When a new file in a new folder is synced, they also write the name of
the new folder to disk, which POSIX does not guarantee; see fsync(2).
"""

every_file_system = pytest.mark.parametrize("file_system", FILE_SYSTEMS, ids=lambda file_system: file_system.name)
strictest_in_ci = pytest.mark.parametrize(
    "file_system", mark_nightly(FILE_SYSTEMS, in_ci=[STRICTEST]), ids=lambda file_system: file_system.name
)


@pytest.fixture
def workspace(tmp_path: Path, untouched: NamespaceComparison) -> Iterator[Path]:
    """A folder in memory, in mounts that only this test has."""
    with mount_workspace(tmp_path) as folder, robots_with_much_evidence():
        yield folder


@every_file_system
def test_a_power_cut_loses_data_that_was_not_synced(workspace: Path, file_system: FileSystem) -> None:
    """The other tests would pass without reason if these disks lost nothing."""
    disk = Disk.make(file_system, workspace / "disk.img")
    with disk.mounted(workspace / "disk") as mounted:
        (mounted / "changed").write_bytes(b"before")
        (mounted / "synced").write_bytes(b"synced" * 10_000)
        for name in ("changed", "synced", ""):
            descriptor = os.open(mounted / name, os.O_RDONLY)
            os.fsync(descriptor)
            os.close(descriptor)
        (mounted / "written").write_bytes(b"written" * 10_000)
        (mounted / "changed").write_bytes(b"after")
        (mounted / "synced").rename(mounted / "renamed")
        image = disk.image(mounted, workspace / "cut.img")
        assert sorted(path.name for path in mounted.iterdir() if path.name != "lost+found") == [
            "changed",
            "renamed",
            "written",
        ]
    with image.repair().mounted(workspace / "elsewhere") as mounted:
        assert sorted(path.name for path in mounted.iterdir() if path.name != "lost+found") == ["changed", "synced"]
        assert (mounted / "changed").read_bytes() != b"after"
        assert (mounted / "synced").read_bytes() == b"synced" * 10_000


@strictest_in_ci
def test_a_power_cut_at_any_write_loses_nothing_that_was_reported(workspace: Path, file_system: FileSystem) -> None:
    cuts, recorder, _ = cuts_at_every_sync(Disk.make(file_system, workspace / "disk.img"), workspace)
    assert len(cuts) > 30, "too few writes were interrupted"
    assert any(cut.reported for cut in cuts)
    resumed_states = []
    for cut in cuts:
        with cut.disk.repair().mounted(workspace / "elsewhere") as mounted:
            assert cut.lost_files(mounted / OUT, recorder) == []
            remaining_files = read_tree(mounted / OUT)
            if not any((mounted / OUT).glob("*/trial.yaml")):
                assert not cut.reported
            elif remaining_files not in resumed_states:
                resumed_states.append(remaining_files)
                assert_resumable(mounted / OUT)


def test_removing_any_sync_is_detected(workspace: Path) -> None:
    def run_without_sync(without: str) -> tuple[bool, set[str]]:
        file = workspace / "disk.img"
        cuts, recorder, places = cuts_at_every_sync(Disk.make(STRICTEST, file), workspace, without=without)
        file.unlink()
        return any(_describe_losses(workspace, cut, recorder) for cut in cuts), set(places)

    _, places = run_without_sync("")
    assert len(places) > 5
    assert {sync for sync in places if not run_without_sync(sync)[0]} <= UNNECESSARY_SYNCS


@strictest_in_ci
def test_consecutive_cuts_at_random_moments_lose_nothing(workspace: Path, file_system: FileSystem) -> None:
    draw, calls = random.Random(file_system.name), calls_of_a_trial(workspace)
    assert sum(lose_power_repeatedly(file_system, workspace, draw, calls=calls, most=4) for _ in range(3)) > 3


def _describe_losses(workspace: Path, cut: PowerCut, recorder: VersionRecorder) -> list[str]:
    with cut.disk.repair().mounted(workspace / "elsewhere") as mounted:
        return cut.lost_files(mounted / OUT, recorder)


def test_a_killed_test_leaves_no_mounts(tmp_path: Path) -> None:
    """Otherwise, mounts and loop devices of the machine would have to be removed by hand."""
    with subprocess.Popen(
        (sys.executable, "-m", "tests.e2e.power_cuts"),
        cwd=ROOT,
        stdout=subprocess.PIPE,
        text=True,
        env=os.environ | {"PYTHONPATH": str(ROOT), "TMPDIR": str(tmp_path)},
    ) as process:
        assert process.stdout is not None
        folder = process.stdout.readline().split()[-1]
        wait_until(lambda: _has_loop_device(folder), Deadline.after(60))
        process.kill()
    wait_until(lambda: not _has_loop_device(folder), Deadline.after(60))
    assert folder not in Path("/proc/self/mounts").read_text(encoding="utf-8")


def _has_loop_device(folder: str) -> bool:
    """Return True if a loop device of this machine uses a file in a folder."""
    for file in Path("/sys/block").glob("loop*/loop/backing_file"):
        with suppress(OSError):  # it may disappear meanwhile
            if file.read_text(encoding="utf-8").startswith(folder):
                return True
    return False
