"""The emulated robot's `rosbag` behaves like that of ROS: outputs, exit codes, files, signals.

`tests/data/rosbag/1.15.15/outputs.json` has the output and behaviour of ROS's rosbag, verbatim. Run this file as a
program to record them again: `python -m tests.sim_backends.emulated.ros.test_rosbag_behaviour`.
"""

import json
import re
import sys
from collections.abc import Iterator
from contextlib import ExitStack
from typing import Any, Final

import pytest

from fieldkit.core.deadline import Deadline
from fieldkit.core.model import Role, Topology
from fieldkit.remote.command import with_environment
from fieldkit.remote.shell import Shell
from sim_backends.emulated import testbed
from sim_backends.emulated.backend import EmulatedBackend
from sim_backends.emulated.emulated_options import EmulatedOptions, RosChoice
from sim_backends.emulated.ros import rosbag
from sim_backends.world.world import load_world
from tests.helpers.paths import DATA

RECORDED_OUTPUTS: Final = DATA / "rosbag" / "1.15.15"
SETUP: Final = "/opt/ros/noetic/setup.bash"

# One case: command line after `rosbag`, files that exist before, the signal and its receiver after the bag is open:
# `wrapper` is the process that was started, `group` its process group.
CASES: Final[dict[str, dict[str, Any]]] = {
    "duration": {"argv": ["record", "--duration=1.5", "-O", "scan", "/scan"]},
    "bag_suffix": {"argv": ["record", "--duration=1", "-O", "scan.bag", "/scan"]},
    "relative_name": {"argv": ["record", "--duration=1", "-O", "scan", "scan"]},
    "two_topics": {"argv": ["record", "--duration=1", "-O", "two", "/scan", "/imu", "/scan"]},
    "prefix": {"argv": ["record", "--duration=1", "-o", "pre", "/scan"]},
    "no_name": {"argv": ["record", "--duration=1", "/scan"]},
    "no_publisher": {"argv": ["record", "--duration=1", "-O", "none", "/nothing"]},
    "limit": {"argv": ["record", "-l", "2", "-O", "scan", "/scan"]},
    "quiet": {"argv": ["record", "-q", "--duration=1", "-O", "scan", "/scan"]},
    "overwrites": {
        "argv": ["record", "--duration=1", "-O", "scan", "/scan"],
        "before": ["scan.bag", "scan.bag.active"],
    },
    "no_folder": {"argv": ["record", "--duration=1", "-O", "no/scan", "/scan"]},
    "paper_d": {"argv": ["record", "-d", "15", "-O", "scan", "/scan"]},
    "unknown_option": {"argv": ["record", "--bogus", "/scan"]},
    "no_topic": {"argv": ["record"]},
    "both_names": {"argv": ["record", "-o", "a", "-O", "b", "/scan"]},
    "bad_duration": {"argv": ["record", "--duration=abc", "-O", "scan", "/scan"]},
    "bad_unit": {"argv": ["record", "--duration=1x", "-O", "scan", "/scan"]},
    "info_no_bag": {"argv": ["info"]},
    "info_missing": {"argv": ["info", "missing.bag"]},
    "info_not_a_bag": {"argv": ["info", "text.bag"], "before": ["text.bag"]},
    **{
        f"{name.lower()}_{to}": {"argv": ["record", "-O", "scan", "/scan"], "signal": name, "to": to}
        for name in ("SIGINT", "SIGTERM", "SIGKILL")
        for to in ("wrapper", "group")
    },
}

# Runs one case on the robot. A recorder that outlives its wrapper has some seconds to exit. Then its files are
# listed, and it is killed.
DRIVER: Final = r"""
import json, os, pathlib, signal, subprocess, sys, tempfile, time

case, patience_s = json.loads(sys.argv[1]), float(sys.argv[2])
folder = pathlib.Path(tempfile.mkdtemp())
for name in case.get("before", ()):
    (folder / name).write_text("old")

def wait(condition, seconds):
    end = time.monotonic() + seconds
    while not condition() and time.monotonic() < end:
        time.sleep(0.01)
    return condition()

def living(group):
    for stat in pathlib.Path("/proc").glob("[0-9]*/stat"):
        try:
            state, _, pgrp = stat.read_text().rpartition(")")[2].split()[:3]
        except OSError:
            continue
        if int(pgrp) == group and state not in "ZX":
            return True
    return False

with open(folder / ".out", "wb") as out, open(folder / ".err", "wb") as err:
    process = subprocess.Popen(["rosbag", *case["argv"]], cwd=folder, stdin=subprocess.DEVNULL, stdout=out,
                               stderr=err, start_new_session=True)
if "signal" in case:
    assert wait(lambda: (folder / "scan.bag.active").exists(), 60)
    number = getattr(signal, case["signal"])
    (os.kill if case["to"] == "wrapper" else os.killpg)(process.pid, number)
exit_code = process.wait(60)
lives_on = not wait(lambda: not living(process.pid), patience_s)
result = {
    "exit_code": exit_code,
    "stdout": (folder / ".out").read_text(),
    "stderr": (folder / ".err").read_text(),
    "files": sorted(path.name for path in folder.iterdir() if not path.name.startswith(".")),
    "recorder_lives_on": lives_on,
}
if lives_on:
    os.killpg(process.pid, signal.SIGKILL)
print(json.dumps(result))
"""

