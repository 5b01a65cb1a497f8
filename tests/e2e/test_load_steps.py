"""The steps iperf3, soak and run on emulated robots without ROS: results compared with captures, and errors."""

from contextlib import chdir
from pathlib import Path

import pytest

from fieldkit.config.locations import SITE_FILE
from tests.helpers.field_robots import start_field_robots
from tests.helpers.labs import BOX, write_procedure
from tests.helpers.runs import Run, only_trial, rows, run_here
from tests.helpers.texts import procedure, site

pytestmark = pytest.mark.emulated

SITE = site({"box-1": "box", "box-2": "box"}, emulated="late_bound: 2s, radio: RADIO")
HEAD = procedure(
    "own",
    """\
""",
    protocols="udp",
)

# The program leaves the job's process group, because the group is killed at the end of the job.
KILL_SOON = """  - run:
      robot: ROBOT
      argv:
        - sh
        - -c
        - setsid sh -c "touch .away; $0" >/dev/null 2>&1 & until [ -e .away ]; do sleep 0.05; done
        - until pidof iperf3 && sleep 1 && kill -KILL $(pidof iperf3); do sleep 0.1; done
"""
TEST = "iperf3: {from: sender, to: receiver, protocol: PROTOCOL, rate: RATE, duration: 5s, limit: 30s}"


def lab(folder: Path, steps: str, radio: str = "{fading: false}") -> Path:
    (folder / "robots").mkdir(parents=True)
    (folder / "robots" / "box.yaml").write_text(BOX, encoding="utf-8")
    (folder / "fieldkit.yaml").write_text(SITE.replace("RADIO", radio), encoding="utf-8")
    write_procedure(folder, HEAD + steps)
    return folder


def load(protocol: str, rate: str) -> str:
    return TEST.replace("PROTOCOL", protocol).replace("RATE", rate)


FLOWS = {
    "udp-lossy": ("udp", "4Mbit/s", "false", "{loss: 10%, delay: 2ms, rate: 20Mbit/s}"),
    "udp-reverse": ("udp", "4Mbit/s", "true", "{loss: 5%, delay: 2ms, rate: 20Mbit/s}"),
    "tcp": ("tcp", "4Mbit/s", "false", "{loss: 0%, rate: 20Mbit/s}"),
    "tcp-lossy": ("tcp", "2Mbit/s", "false", "{loss: 2%, delay: 2ms, rate: 20Mbit/s}"),
}


@pytest.fixture(scope="module")
def flows(tmp_path_factory: pytest.TempPathFactory) -> dict[str, dict[str, str]]:
    base = tmp_path_factory.mktemp("flows")
    labs = {
        name: lab(
            base / name,
            f"  - capture:\n      during:\n        - {load(protocol, rate)[:-1]}, reverse: {reverse}}}\n",
            radio,
        )
        for name, (protocol, rate, reverse, radio) in FLOWS.items()
    }
    for lab_folder in labs.values():
        run = run_here(lab_folder, "trial", "own", "5m")
        assert run.code == 0, run.err + run.out
    return {name: rows(only_trial(lab_folder))[-1] for name, lab_folder in labs.items()}


RTO_SHARE = 0.2 / 5
"""Bytes after a lost segment reach iperf3 later than the capture, by up to a retransmission timeout. The timeout is
at
least 200 ms in Linux, and the test takes 5 s."""


@pytest.mark.parametrize("name", FLOWS)
def test_iperf3_and_captures_agree_on_the_throughput(flows: dict[str, dict[str, str]], name: str) -> None:
    row = flows[name]
    reported, captured = (float(row[f"iperf3_{source}_bit_s"]) for source in ("throughput", "captured"))
    assert captured == pytest.approx(reported, rel=0.02 + (RTO_SHARE if name == "tcp-lossy" else 0.0))
    if name == "tcp":
        assert reported == pytest.approx(4e6, rel=0.05)
    assert float(row["iperf3_interval_min_bit_s"]) <= float(row["iperf3_interval_median_bit_s"])


