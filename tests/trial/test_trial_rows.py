"""Rows that a later version of fieldkit measures again from the evidence."""

from pathlib import Path

from fieldkit.core.columns import SCHEMA_VERSION
from fieldkit.trial.plan import PLAN_FILE
from fieldkit.trial.stored.rebuild import rebuild
from tests.helpers.recorded import make_plain
from tests.helpers.runs import rows


def test_a_rebuilt_row_has_the_schema_version_of_its_measurement(tmp_path: Path) -> None:
    folder = make_plain(tmp_path)
    plan = folder / PLAN_FILE
    current = f"schema_version: {SCHEMA_VERSION}\n"
    old = plan.read_text(encoding="utf-8")
    assert current in old
    plan.write_text(old.replace(current, "schema_version: 1\n"), encoding="utf-8")
    assert rebuild(folder).changed == ()
    assert {row["schema_version"] for row in rows(folder)} == {str(SCHEMA_VERSION)}