Result = dict[str, Any]


def run_case(shell: Shell, case: dict[str, Any], *, patience_s: float) -> Result:
    argv = with_environment([sys.executable, "-c", DRIVER, json.dumps(case), str(patience_s)], setup=[SETUP])
    result: Result = json.loads(shell.run(argv, deadline=Deadline.after(180)).stdout)
    return result


def without_times(result: Result) -> Result:
    """Replace time stamps and dates, which differ between runs."""
    text = json.dumps(result)
    text = re.sub(r"\[\d{10}\.\d{9}\]", "[STAMP]", text)
    normalized: Result = json.loads(re.sub(r"\d{4}(-\d\d){5}", "DATE", text))
    return normalized


def start_turtlebot(stack: ExitStack, ros: RosChoice) -> Shell:
    cast = EmulatedBackend(None, None).cast(Topology.MASTERLESS)
    sender_only = {Role.SENDER: cast[Role.SENDER]}
    emulation = stack.enter_context(
        testbed.bring_up(sender_only, options=EmulatedOptions(), world=load_world("lawn"), ros=ros, seed=1)
    )
    return emulation.shells[Role.SENDER]


@pytest.fixture(scope="module", params=[RosChoice.BUILTIN, RosChoice.DEBIAN])
def shell(request: pytest.FixtureRequest) -> Iterator[Shell]:
    with ExitStack() as stack:
        yield start_turtlebot(stack, request.param)


@pytest.fixture(scope="module")
def recorded_results() -> dict[str, Result]:
    outputs: dict[str, Result] = json.loads((RECORDED_OUTPUTS / "outputs.json").read_text(encoding="utf-8"))
    return outputs


@pytest.mark.emulated
@pytest.mark.parametrize("name", CASES)
def test_rosbag_behaves_like_that_of_ros(name: str, shell: Shell, recorded_results: dict[str, Result]) -> None:
    patience_s = 1.0 if recorded_results[name]["recorder_lives_on"] else 60.0
    assert without_times(run_case(shell, CASES[name], patience_s=patience_s)) == without_times(recorded_results[name])


@pytest.mark.parametrize("bag", sorted(path.name for path in RECORDED_OUTPUTS.glob("*.bag*")))
def test_info_prints_the_same_as_that_of_ros(
    bag: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("TZ", "UTC")
    monkeypatch.chdir(RECORDED_OUTPUTS)
    monkeypatch.setattr(sys, "argv", ["rosbag", "info", bag])
    exit_code = rosbag.main()
    out, err = capsys.readouterr()
    expected = json.loads((RECORDED_OUTPUTS / "info.json").read_text(encoding="utf-8"))[bag]
    assert {"exit_code": exit_code, "stdout": out, "stderr": err} == expected


def test_every_option_is_one_of_the_original(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stopped:
        rosbag.record(["--help"])
    assert stopped.value.code == 0
    builtin = capsys.readouterr().out
    original = (RECORDED_OUTPUTS / "record-help.txt").read_text(encoding="utf-8")
    assert builtin.splitlines()[:5] == original.splitlines()[:5]
    assert set(re.findall(r"-[a-zA-Z]\b|--[a-z0-9-]+", builtin)) <= set(
        re.findall(r"-[a-zA-Z]\b|--[a-z0-9-]+", original)
    )


def main() -> None:
    """Record the behaviour of ROS's rosbag again."""
    with ExitStack() as stack:
        shell = start_turtlebot(stack, RosChoice.DEBIAN)
        outputs = {name: run_case(shell, case, patience_s=5.0) for name, case in CASES.items()}
    (RECORDED_OUTPUTS / "outputs.json").write_text(json.dumps(outputs, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
