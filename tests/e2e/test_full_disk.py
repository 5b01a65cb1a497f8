"""If the laptop's disk is full during a trial, the trial stops with a message and can be resumed."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.helpers.labs import built_in_ros
from tests.helpers.runs import LIMIT_S, only_trial, rows, run_here

pytestmark = pytest.mark.emulated

# The lab is on a separate small file system, visible only to this shell and its children.
SCRIPT = """\
set -e
out=$1 python=$2 lab=$3
mount -t tmpfs -o size=150m tmpfs "$lab"
cd "$lab"
cp "$out/fieldkit.yaml" .
words="--topology masterless --repeats 2 --record 1s --protocol tcp"
"$python" -m fieldkit trial los 30ft $words --json >"$out/first.json" 2>"$out/first" &
until grep -q '"transfer"' "$out/first.json"; do kill -0 $!; sleep 0.05; done
head -c 1G /dev/zero >fill 2>/dev/null || true
code=0
wait $! || code=$?
echo "exit code $code" >>"$out/first"
code=0
"$python" -m fieldkit resume trials/* --json >"$out/full.json" 2>"$out/full" || code=$?
echo "exit code $code" >>"$out/full"
rm fill
"$python" -m fieldkit resume trials/* --json >"$out/second.json" 2>"$out/second"
cp -r trials "$out"
mkdir small
mount -t tmpfs -o size=1m tmpfs small
code=0
"$python" -m fieldkit trial los 30ft --out small >"$out/small.log" 2>"$out/small" || code=$?
echo "exit code $code" >>"$out/small"
"""


def test_a_full_disk_stops_the_trial_and_resume_continues_after_cleaning_up(tmp_path: Path) -> None:
    out, lab = tmp_path / "out", tmp_path / "lab"
    out.mkdir()
    lab.mkdir()
    built_in_ros(out)
    completed = subprocess.run(
        ("unshare", "--mount", "sh", "-c", SCRIPT, "sh", str(out), sys.executable, str(lab)),
        capture_output=True,
        text=True,
        timeout=LIMIT_S,
        check=False,
        env=os.environ | {"PYTHONUNBUFFERED": "1"},
    )
    outputs = {name: (out / name).read_text(encoding="utf-8") for name in ("first", "full", "second", "small")}
    assert completed.returncode == 0, (completed.stderr, outputs)
    for name in ("first", "full"):
        assert "free some space, then: fieldkit resume trials/" in outputs[name]
        assert outputs[name].endswith("exit code 2\n")
    assert f"du -sh {lab}/small/* # delete what is not needed, or choose another --out" in outputs["small"]
    assert outputs["small"].endswith("exit code 3\n")
    table = rows(only_trial(out))
    assert [row["repeat"] for row in table if row["status"] == "valid"] == ["1", "2"]
    assert all(row["reason"] for row in table if row["status"] != "valid")
    assert run_here(out, "verify", str(only_trial(out))).code == 0
    assert "the same bytes" in run_here(out, "rebuild", str(only_trial(out))).out
