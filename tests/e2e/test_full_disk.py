"""The laptop's disk fills up in mid-trial: it stops cleanly, and goes on when there is room again."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.helpers.labs import built_in_ros
from tests.helpers.runs import LIMIT_S, fieldkit, only_trial, rows

pytestmark = pytest.mark.emulated

# The lab is a small file system of its own, which this shell and its children alone see.
SCRIPT = """\
set -e
out=$1 python=$2 lab=$3
mount -t tmpfs -o size=150m tmpfs "$lab"
cd "$lab"
cp "$out/fieldkit.yaml" .
"$python" -m fieldkit trial los 30ft --repeats 2 --record 1s --protocol tcp --json >"$out/first.json" 2>"$out/first" &
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


def test_a_full_disk_stops_the_trial_and_resume_goes_on_when_there_is_room(tmp_path: Path) -> None:
    out, lab = tmp_path / "out", tmp_path / "lab"
    out.mkdir()
    lab.mkdir()
    built_in_ros(out)
    done = subprocess.run(
        ("unshare", "--mount", "sh", "-c", SCRIPT, "sh", str(out), sys.executable, str(lab)),
        capture_output=True,
        text=True,
        timeout=LIMIT_S,
        check=False,
        env=os.environ | {"PYTHONUNBUFFERED": "1"},
    )
    said = {name: (out / name).read_text(encoding="utf-8") for name in ("first", "full", "second", "small")}
    assert done.returncode == 0, (done.stderr, said)
    for name in ("first", "full"):
        assert "free some space, then: fieldkit resume trials/" in said[name]
        assert said[name].endswith("exit code 2\n")
    assert f"du -sh {lab}/small/* # delete what is not needed, or choose another --out" in said["small"]
    assert said["small"].endswith("exit code 3\n")
    table = rows(only_trial(out))
    assert [row["repeat"] for row in table if row["status"] == "valid"] == ["1", "2"]
    assert all(row["reason"] for row in table if row["status"] != "valid")
    assert fieldkit(out, "verify", str(only_trial(out))).code == 0
    assert "the same bytes" in fieldkit(out, "rebuild", str(only_trial(out))).out
