"""The index of tables on a file system that is full or read-only: a tmpfs in a separate mount namespace."""

import shlex
import subprocess
import sys
from pathlib import Path

import pytest

from benchmarks.archive_trials import write_archive
from fieldkit.trial.stored import indexed_tables
from tests.helpers.paths import ROOT

pytestmark = pytest.mark.emulated


def test_the_result_is_correct_if_the_cache_is_full_or_read_only(tmp_path: Path) -> None:
    write_archive(tmp_path / "trials", indexed_tables.MIN_TABLES, 2)
    (tmp_path / "cache").mkdir()
    command = f"{shlex.quote(sys.executable)} -m fieldkit aggregate trials --format csv"
    script = f"""sleep 2.1
    {command} --no-index > direct.csv
    for options in size=16k size=16m,ro; do
        mount -t tmpfs -o $options tmpfs cache
        {command} > $options.csv 2> $options.txt
        [ -z "$(find cache -type f)" ]
    done"""  # tables that are younger than 2 s get no index
    namespace = ("unshare", "--mount", "--propagation", "private", "--", "sh", "-euc", script)
    environment = {"PATH": "/usr/bin:/bin", "PYTHONPATH": str(ROOT), "XDG_CACHE_HOME": str(tmp_path / "cache")}
    completed = subprocess.run(
        namespace, cwd=tmp_path, env=environment, capture_output=True, timeout=600, check=False
    )
    assert completed.returncode == 0, completed.stderr
    direct = (tmp_path / "direct.csv").read_bytes()
    assert direct.count(b"\n") > 1
    for options in ("size=16k", "size=16m,ro"):
        assert (tmp_path / f"{options}.csv").read_bytes() == direct
        notes = (tmp_path / f"{options}.txt").read_text().splitlines()
        assert len([line for line in notes if "index" in line]) == 1
