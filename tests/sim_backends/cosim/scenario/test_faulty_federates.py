"""Faults of federates, over each transport and in both roles: the run names the federate and can be replayed."""

import json
import os
import shlex
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Final

import pytest

from sim_backends.federates import remote
from sim_backends.federates.handshake import Hello, Welcome
from sim_backends.federates.session import FederateSession, open_session
from tests.helpers.faulty_federates import DELAY_S, FAULTS, Federates, forked_federates
from tests.helpers.federate_pairs import children, now_s
from tests.helpers.federate_transports import SCHEMES, new_addresses, ros_master
from tests.helpers.runs import cosim

DEADLINE_S: Final = 1.5
"""Deadline of answers. The deadline of the start is longer, because a start may take long on a busy machine."""
OPTIONS: Final = ("--duration", "300ms", "--policy", "sliding_window", "--window", "10ms", "--deadline", "60s")
UNANSWERED: Final = f"has not answered for {DEADLINE_S:g} s: request to advance from 0.2"
MESSAGES: Final = {
    "killed": (1, "the connection was closed"),
    "suspended": (3, UNANSWERED),
    "delayed": (3, UNANSWERED),
    "garbage": (1, "with a malformed frame: "),
    "raises": (1, "ValueError: no wheels"),
}


@pytest.fixture(scope="module")
def federates() -> Iterator[Federates]:
    with ros_master(), forked_federates() as forked:
        yield forked


@pytest.fixture(autouse=True)
def short_deadline(monkeypatch: pytest.MonkeyPatch) -> None:
    def open_then_shorten(
        role: int, address: str, hello: Hello, deadline_s: float | None
    ) -> tuple[FederateSession, Hello, Welcome]:
        session, sent_hello, welcome = open_session(role, address, hello, deadline_s)
        session._deadline_s = DEADLINE_S
        return session, sent_hello, welcome

    monkeypatch.setattr(remote, "open_session", open_then_shorten)


def is_running(pid: int) -> bool:
    return Path(f"/proc/{pid}").exists()


def check_run(lab: Path, role: str, fault: str, address: str) -> None:
    """Run a scenario whose federate has a fault, and check exit code, message and recording."""
    # DDS reports only after 10 s that a participant has exited without a message.
    code, message = MESSAGES["suspended" if fault == "killed" and address.startswith("dds") else fault]
    started_s = time.monotonic()
    run = cosim(lab, "run", "convoy", f"--{role}", address, *OPTIONS, "--out", "faulty")
    assert run.code == code, run.err
    assert f"error: {role} faulty (" in run.err
    assert message in run.err
    if fault not in {"garbage", "raises"}:
        assert "its last time is 0.2 s" in run.err or "its last time is 0.199" in run.err, run.err
    assert time.monotonic() - started_s < 60
    replayed = cosim(lab, "replay", "faulty", "--format", "json")
    assert replayed.code == 0, replayed.err
    assert json.loads(replayed.out)["flows"]


@pytest.mark.parametrize("role", ["physics", "network"])
@pytest.mark.parametrize("fault", FAULTS)
def test_a_faulty_federate_on_a_pipe_ends_the_run_with_an_error(fault: str, role: str, tmp_path: Path) -> None:
    start_s = now_s()
    words = (sys.executable, "-m", "tests.helpers.faulty_federates", role, fault)
    check_run(tmp_path, role, fault, shlex.join(words))
    assert children(start_s) == set()


@pytest.mark.parametrize("role", ["physics", "network"])
@pytest.mark.parametrize("fault", FAULTS)
@pytest.mark.parametrize("scheme", SCHEMES)
def test_a_faulty_federate_on_a_transport_ends_the_run_with_an_error(
    scheme: str, fault: str, role: str, federates: Federates, tmp_path: Path
) -> None:
    served_at, address = new_addresses(scheme)
    pid = federates.start(role, fault, served_at)
    check_run(tmp_path, role, fault, address)
    if fault == "suspended":
        os.kill(pid, 9)
    deadline_s = time.monotonic() + DELAY_S + 60
    while is_running(pid):
        assert time.monotonic() < deadline_s, "the federate has not exited after its run"
        time.sleep(0.01)
