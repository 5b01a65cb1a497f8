"""The command `positions`, which adds positions after a trial: stored files, checksums, errors, and removal."""

import shutil
from pathlib import Path

import pytest

from fieldkit.cli import main
from fieldkit.core.errors import ConfigurationError
from fieldkit.core.model import Role
from fieldkit.measure.evidence import ping
from fieldkit.measure.positions.position_sources import PositionSource
from fieldkit.measure.positions.samples import LOCAL, WGS84
from fieldkit.trial import journal
from fieldkit.trial.stored import positions, verification
from tests.helpers.runs import rows
from tests.helpers.stored_trials import TRIALS


@pytest.fixture
def trial(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A copy of a stored trial in the working directory."""
    (stored_trial,) = TRIALS.glob("*_driveaway_*")
    shutil.copytree(stored_trial, tmp_path / "trial")
    monkeypatch.chdir(tmp_path)
    return Path("trial")


def replies_ns(trial: Path) -> list[int]:
    files = sorted(trial.glob("repeats/*/ping.txt"))
    return [at_ns for file in files for reply in ping.read(file).answers if (at_ns := reply.at_utc_ns)]


def write_walk(trial: Path, name: str = "walk.csv", *, late_ns: int = 0) -> list[int]:
    """Write positions of a walk at 1 m/s from 5 m away; return the times of the replies after its start in ns."""
    at_ns = replies_ns(trial)
    first_ns, last_ns = min(at_ns) - 60 * 10**9, max(at_ns) + 60 * 10**9
    lines = (f"{first_ns - late_ns},5,0", f"{last_ns - late_ns},{5 + (last_ns - first_ns) / 1e9},0")
    Path(name).write_text("\n".join(("t_ns,x_m,y_m", *lines, "")), encoding="ascii")
    return [time_ns - first_ns for time_ns in at_ns]


def run_positions(capsys: pytest.CaptureFixture[str], *words: str) -> tuple[int, str]:
    code = main(["positions", "trial", *words])
    output = capsys.readouterr()
    return code, output.out + output.err


def means_m(trial: Path) -> list[str]:
    return [row["rtt_distance_mean_m"] for row in rows(trial) if row["status"] == "valid"]


@pytest.mark.motion
def test_added_positions_fill_columns_have_checksums_and_can_be_removed(
    trial: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = {path.name: path.read_bytes() for path in trial.iterdir() if path.is_file()}
    elapsed_ns = write_walk(trial)
    code, output = run_positions(capsys, "receiver=walk.csv", "sender=0m,0m", "--gap", "1000min")
    assert code == 0, output
    assert output.startswith("changed: trial.csv")
    means = [float(metres) for metres in means_m(trial)]
    assert all(65 <= metres <= 5 + max(elapsed_ns) / 1e9 for metres in means)
    assert verification.verify(trial) == []
    assert {path.name for path in trial.glob("positions*")} == {"positions.json", "positions-receiver.csv"}
    assert run_positions(capsys)[1].count("sender 0, 0, 0 in metres, receiver positions-receiver.csv") == 2 * len(
        means
    )

    write_walk(trial, "again.CSV", late_ns=2 * 10**9)
    run_positions(capsys, "receiver=again.CSV", "sender=0m,0m", "--gap", "1000min", "--offset", "-1s")
    assert [float(metres) for metres in means_m(trial)] == pytest.approx([metres + 3 for metres in means])
    run_positions(capsys, "receiver=again.CSV", "sender=0m,0m")
    assert means_m(trial) == [""] * len(means)
    assert "have a gap of" in run_positions(capsys)[1]

    assert run_positions(capsys, "--clear")[0] == 0
    assert {path.name: path.read_bytes() for path in trial.iterdir() if path.is_file()} == before


@pytest.mark.motion
@pytest.mark.parametrize(
    ("words", "code", "expected_message"),
    [
        (["walk.csv"], 2, "'walk.csv' is not ROLE=FILE"),
        (["Receiver=walk.csv"], 2, "is not ROLE=FILE"),
        (["receiver="], 2, "is not ROLE=FILE"),
        (["reciever=walk.csv"], 2, "did you mean 'receiver'"),
        (["receiver=nowhere.csv"], 2, "there is no such file"),
        (["receiver=91,0"], 2, "there is no such file"),
        (["receiver=trial"], 2, "there is no such file"),
        (["receiver=walk.txt"], 4, "neither GPX nor CSV"),
        (["receiver=bad.csv"], 4, "bad.csv:2: 'noon' is not a time"),
        (["receiver=huge.gpx"], 2, "huge.gpx: it has 67 MB"),
        (["receiver=walk.csv", "--offset", "3"], 2, "has no unit"),
        (
            ["receiver=walk.csv", "--offset", "99999999999s"],
            2,
            "the position of receiver has a number that is too large",
        ),
        (["receiver=walk.csv", "--gap", "99999999999s"], 2, "a number that is too large"),
        (["receiver=99999999999m,0m"], 2, "a number that is too large"),
        (["receiver=48.1,11.5,1e308"], 2, "a number that is too large"),
        (["receiver=walk.csv", "--gap", "soon"], 2, "'soon' is not a --gap"),
        (["receiver=walk.csv", "--clear"], 2, "--clear removes the stored files"),
    ],
)
def test_invalid_positions_are_rejected_and_change_nothing(
    trial: Path, capsys: pytest.CaptureFixture[str], words: list[str], code: int, expected_message: str
) -> None:
    write_walk(trial)
    shutil.copy("walk.csv", "walk.txt")
    Path("bad.csv").write_text("t,x_m,y_m\nnoon,1,2\n", encoding="ascii")
    with Path("huge.gpx").open("wb") as huge_file:
        huge_file.truncate(positions.MAX_BYTES + 1)
    before = {path: path.read_bytes() for path in trial.iterdir() if path.is_file()}
    exit_code, output = run_positions(capsys, *words)
    assert (exit_code, expected_message in output) == (code, True), output
    assert {path: path.read_bytes() for path in trial.iterdir() if path.is_file()} == before


@pytest.mark.motion
def test_changed_or_running_trials_accept_no_positions(trial: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_walk(trial)
    with journal.locked(trial):
        assert run_positions(capsys, "receiver=walk.csv")[0] == 2
    file = next(trial.glob("repeats/*/ping.txt"))
    file.write_bytes(file.read_bytes() + b"\n")
    code, output = run_positions(capsys, "receiver=walk.csv")
    assert (code, "the evidence has changed since it was measured" in output) == (4, True)
    assert not list(trial.glob("positions*"))


@pytest.mark.motion
@pytest.mark.parametrize("change", ["changed", "gone", "unsummed"])
def test_changed_position_files_prevent_a_rebuild(
    trial: Path, capsys: pytest.CaptureFixture[str], change: str
) -> None:
    write_walk(trial)
    assert run_positions(capsys, "receiver=walk.csv", "sender=0m,0m", "--gap", "1000min")[0] == 0
    positions_file = trial / "positions-receiver.csv"
    if change == "changed":
        positions_file.write_bytes(positions_file.read_bytes() + b"\n")
    elif change == "gone":
        positions_file.unlink()
    else:
        shutil.copy(positions_file, trial / "positions-sender.csv")
    assert main(["rebuild", "trial"]) == 4
    assert "positions-" in capsys.readouterr().err
    assert run_positions(capsys, "--clear")[0] == 0
    assert main(["rebuild", "trial"]) == 0


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("sender=48.1,-11.5", PositionSource(place=(48.1, -11.5, None), frame=WGS84)),
        ("sender=-48.1,11.5,520", PositionSource(place=(-48.1, 11.5, 520.0), frame=WGS84)),
        ("sender=0m,10ft", PositionSource(place=(0.0, 3.048, 0.0), frame=LOCAL)),
        ("sender=-1m,2m,3m", PositionSource(place=(-1.0, 2.0, 3.0), frame=LOCAL)),
        ("sender=walk.gpx", Path("walk.gpx")),
        ("sender=1,2m", Path("1,2m")),
        ("sender=1,2,3,4", Path("1,2,3,4")),
        ("sender=nan,2", Path("nan,2")),
        ("sender=a=b.gpx", Path("a=b.gpx")),
    ],
)
def test_coordinates_are_distinguished_from_a_file(text: str, expected: object) -> None:
    assert positions.parse_source(text) == (Role.SENDER, expected)


def test_an_invalid_pair_is_rejected() -> None:
    with pytest.raises(ConfigurationError, match="not ROLE=FILE"):
        positions.parse_source("=walk.gpx")
