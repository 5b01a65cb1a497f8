"""The outputs for trials of an earlier version of fieldkit must be those that the earlier version wrote."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from fieldkit.cli import main
from fieldkit.core.errors import EvidenceError
from fieldkit.trial import store
from tests.helpers import stored_trials
from tests.helpers.stored_trials import OUTPUTS, TRIALS, command_output

STORED = sorted(path.name for path in TRIALS.iterdir())


@pytest.fixture
def trials(tmp_path: Path) -> Iterator[list[Path]]:
    with stored_trials.copy_trials(tmp_path) as copies:
        yield copies


def changed_outputs(trials: list[Path]) -> list[str]:
    """Return the outputs that differ from those of the version that ran the trials."""
    outputs = dict(stored_trials.texts(trials))
    assert outputs.keys() == {path.name for path in OUTPUTS.iterdir()}
    return [name for name, text in outputs.items() if text != (OUTPUTS / name).read_text(encoding="utf-8")]


@pytest.mark.parametrize("name", STORED)
def test_rebuilt_tables_have_the_same_bytes(trials: list[Path], name: str) -> None:
    trial = Path("trials", name)
    assert "the same bytes as before" in command_output("rebuild", str(trial))
    for table in ("trial.csv", "summary.csv"):
        assert (trial / table).read_bytes() == (TRIALS / name / table).read_bytes(), table


@pytest.mark.parametrize("name", STORED)
def test_every_file_equals_its_checksum(trials: list[Path], name: str) -> None:
    command_output("verify", f"trials/{name}")
    stored_files = {path.relative_to(TRIALS / name) for path in (TRIALS / name).rglob("*") if path.is_file()}
    listed_files = {
        Path(line.split("  ", 1)[1]) for line in (TRIALS / name / "MANIFEST.sha256").read_text().splitlines()
    }
    assert listed_files - stored_files == set(), "git may ignore the name of a missing file"


def test_every_output_is_unchanged(trials: list[Path]) -> None:
    assert changed_outputs(trials) == []


def test_every_output_from_raw_evidence_is_the_same(trials: list[Path]) -> None:
    command_output("export", "trials", "--rebuild", "--format", "csv", "-o", "again.csv")
    assert Path("again.csv").read_bytes() == (OUTPUTS / "export.csv").read_bytes()


def test_changed_evidence_is_detected(trials: list[Path]) -> None:
    """One missing echo must change nearly all outputs, so the comparison of the other tests is effective."""
    (lossy,) = (trial for trial in trials if trial.name.startswith("20261122T013134"))
    ping = lossy / store.REPEATS / "udp-02" / "ping.txt"
    lines = ping.read_text(encoding="utf-8").splitlines(keepends=True)
    reply = next(index for index, line in enumerate(lines) if "icmp_seq=" in line and "time=" in line)
    ping.write_text("".join(lines[:reply] + lines[reply + 1 :]), encoding="utf-8")
    assert main(["rebuild", str(lossy)]) == EvidenceError.exit_code, "its checksum no longer matches"
    (lossy / store.MANIFEST_FILE).unlink()
    assert "changed: trial.csv" in command_output("rebuild", str(lossy))
    assert {"export.csv", "mcap.json", "report.txt", "figures.json"} <= set(changed_outputs(trials))
