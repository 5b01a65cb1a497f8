import subprocess
from pathlib import Path

import pytest

from fieldkit.config import schema
from fieldkit.core.errors import ConfigurationError, EvidenceError
from fieldkit.core.model import Protocol, RepeatId
from fieldkit.trial import manifest, store
from fieldkit.trial.hashes import code_hash
from fieldkit.trial.plan import Plan
from fieldkit.trial.stored import plans, verification
from tests.helpers.casts import los_plan, plain_plan


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    trial_folder = store.create(tmp_path, plain_plan())
    partial = store.open_attempt(trial_folder, RepeatId(Protocol.UDP, 1))
    (partial / "scan.bag").write_bytes(b"#ROSBAG V2.0\n" * 100)
    (partial / "ping.txt").write_text("PING", encoding="utf-8")
    (partial / "scan").mkdir()
    (partial / "scan" / "scan_0.db3").write_bytes(b"SQLite format 3\0" * 9)
    new_manifest = manifest.Manifest(trial_folder)
    new_manifest.add(store.commit_attempt(partial, "udp-01"))
    new_manifest.write()
    return trial_folder


def test_a_plan_is_written_and_read_back(folder: Path) -> None:
    assert plans.read_plan(folder) == plain_plan()
    assert schema.dump(plans.read_plan(folder)) == (folder / "trial.yaml").read_text(encoding="utf-8")


@pytest.mark.ros
def test_a_plan_contains_all_inputs_of_a_trial() -> None:
    plan = los_plan(record_s=2.0)
    text = schema.dump(plan)
    assert "duration: 2s" in text
    assert plan.code_sha256 == code_hash()
    assert plan.distance_m == pytest.approx(9.144)
    assert schema.validate(schema.parse(text, source="x"), Plan).procedure == plan.procedure


@pytest.mark.parametrize("name", ["../..", ".", "a/b", "", "-rf"])
def test_a_plan_with_an_invalid_folder_name_is_rejected(folder: Path, name: str) -> None:
    """Robots remove the folder with this name."""
    path = folder / "trial.yaml"
    text = path.read_text(encoding="utf-8")
    path.write_text(text.replace(f"trial: {plain_plan().trial}", f"trial: '{name}'"), encoding="utf-8")
    with pytest.raises(ConfigurationError, match=r"in trial: ") as caught:
        plans.read_plan(folder)
    assert caught.value.where.startswith(str(path))


def test_verification_and_sha256sum_find_no_changes_in_an_unchanged_trial(folder: Path) -> None:
    assert verification.verify(folder) == []
    subprocess.run(("sha256sum", "--check", "--quiet", store.MANIFEST_FILE), cwd=folder, check=True)


@pytest.mark.parametrize("name", ["trial.yaml", "repeats/udp-01/scan.bag", "repeats/udp-01/scan/scan_0.db3"])
def test_one_changed_bit_is_found(folder: Path, name: str) -> None:
    content = bytearray((folder / name).read_bytes())
    content[len(content) // 2] ^= 1
    (folder / name).write_bytes(content)
    assert verification.verify(folder) == [f"{name}: changed"]


def test_missing_and_additional_files_are_found(folder: Path) -> None:
    (folder / "repeats/udp-01/ping.txt").unlink()
    (folder / "repeats/udp-01/notes.txt").write_text("x", encoding="utf-8")
    assert verification.verify(folder) == [
        "repeats/udp-01/notes.txt: not in the manifest",
        "repeats/udp-01/ping.txt: missing",
    ]


def test_files_of_an_interrupted_attempt_are_not_in_the_manifest(folder: Path) -> None:
    partial = store.open_attempt(folder, RepeatId(Protocol.TCP, 1))
    (partial / "half.pcap").write_bytes(b"x")
    assert verification.verify(folder) == []
    assert list(store.open_attempt(folder, RepeatId(Protocol.TCP, 1)).iterdir()) == []


def test_a_folder_without_a_trial_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(ConfigurationError, match=r"there is no trial\.yaml"):
        plans.read_plan(tmp_path)
    with pytest.raises(EvidenceError, match="no readable manifest"):
        verification.verify(tmp_path)


def test_an_out_folder_that_cannot_be_created_is_an_error(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("", encoding="utf-8")
    with pytest.raises(ConfigurationError, match="cannot create"):
        store.create(tmp_path / "file", plain_plan())


def test_partially_fetched_files_are_kept_only_for_the_next_fetch(folder: Path) -> None:
    repeat = RepeatId(Protocol.TCP, 1)
    partial = store.open_attempt(folder, repeat)
    (partial / "scan").mkdir()
    for name in ("ping.txt", ".sender.camera.bag.part", "scan/scan_0.db3"):
        (partial / name).write_bytes(b"x")
    assert store.reopen_attempt(folder, repeat) == partial
    assert [path.name for path in partial.iterdir()] == [".sender.camera.bag.part"]
    attempt = store.commit_attempt(partial, "tcp-01.void1")
    assert list(attempt.iterdir()) == []
    assert list(store.reopen_attempt(folder, repeat).iterdir()) == []
