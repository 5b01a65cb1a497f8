"""Evidence too large for an archive is fetched in pieces. The fetch can be continued, and its size is limited."""

import hashlib
import os
import random
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import pytest

from fieldkit.core import files
from fieldkit.core.deadline import Deadline
from fieldkit.core.errors import EvidenceError, LinkError, RobotError
from fieldkit.remote import evidence, fetching, jobs
from fieldkit.remote.fetching import PIECE_BYTES, FetchProgress, NoFolderError
from fieldkit.remote.shell import Completed
from tests.helpers.userlands import USERLANDS_OF_LONG_TESTS, LocalShell, userland_path

pytestmark = pytest.mark.emulated

FOLDER = jobs.work_folder("trial", "udp-01-1")
LARGE = random.Random(7).randbytes(2 * PIECE_BYTES + 12_345)
SMALL = b"#ROSBAG V2.0\n" * 100


class LossyRobot(LocalShell):
    """A robot whose link is lost at some pieces, and which records the requested pieces."""

    def __init__(self, home: Path, path: str = os.environ["PATH"]) -> None:
        super().__init__(home, path)
        self.pieces: list[int] = []
        self.lost_at: Callable[[int], bool] = lambda _: False

    def fetch(self, argv: Sequence[str], to: Path, *, deadline: Deadline, limit_bytes: int) -> Completed:
        if argv[2] == "piece":
            number = int(argv[5])
            self.pieces.append(number)
            if self.lost_at(number):
                raise LinkError("the connection broke", where=self.robot)
        return super().fetch(argv, to, deadline=deadline, limit_bytes=limit_bytes)


@pytest.fixture(params=USERLANDS_OF_LONG_TESTS)
def robot(tmp_path: Path, request: pytest.FixtureRequest) -> Iterator[LossyRobot]:
    home = tmp_path / "home"
    home.mkdir()
    lossy_robot = LossyRobot(home, userland_path(request.param, tmp_path / "bin"))
    jobs.install(lossy_robot, Deadline.after(30))
    evidence.begin(lossy_robot, FOLDER, "sender", "lo", required_kib=0)
    (home / FOLDER / "scan").mkdir()
    (home / FOLDER / "scan" / "scan_0.db3").write_bytes(LARGE)
    (home / FOLDER / "camera.bag").write_bytes(LARGE[::-1])
    (home / FOLDER / "small.bag").write_bytes(SMALL)
    yield lossy_robot
    lossy_robot.close()


@pytest.fixture
def into(tmp_path: Path) -> Path:
    folder = tmp_path / "into"
    folder.mkdir()
    return folder


def fetch(robot: LossyRobot, into: Path, **options: object) -> None:
    fetching.fetch(robot, FOLDER, "sender", "lo", into, **options)  # type: ignore[arg-type]


def names(folder: Path) -> set[str]:
    return {str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file()}


ALL_FILES = {
    *("camera.bag", "scan/scan_0.db3", "small.bag", "sender-before.txt", "sender-after.txt"),
    *("sender-sources-before.txt", "sender-sources-after.txt"),
}


def test_large_files_are_fetched_in_pieces_and_small_files_in_an_archive(robot: LossyRobot, into: Path) -> None:
    progress: list[tuple[str, float]] = []
    fetch(robot, into, progress=FetchProgress(lambda text, left_s: progress.append((text, left_s))))
    assert names(into) == ALL_FILES
    assert (into / "camera.bag").read_bytes() == LARGE[::-1]
    assert (into / "scan" / "scan_0.db3").read_bytes() == LARGE
    assert (into / "small.bag").read_bytes() == SMALL
    assert robot.pieces == [0, 1, 2, 0, 1, 2]


