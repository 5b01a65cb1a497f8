"""Files that a robot must not send, because only the laptop, its testbed or another robot writes them."""

import hashlib
from itertools import product
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fieldkit.core import laptop_files
from fieldkit.core.errors import EvidenceError
from fieldkit.core.model import FaultKind, Protocol, RepeatId, Role
from fieldkit.measure.transfers import recoveries
from fieldkit.remote import fetching
from fieldkit.trial.owners import FileOwners
from tests.helpers.casts import los_plan
from tests.remote.test_remote_fuzz import AnsweringRobot, entry

PLAN = los_plan()
OWNERS = FileOwners.of_procedure(PLAN.procedure, PLAN.scene(RepeatId(Protocol.UDP, 1), ""))
LAPTOP_FILES = (
    *("medium.txt", "track.csv", "link.csv", "lateness.txt", "MANIFEST.sha256", "air.pcap", "air.csv"),
    *("answer-grass.txt", "receiver-unfetched.txt", "positions.json", "trial.yaml", "trial.csv", "journal.jsonl"),
    *(recoveries.fault_times_file(kind) for kind in FaultKind),
)


def archive(*names: str, large: str = "") -> bytes:
    content = b"1 2 3\n"
    sums = "".join(f"{hashlib.sha256(content).hexdigest()}  {name}\n" for name in names)
    files = {".sums-1": sums.encode(), ".large-1": large.encode(), **dict.fromkeys(names, content)}
    return b"".join(entry(name.encode(), data) for name, data in files.items()) + bytes(1024)


def fetch(data: bytes, into: Path, role: Role = Role.SENDER) -> None:
    shell = AnsweringRobot(into, data)
    fetching.fetch(shell, "x", role, "lo", into, forbidden_reason=lambda name: OWNERS.refusal(role, name))


def test_files_of_the_robot_are_accepted(tmp_path: Path) -> None:
    fetch(archive("sender.pcap", "sender-after.txt", "ping.txt", "notes.txt", "scan.bag"), tmp_path)
    assert (tmp_path / "ping.txt").exists()


@pytest.mark.parametrize("name", LAPTOP_FILES)
def test_files_of_the_laptop_are_rejected(name: str, tmp_path: Path) -> None:
    forms = product(("{}", "up.{}", "scan/{}", "scan/up.{}"), (name, name.upper(), name.title()))
    for number, (form, spelling) in enumerate(forms):
        folder, forbidden_name = tmp_path / str(number), form.format(spelling)
        folder.mkdir()
        with pytest.raises(EvidenceError, match="only the laptop writes a file of this name"):
            fetch(archive("ping.txt", forbidden_name), folder)
        assert not (folder / forbidden_name).exists()


def test_large_file_of_the_laptop_is_rejected(tmp_path: Path) -> None:
    with pytest.raises(EvidenceError, match="only the laptop writes"):
        fetch(archive("ping.txt", large="99999999 track.csv\n"), tmp_path)


@pytest.mark.parametrize("name", ["./medium.txt", "../track.csv", "/track.csv", "a//track.csv", ".track.csv"])
def test_other_spellings_of_a_name_are_rejected(name: str, tmp_path: Path) -> None:
    with pytest.raises(EvidenceError):
        fetch(archive("ping.txt", name), tmp_path)
    assert not list(tmp_path.rglob("*track.csv")) + list(tmp_path.rglob("*medium.txt"))


@pytest.mark.parametrize(
    ("role", "name"),
    [
        (Role.RECEIVER, "ping.txt"),
        (Role.RECEIVER, "PING.txt"),
        (Role.RECEIVER, "scan.bag"),
        (Role.SENDER, "recv.bag"),
        (Role.SENDER, "receiver.pcap"),
        (Role.SENDER, "Receiver-After.txt"),
        (Role.SENDER, "up.receiver-iperf3.json"),
    ],
)
def test_files_of_another_robot_are_rejected(role: Role, name: str, tmp_path: Path) -> None:
    with pytest.raises(EvidenceError, match="only the robot in role"):
        fetch(archive(name), tmp_path, role)


@given(st.sampled_from(LAPTOP_FILES), st.lists(st.booleans(), min_size=30, max_size=30))
def test_name_is_reserved_in_any_case(name: str, is_upper: list[bool]) -> None:
    mixed_case = "".join(
        letter.upper() if is_upper_letter else letter for letter, is_upper_letter in zip(name, is_upper, strict=False)
    )
    assert laptop_files.is_reserved(mixed_case)


@pytest.mark.parametrize("name", ["sender-link.txt", "ping.txt", "my-track.csv.gz", "answers.txt", "x.trial.csv.bak"])
def test_other_names_are_not_reserved(name: str) -> None:
    assert not laptop_files.is_reserved(name)
