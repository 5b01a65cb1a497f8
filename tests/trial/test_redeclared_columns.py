"""Commands with a trial whose declared columns do not match its values: errors with a remedy, no traceback."""

import re
import shutil
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path

import pytest

from fieldkit.cli import main
from fieldkit.config.schema import parse, validate
from fieldkit.core.units import parse_distance
from fieldkit.trial import store
from fieldkit.trial.plan import PLAN_FILE
from fieldkit.trial.procedure import Procedure
from fieldkit.trial.request import TrialRequest, make_plan
from fieldkit.trial.running.robots import Robots
from fieldkit.trial.running.runner import run_trial
from tests.helpers.casts import CAST
from tests.helpers.idle_testbed import IdleTestbed
from tests.helpers.nightly import mark_nightly
from tests.helpers.plans import write_states
from tests.trial.test_trial_crash import robots_with_evidence

PROCEDURE = """\
name: small
summary: x
scenario: los
topology: master
protocols: [tcp]
repeats: 3
steps:
  - run:
      robot: sender
      command: show
      columns: [{name: own, unit: %s, json: own}]
"""
NOW = datetime(2026, 11, 20, 12, 0, tzinfo=UTC)
VALUES = {"V": "-3.25", "text": '"full"', "bool": "true", "count": "7", "ns": "1795000000000000000"}
UNITS = (*VALUES, "share")


def fetch_text(text: str) -> Callable[..., list[str]]:
    def fetch(_self: Robots, _remote: str, into: Path, *, ended_normally: bool) -> list[str]:
        (into / "run.txt").write_text(text, encoding="utf-8")
        write_states(into)
        return []

    return fetch


@pytest.fixture(scope="module")
def trials(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """A trial for each unit, with a value in this unit."""
    folders = {}
    with pytest.MonkeyPatch.context() as patch:
        robots_with_evidence(patch)
        for unit, value in VALUES.items():
            text = f'{{"own": {value}}}'
            patch.setattr(Robots, "fetch", fetch_text(text))
            request = TrialRequest(validate(parse(PROCEDURE % unit, source="x"), Procedure), parse_distance("30ft"))
            trial_plan = make_plan(request, backend="field", cast=CAST, now=NOW)
            outcome = run_trial(trial_plan, IdleTestbed(), tmp_path_factory.mktemp(unit), lambda _: None)
            assert outcome is not None
            assert outcome.valid == 3
            folders[unit] = outcome.folder
    return folders


@pytest.mark.parametrize("new_unit", UNITS)
@pytest.mark.parametrize("old_unit", mark_nightly(VALUES, in_ci=("V", "text")))
def test_every_command_prints_a_table_or_an_error(
    trials: dict[str, Path],
    tmp_path: Path,
    old_unit: str,
    new_unit: str,
    capsys: pytest.CaptureFixture[str],
) -> None:
    folder = tmp_path / "trial"
    shutil.copytree(trials[old_unit], folder)
    plan = folder / PLAN_FILE
    plan_text = plan.read_text(encoding="utf-8")
    head, table, columns = plan_text.partition("\ncolumns:\n")  # the text of the procedure before is unchanged
    changed_columns, count = re.subn(rf"(name: own\n\s*unit: ){old_unit}\b", rf"\g<1>{new_unit}", columns)
    assert count == 1, plan_text
    plan.write_text(head + table + changed_columns, encoding="utf-8")
    (folder / store.MANIFEST_FILE).unlink()
    before = (folder / store.TRIAL_CSV).read_bytes()
    out = str(tmp_path / "out")
    for words in (
        ("rebuild", str(folder)),
        ("aggregate", str(folder), "--rebuild"),
        ("aggregate", str(folder)),
        ("aggregate", str(folder), str(trials[old_unit])),
        ("export", str(folder), "--format", "csv", "-o", f"{out}.csv"),
        ("export", str(folder), "--format", "parquet", "-o", f"{out}.parquet"),
    ):
        code = main([*words])
        output_text = capsys.readouterr().err
        assert code in {0, 2, 4}, words
        assert "Traceback" not in output_text
        if code:
            assert "remedy:" in output_text, (words, output_text)
            assert "own" in output_text or "trial.yaml" in output_text, (words, output_text)
        if words[0] == "rebuild" and code:
            assert (folder / store.TRIAL_CSV).read_bytes() == before, "nothing is written"