def test_two_robots_cannot_use_the_same_file_name(
    robot: LossyRobot, into: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rename = Path.rename

    def rename_with_conflict(self: Path, to: Path) -> Path:
        with pytest.raises(FileExistsError):  # as if the other robot sent its file now
            to.open("xb").close()
        return rename(self, to)

    monkeypatch.setattr(Path, "rename", rename_with_conflict)
    fetch(robot, into)
    assert names(into) == ALL_FILES


FALSE_OUTPUTS = {
    "wc": [
        "",
        "exit 3",
        "echo text; echo text",
        'shift 2; for f do echo "-5 $f"; done',
        'shift 2; for f do echo "0 $f"; done',
    ],
    "dd": ["", "head -c 100000 /dev/zero", "head -c 4194304 /dev/zero", "head -c 9000000 /dev/zero"],
    "sha256sum": ["", "echo text"],
    "tar": ["", "exit 2", "head -c 100000 /dev/zero", "head -c 100000 /dev/urandom"],
}


@pytest.mark.parametrize(
    ("tool", "false_output"),
    [(tool, false_output) for tool, false_outputs in FALSE_OUTPUTS.items() for false_output in false_outputs],
)
def test_wrong_output_of_tools_on_a_robot_is_detected(tmp_path: Path, tool: str, false_output: str) -> None:
    home, into, tools = (tmp_path / name for name in ("home", "into", "bin"))
    for folder in (home, into, tools):
        folder.mkdir()
    robot = LossyRobot(home, f"{tools}:{os.environ['PATH']}")
    jobs.install(robot, Deadline.after(30))
    evidence.begin(robot, FOLDER, "sender", "lo", required_kib=0)
    (home / FOLDER / "camera.bag").write_bytes(LARGE)
    (tools / tool).write_text(f"#!/bin/sh\n{false_output}\n", encoding="ascii")
    (tools / tool).chmod(0o755)
    with pytest.raises((EvidenceError, RobotError)):
        fetch(robot, into)
    # Files of a truncated archive are kept like the files of any void attempt.
    assert not (into / "camera.bag").exists() or (into / "camera.bag").stat().st_size < len(LARGE)
    assert not [name for name in names(into) if name.endswith((".tar", ".piece"))]
    robot.close()


def test_interrupted_fetch_continues_from_its_last_piece(robot: LossyRobot, into: Path) -> None:
    robot.lost_at = lambda number: number == 2
    with pytest.raises(LinkError):
        fetch(robot, into)
    for path in into.glob("*.*"):
        if not path.name.startswith("."):
            path.unlink()
    robot.lost_at = lambda _: False
    fetch(robot, into)
    assert names(into) == ALL_FILES
    assert robot.pieces == [0, 1, 2, 2, 0, 1, 2]
    assert (into / "camera.bag").read_bytes() == LARGE[::-1]


def test_wrong_piece_of_an_earlier_fetch_is_detected_and_fetched_again(robot: LossyRobot, into: Path) -> None:
    (into / ".sender.camera.bag.part").write_bytes(bytes(PIECE_BYTES + 99))
    with pytest.raises(EvidenceError, match=r"hash differs: camera\.bag"):
        fetch(robot, into)
    for path in filter(Path.is_file, list(into.iterdir())):
        path.unlink()
    fetch(robot, into)
    assert (into / "camera.bag").read_bytes() == LARGE[::-1]


def test_more_evidence_than_expected_is_not_fetched_and_is_reported(
    robot: LossyRobot, into: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(fetching, "ALWAYS_ALLOWED_BYTES", 1000)
    monkeypatch.setattr(fetching, "UNEXPECTED_SHARE", 0.0)
    with pytest.raises(
        EvidenceError,
        match=r"17 MB must be fetched \(camera\.bag, scan/scan_0\.db3\), but at most 4\.0 MB are fetched",
    ):
        fetch(robot, into, expected_bytes=1_000_000)
    assert robot.pieces == []
    assert (robot.home / FOLDER / "camera.bag").is_file()
    second_folder = into.with_name("again")
    second_folder.mkdir()
    fetch(robot, second_folder, expected_bytes=10_000_000)
    assert names(second_folder) == ALL_FILES


def test_more_evidence_than_the_free_space_is_not_fetched_and_is_reported(
    robot: LossyRobot, into: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(files, "free_bytes", lambda _: fetching.RESERVE_BYTES + 5_000_000)
    with pytest.raises(EvidenceError, match=r"17 MB must be fetched .* but 5\.0 MB are free here"):
        fetch(robot, into)


def test_file_that_became_smaller_is_reported(robot: LossyRobot, into: Path) -> None:
    def truncate_file(number: int) -> bool:
        if number == 1:
            os.truncate(robot.home / FOLDER / "camera.bag", PIECE_BYTES + 10)
        return False

    robot.lost_at = truncate_file
    with pytest.raises(EvidenceError, match=r"sent 10 bytes of camera\.bag from byte 4194304 on, instead of 4194304"):
        fetch(robot, into)


def test_missing_folder_is_reported(robot: LossyRobot, into: Path) -> None:
    evidence.discard(robot, "trial")
    with pytest.raises(NoFolderError, match=rf"it no longer has folder {FOLDER}($|: the robot booted \d+ s ago)"):
        fetch(robot, into)


def test_unfetched_folders_are_not_deleted(robot: LossyRobot) -> None:
    for number in (2, 3):
        evidence.begin(robot, jobs.work_folder("trial", f"udp-0{number}-1"), "sender", "lo", required_kib=0)
    evidence.discard(robot, "trial", kept_folders=[FOLDER, jobs.work_folder("trial", "udp-03-1")])
    assert sorted(path.name for path in (robot.home / ".fieldkit/trial").iterdir()) == ["udp-01-1", "udp-03-1"]
    evidence.discard(robot, "trial")
    assert not (robot.home / ".fieldkit/trial").exists()


class HostileShell(LocalShell):
    """A robot that sends any list of large files, and any hashes."""

    def __init__(self, home: Path, large_list: str, hashes: bytes = b"") -> None:
        super().__init__(home)
        (home / "x").write_bytes(b"x")
        digest = hashlib.sha256(b"x").hexdigest()
        (home / ".sums-1").write_text(f"{digest}  x\n", encoding="ascii")
        (home / ".large-1").write_text(large_list, encoding="utf-8")
        self.hashes = hashes

    def fetch(self, argv: Sequence[str], to: Path, *, deadline: Deadline, limit_bytes: int) -> Completed:
        if argv[2] == "pack":
            return super().fetch(
                ("tar", "-cf", "-", ".sums-1", ".large-1", "x"), to, deadline=deadline, limit_bytes=1 << 20
            )
        to.write_bytes(bytes(limit_bytes))
        return Completed(tuple(argv), 0, b"", b"")

    def run(self, argv: Sequence[str], *, deadline: Deadline, stdin: bytes = b"", check: bool = True) -> Completed:
        if argv[0] == "tar":
            return super().run(argv, deadline=deadline)
        return Completed(tuple(argv), 0, self.hashes, b"")


@pytest.mark.parametrize(
    ("large_list", "message"),
    [
        ("100 ../../evil\n", "not a regular file"),
        ("100 /etc/evil\n", "not a regular file"),
        ("100 -rf\n", "not a regular file"),
        ("-1 a.bag\n", "not a regular file"),
        ("a.bag\n", "not a regular file"),
        (f"{10**14} a.bag\n", "must be fetched"),
        ("".join(f"1 f{number}\n" for number in range(501)), "more than 500 files"),
        ("100 x\n", "sent before"),
        ("100 a.bag\n", "hash differs"),
    ],
)
def test_list_of_a_robot_cannot_leave_the_folder_or_fill_the_disk(
    tmp_path: Path, large_list: str, message: str
) -> None:
    home, into = tmp_path / "home", tmp_path / "outer" / "into"
    home.mkdir()
    into.mkdir(parents=True)
    hashes = f"{hashlib.sha256(bytes(100)).hexdigest()}  {'x' if 'x' in large_list else 'y'}\n"
    with pytest.raises((EvidenceError, RobotError), match=message):
        fetching.fetch(HostileShell(home, large_list, hashes.encode()), FOLDER, "sender", "lo", into)
    assert [path.name for path in (tmp_path / "outer").iterdir()] == ["into"]
    assert names(into) <= {"x", ".sender.x.part"}
