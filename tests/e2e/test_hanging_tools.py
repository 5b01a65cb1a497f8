"""A trial ends even if a tool on a robot hangs, during its work or in response to a query of its version."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from fieldkit.core.deadline import Deadline
from fieldkit.remote import jobs
from tests.helpers.field_robots import FieldRobots, start_field_robots
from tests.helpers.labs import copy_shipped, write_procedure
from tests.helpers.runs import only_trial, rows, run_here
from tests.helpers.texts import procedure

pytestmark = pytest.mark.emulated

PROCEDURE = procedure(
    "short",
    """\
- record: {robot: sender, topics: [/scan], duration: 1s}
- capture:
    during:
      - transfer: {from: sender, to: receiver, file: scan.bag, into: recv.bag, limit: 3s}
- ping: {from: sender, to: receiver, count: 2, interval: 200ms}
""",
)

# This script responds to version queries like the real tool, and hangs during its work.
HANGS_AT_WORK = """\
#!/bin/sh
case "$*" in -V | -h | --help | -L* | *127.0.0.1*) exec {program} "$@" ;; esac
exec sleep 600
"""
HANGS = "#!/bin/sh\nexec sleep 600\n"


@pytest.fixture(scope="module")
def field_robots(tmp_path_factory: pytest.TempPathFactory) -> Iterator[FieldRobots]:
    with start_field_robots(tmp_path_factory.mktemp("field")) as robots:
        yield robots


@pytest.fixture
def lab(field_robots: FieldRobots, tmp_path: Path) -> Path:
    (tmp_path / "fieldkit.yaml").write_bytes((field_robots.folder / "fieldkit.yaml").read_bytes())
    write_procedure(tmp_path, PROCEDURE)
    return tmp_path


def replace_tool(field_robots: FieldRobots, lab: Path, tool: str, program: str, script: str) -> None:
    """Replace a tool of the sender by a script."""
    install_script(field_robots, tool, script.format(program=program))
    copy_shipped(lab, "robots", "turtlebot3_burger", f"  {tool}: {program}\n", f"  {tool}: /root/{tool}\n")


def install_script(field_robots: FieldRobots, name: str, script: str) -> None:
    for shell in field_robots.testbed.shells.values():
        write_script = 'cat >"$1" && chmod 755 "$1"'
        shell.run(
            ("sh", "-c", write_script, "sh", f"/root/{name}"), stdin=script.encode(), deadline=Deadline.after(30)
        )


@pytest.mark.parametrize(
    ("tool", "program", "message"),
    [
        ("netcat", "nc.traditional", "recv.bag"),
        ("capture", "tcpdump", "capture"),
        ("ping", "ping", "ping"),
    ],
)
def test_a_hanging_tool_is_terminated_at_its_time_limit(
    field_robots: FieldRobots, lab: Path, tool: str, program: str, message: str
) -> None:
    replace_tool(field_robots, lab, tool, program, HANGS_AT_WORK)
    run = run_here(lab, "trial", "short", "5m", "--yes")
    assert run.code in {0, 4}, run.err
    (row,) = rows(only_trial(lab))
    if tool == "netcat":  # an incomplete transfer is a measurement
        assert row["received_bytes"] == "0"
        # On a busy machine the sender starts too late for the listener's limit, which makes the attempt void.
        assert row["status"] == "valid" or "the sender started up to" in row["reason"], row["reason"]
    else:
        assert row["status"] == "failed"
        assert message in row["reason"]
    for shell in field_robots.testbed.shells.values():
        assert jobs.list_running(shell, Deadline.after(30)) == ()


@pytest.mark.parametrize(("tool", "program"), [("netcat", "nc.traditional"), ("ping", "ping")])
def test_a_tool_that_hangs_on_version_queries_is_rejected_before_repeat_1(
    field_robots: FieldRobots, lab: Path, tool: str, program: str
) -> None:
    replace_tool(field_robots, lab, tool, program, HANGS)
    run = run_here(lab, "trial", "short", "5m", "--yes")
    assert run.code == 3
    assert f"/root/{tool}" in run.err
    assert "remedy" in run.err


def test_a_hanging_recorder_is_terminated_at_its_time_limit(field_robots: FieldRobots, lab: Path) -> None:
    copy_shipped(
        lab, "robots", "turtlebot3_burger", '[rosbag, record, "--duration', '[/root/rosbag, record, "--duration'
    )
    install_script(field_robots, "rosbag", HANGS_AT_WORK.replace("-V |", "*--help* | -V |").format(program="rosbag"))
    run = run_here(lab, "trial", "short", "5m", "--yes")
    assert run.code == 4, run.err
    (row,) = rows(only_trial(lab))
    assert row["status"] == "failed"
    assert "record" in row["reason"]
