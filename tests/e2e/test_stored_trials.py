"""Trials of an earlier version of fieldkit, whose outputs must stay as that version wrote them."""

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
    with stored_trials.copied(tmp_path) as copies:
        yield copies


def differing(trials: list[Path]) -> list[str]:
    """Return the outputs that differ from those of the version that ran the trials."""
    written = dict(stored_trials.texts(trials))
    assert written.keys() == {path.name for path in OUTPUTS.iterdir()}
    return [name for name, text in written.items() if text != (OUTPUTS / name).read_text(encoding="utf-8")]


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
    listed = {Path(line.split("  ", 1)[1]) for line in (TRIALS / name / "MANIFEST.sha256").read_text().splitlines()}
    assert listed - stored_files == set(), "a name that git ignores?"


def test_every_output_is_unchanged(trials: list[Path]) -> None:
    assert differing(trials) == []


def test_every_output_from_raw_evidence_is_the_same(trials: list[Path]) -> None:
    command_output("export", "trials", "--rebuild", "--format", "csv", "-o", "again.csv")
    assert Path("again.csv").read_bytes() == (OUTPUTS / "export.csv").read_bytes()


def test_changed_evidence_is_detected(trials: list[Path]) -> None:
    """Check the check: one missing echo must change nearly all outputs."""
    (lossy,) = (trial for trial in trials if trial.name.startswith("20261122T013134"))
    ping = lossy / store.REPEATS / "udp-02" / "ping.txt"
    lines = ping.read_text(encoding="utf-8").splitlines(keepends=True)
    reply = next(index for index, line in enumerate(lines) if "icmp_seq=" in line and "time=" in line)
    ping.write_text("".join(lines[:reply] + lines[reply + 1 :]), encoding="utf-8")
    assert main(["rebuild", str(lossy)]) == EvidenceError.exit_code, "its checksum no longer matches"
    (lossy / store.MANIFEST_FILE).unlink()
    assert "changed: trial.csv" in command_output("rebuild", str(lossy))
    assert {"export.csv", "mcap.json", "report.txt", "figures.json"} <= set(differing(trials))
