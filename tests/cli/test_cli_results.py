"""The commands that the result of a trial suggests next."""

import argparse
import shlex
from pathlib import Path

import pytest

from fieldkit.cli import cli_options, main, results
from fieldkit.core.model import Protocol, Topology
from fieldkit.trial.plan import Plan
from fieldkit.trial.running import resumption
from fieldkit.trial.running.runner import Outcome
from tests.analysis.test_lines import PINGED, cells_of
from tests.helpers.casts import los_plan
from tests.helpers.tables import RepeatRow, replace


def commands(capsys: pytest.CaptureFixture[str], *rows: RepeatRow, all_quantities: bool = False) -> list[str]:
    """Return the commands suggested after trials of one row each."""
    outcomes = [Outcome(Path(f"trials/{number}"), cells_of([row]), 1, 0) for number, row in enumerate(rows)]
    assert results.report(outcomes, argparse.Namespace(json=False, all=all_quantities, junit=None)) == 0
    text = capsys.readouterr().out
    return [line.strip() for line in text[text.index("next: ") :].removeprefix("next: ").splitlines()]


def test_suggested_commands_are_valid(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    report, all_quantities, next_distance = commands(capsys, PINGED)
    assert (report, all_quantities) == (
        "fieldkit report trials/0",
        "fieldkit aggregate trials/0 --all  # 2 more quantities",
    )
    assert next_distance == "fieldkit trial los 60ft  # another distance"
    _, *argv = shlex.split(next_distance, comments=True)
    assert main([*argv, "--dry-run"]) == 0


@pytest.mark.parametrize(
    ("distances", "next_distance"),
    [
        (["10m", "15m"], "20m"),
        (["2.5m"], "5m"),
        (["10m", "30ft"], "60ft"),
        (["0.0000001mm"], "0.0000002mm"),
        (["800000000mm"], "1600000000mm"),
        (["porch"], None),
        (["30ft", "30ft"], None),
    ],
)
def test_suggested_distance_continues_the_series(
    capsys: pytest.CaptureFixture[str], distances: list[str], next_distance: str | None
) -> None:
    suggested_commands = commands(
        capsys, *(replace(PINGED, distance=distance) for distance in distances), all_quantities=True
    )
    assert suggested_commands[1:] == (
        [f"fieldkit trial los {next_distance}  # another distance"] if next_distance else []
    )


def test_no_larger_distance_is_suggested_if_no_ping_was_answered(capsys: pytest.CaptureFixture[str]) -> None:
    without_reply = replace(PINGED, rtt_received=0, rtt_loss=1.0, rtt_median_s=None)
    assert commands(capsys, without_reply, all_quantities=True) == ["fieldkit report trials/0"]


@pytest.mark.parametrize(
    ("plan", "options"),
    [
        (los_plan(repeats=20), ""),
        (
            los_plan(repeats=3, protocols=(Protocol.UDP,), record_s=2.5),
            "--protocol udp --repeats 3 --record 2.5s ",
        ),
        (los_plan(repeats=20).model_copy(update={"topology": Topology.MASTERLESS}), "--topology masterless "),
    ],
    ids=["defaults", "measurement", "topology"],
)
def test_after_resume_the_suggested_trial_has_the_options_of_the_resumed_trial(
    plan: Plan, options: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    outcome = Outcome(Path("trials/1"), cells_of([PINGED]), 1, 0)
    monkeypatch.setattr(resumption, "resumable", lambda _folder: plan)
    monkeypatch.setattr(cli_options, "backend", lambda *_: ("field", None))
    monkeypatch.setattr(resumption, "resume", lambda *_, **__: outcome)
    assert main(["resume", "trials/1", "--yes"]) == 0
    assert f"fieldkit trial {options}los 60ft" in capsys.readouterr().out