@pytest.mark.parametrize("name", [name for name in FLOWS if name.startswith("udp")])
def test_iperf3_and_captures_agree_on_the_loss(flows: dict[str, dict[str, str]], name: str) -> None:
    row = flows[name]
    reported, captured = float(row["iperf3_loss"]), float(row["iperf3_captured_loss"])
    percent = {"udp-lossy": 10, "udp-reverse": 5}[name]
    # iperf3 does not count datagrams that are lost at the end.
    assert abs(reported - captured) <= 0.02 * percent / 100 + 1e-9
    assert abs(captured - percent / 100) < 0.04
    assert row["iperf3_retransmits"] == ""


def test_tcp_retransmitted_the_losses_of_the_radio(flows: dict[str, dict[str, str]]) -> None:
    assert float(flows["tcp"]["iperf3_captured_loss"]) == 0
    lossy = flows["tcp-lossy"]
    assert 0.002 < float(lossy["iperf3_captured_loss"]) < 0.05
    assert int(lossy["iperf3_retransmits"]) > 0
    assert lossy["iperf3_loss"] == ""


FAILING_STEPS = {
    "client-killed": KILL_SOON.replace("ROBOT", "sender") + f"  - {load('udp', '1Mbit/s')}\n",
    "server-killed": KILL_SOON.replace("ROBOT", "receiver") + f"  - {load('udp', '1Mbit/s')}\n",
    "limit": "  - iperf3: {from: sender, to: receiver, rate: 1Mbit/s, size: 5MB, limit: 2s}\n",
    "load-killed": (
        "  - soak: {from: sender, to: receiver, during: [run: {robot: sender, "
        # The step waits until the exit is recorded, because a load that exits while fieldkit stops it is not an
        # error.
        "command: sh -c 'kill -KILL $(pidof iperf3); until test -s .jobs/soak/exit; do sleep 0.05; done'}]}\n"
    ),
    "code": "  - run: {robot: receiver, command: sh -c 'echo no; exit 3'}\n",
    "missing-value": "  - run: {robot: sender, command: ls, columns: [{name: x, unit: V, regex: 'x=([0-9]+)'}]}\n",
    "missing-program": "  - run: {robot: sender, command: no-such-tool --json}\n",
}
REASONS = {
    "client-killed": "box-1: iperf3-client ended with exit code 137",
    "server-killed": "iperf3",
    "limit": "box-1",
    "load-killed": "box-1: its job soak exited before fieldkit stopped it, with exit code 137",
    "code": "box-2: sh ended with exit code 3",
    "missing-value": "run.txt: no x: the value is missing",
}


@pytest.fixture(scope="module")
def failed_trials(tmp_path_factory: pytest.TempPathFactory) -> dict[str, tuple[Run, Path]]:
    """Trials that fail, in sequence on the same robots."""
    base = tmp_path_factory.mktemp("wrong")
    labs = {name: lab(base / name, steps) for name, steps in FAILING_STEPS.items()}
    first = labs["code"]
    with chdir(first), start_field_robots(first, site=first / SITE_FILE) as robots:
        site_text = (robots.folder / SITE_FILE).read_text(encoding="utf-8")
        for folder in labs.values():
            (folder / SITE_FILE).write_text(site_text, encoding="utf-8")
        return {name: (run_here(folder, "trial", "own", "5m", "--yes"), folder) for name, folder in labs.items()}


@pytest.mark.parametrize("name", REASONS)
def test_errors_are_reported_and_no_repeat_is_valid(failed_trials: dict[str, tuple[Run, Path]], name: str) -> None:
    run, folder = failed_trials[name]
    assert run.code == 4, run.err + run.out
    (row,) = rows(only_trial(folder))
    assert row["status"] == "failed"
    assert REASONS[name] in row["reason"], row["reason"]
    rebuild_run = run_here(folder, "rebuild", str(only_trial(folder)))
    assert rebuild_run.code == 0, rebuild_run.err


def test_a_missing_program_is_reported_before_the_first_repeat(failed_trials: dict[str, tuple[Run, Path]]) -> None:
    run, folder = failed_trials["missing-program"]
    assert run.code == 3, run.err
    assert "no-such-tool: not found" in run.err
    assert "install no-such-tool, or correct the command of this run in the procedure" in run.err
    assert not list(only_trial(folder).glob("repeats/*"))
