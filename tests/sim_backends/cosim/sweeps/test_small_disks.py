"""A sweep and an index on a real file system that is full: a tmpfs in a mount namespace."""

import subprocess
import sys
from pathlib import Path
from typing import Final

import pytest

from tests.helpers.paths import ROOT
from tests.helpers.runs import run_here
from tests.helpers.task_workers import PAIR

pytestmark = pytest.mark.emulated

SWEEP: Final = ("cosim", "sweep", "pair.yaml", "--over", "window=7ms,13ms", "--seeds", "4")
RUNS: Final = 8
LIMIT_S: Final = 600


def run_in_mount_namespace(folder: Path, script: str) -> str:
    """Return the output of a shell script; `$PYTHON` is the interpreter, and mounts vanish with the script."""
    namespace = ("unshare", "--mount", "--propagation", "private", "--", "sh", "-euc", script)
    environment = {"PATH": "/usr/sbin:/usr/bin:/sbin:/bin", "PYTHONPATH": str(ROOT), "HOME": str(folder)}
    environment["PYTHON"] = sys.executable
    result = subprocess.run(
        namespace, cwd=folder, env=environment, capture_output=True, text=True, timeout=LIMIT_S, check=False
    )
    assert result.returncode == 0, result.stdout + result.stderr
    return result.stdout


def read_dataset(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*.parquet")}


def test_a_sweep_on_a_full_disk_keeps_its_finished_runs_and_continues(tmp_path: Path) -> None:
    (tmp_path / "pair.yaml").write_text(PAIR, encoding="utf-8")
    (tmp_path / "disk").mkdir()
    words = " ".join(SWEEP)
    output = run_in_mount_namespace(
        tmp_path,
        f"""mount -t tmpfs -o size=24k tmpfs disk
        "$PYTHON" -m fieldkit {words} --jobs 2 -o disk/sweep 2>&1 || echo "exit code $?"
        echo "count: $(ls disk/sweep/runs | grep -c 'json$')"
        for file in disk/sweep/runs/*.json; do "$PYTHON" -m json.tool "$file" > /dev/null; done
        mount -o remount,size=16m disk
        "$PYTHON" -m fieldkit {words} --jobs 1 -o disk/sweep 2>&1
        cp -r disk/sweep copy""",
    )
    assert "No space left on device" in output
    assert "exit code 2\n" in output
    finished_runs = int(output.split("count: ")[1].split()[0])
    assert 0 < finished_runs < RUNS
    assert f"{finished_runs} are done" in output
    assert run_here(tmp_path, *SWEEP, "--jobs", "1", "-o", "reference").code == 0
    assert read_dataset(tmp_path / "copy") == read_dataset(tmp_path / "reference")
    assert read_dataset(tmp_path / "copy")
