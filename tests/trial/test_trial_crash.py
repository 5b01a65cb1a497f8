"""Fieldkit is killed at each of its writes, and the trial resumed: each planned repeat is valid exactly once."""

import os
import shutil
import signal
from collections import Counter
from collections.abc import Callable
from datetime import UTC, datetime
from functools import cache
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from fieldkit.cli.interrupts import interruptible
from fieldkit.config import schema
from fieldkit.config.schema import parse, validate
from fieldkit.core import plugins
from fieldkit.core.model import Protocol
from fieldkit.core.units import parse_distance
from fieldkit.trial import journal, store
from fieldkit.trial.hashes import code_hash
from fieldkit.trial.plan import Plan
from fieldkit.trial.procedure import Procedure
from fieldkit.trial.request import TrialRequest, make_plan
from fieldkit.trial.running import preflight
from fieldkit.trial.running.resumption import resume_trial
from fieldkit.trial.running.robots import Robots
from fieldkit.trial.running.runner import run_trial
from fieldkit.trial.stored import verification
from fieldkit.trial.stored.rebuild import rebuild
from tests.helpers.casts import CAST
from tests.helpers.idle_testbed import IdleTestbed
from tests.helpers.nightly import mark_nightly
from tests.helpers.plans import problems, write_states

REPEATS = 1
KILLED = 9
INTERRUPTED = 130
CODE_HASH = code_hash()
WRITE = os.write
FSYNC = os.fsync
DUMP = schema.dump
VOID_FIRST = "tcp-01-1"
"""The only attempt with incomplete evidence."""

PROCEDURE = """\
name: small
summary: x
scenario: los
topology: master
protocols: [tcp]
repeats: 1
steps: [ping: {from: sender, to: receiver, count: 1}]
"""
PING = """\
PING 10.42.0.2 (10.42.0.2) 502(530) bytes of data.
64 bytes from 10.42.0.2: icmp_seq=1 ttl=64 time=2 ms
1 packets transmitted, 1 received, 0% packet loss, time 0ms
"""

STRIDES = mark_nightly([4, 1])
"""Numbers of writes between the interruptions of a test: CI interrupts a trial at every fourth write."""

# Calls that write something to disk or remove it.
WRITES = ("fsync", "write", "rename", "mkdir", "unlink", "truncate")


def robots_with_evidence(monkeypatch: pytest.MonkeyPatch) -> None:
    """Replace the measurement on robots by prepared evidence; fieldkit really does everything else."""

    def fetch(_self: Robots, remote: str, into: Path, *, ended_normally: bool) -> list[str]:
        (into / "ping.txt").write_text("" if remote.endswith(VOID_FIRST) else PING, encoding="utf-8")
        write_states(into)
        return []

    def return_empty(*_args: object, **_options: object) -> dict[str, object]:
        return {}

    for verb in (
        "begin",
        "measure",
        "require_locks",
        "stop_jobs",
        "stop_leftover_jobs",
        "close_connections",
        "delete_remote",
    ):
        monkeypatch.setattr(Robots, verb, return_empty)
    monkeypatch.setattr(Robots, "fetch", fetch)
    monkeypatch.setattr(preflight, "check_before_trial", return_empty)
    # A short trial spends most of its time on reading YAML, hashing code, and listing packages, with the same
    # results. Forked processes inherit these cached results.
    text, versions = schema.dump(plan()), plugins.versions()
    monkeypatch.setattr(schema, "dump", lambda model: text if model == plan() else DUMP(model))
    monkeypatch.setattr(schema, "read", read_once)
    monkeypatch.setattr(plugins, "versions", lambda: versions)
    for module in ("request", "running.resumption"):
        monkeypatch.setattr(f"fieldkit.trial.{module}.code_hash", lambda: CODE_HASH)


@cache
def parse_once(text: str, source: str) -> schema.Document:
    return parse(text, source=source)


def read_once(path: Path) -> schema.Document:
    """Read a file, but parse equal content only once."""
    return parse_once(path.read_text(encoding="utf-8"), str(path))


def exit_after_kill(call: Callable[..., object], *args: object) -> None:
    """Exit as if killed by SIGKILL; of an interrupted write, half of the data is on disk."""
    if call is WRITE:
        descriptor, data = args
        assert isinstance(descriptor, int)
        assert isinstance(data, bytes)
        WRITE(descriptor, data[: len(data) // 2])
    os._exit(KILLED)


def receive_stop_signal(_call: Callable[..., object], *_args: object) -> None:
    """Send SIGTERM to this process: a request to stop immediately, like a second Ctrl-C."""
    signal.raise_signal(signal.SIGTERM)


def call_at_write(moment: int, event: Callable[..., None]) -> None:
    """Call `event` at the `moment`-th write of this process. The patched functions of `os` are never restored."""
    count = 0

    def counting(call: Callable[..., object]) -> Callable[..., object]:
        def count_call(*args: object, **options: object) -> object:
            nonlocal count
            count += 1
            if count == moment:
                event(call, *args)
            return (
                None if call is FSYNC else call(*args, **options)
            )  # a kill of a process loses nothing that it wrote

        return count_call

    for name in WRITES:
        setattr(os, name, counting(getattr(os, name)))


def run(out: Path, moment: int = 0, event: Callable[..., None] = exit_after_kill) -> bool:
    """Start or resume the trial in `out` in a separate process; return True if it ended normally."""
    pid = os.fork()
    if pid == 0:
        code = 1
        try:
            call_at_write(moment, event)
            with interruptible() as stop:
                if any(out.glob("*/trial.yaml")):
                    resume_trial(trial_of(out), IdleTestbed(), lambda _: None, stop)
                else:
                    shutil.rmtree(out, ignore_errors=True)
                    run_trial(plan(), IdleTestbed(), out, lambda _: None, stop)
            code = 0
        except KeyboardInterrupt:
            code = INTERRUPTED
        finally:
            os._exit(code)
    code = os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
    assert code in {0, KILLED, INTERRUPTED}
    return code == 0


@cache
def plan() -> Plan:
    request = TrialRequest(validate(parse(PROCEDURE, source="x"), Procedure), parse_distance("30ft"))
    return make_plan(request, backend="field", cast=CAST, now=datetime(2026, 11, 20, 12, 0, tzinfo=UTC))


def trial_of(out: Path) -> Path:
    (path,) = out.glob("*/trial.yaml")
    return path.parent


def assert_consistent(folder: Path) -> None:
    """Check that the files of a trial agree with each other."""
    assert verification.verify(folder) == []
    before = {name: (folder / name).read_bytes() for name in ("trial.csv", "summary.csv")}
    rebuild(folder)
    assert {name: (folder / name).read_bytes() for name in before} == before


def assert_complete(out: Path) -> None:
    """Check that a trial is finished, and that its files are complete."""
    folder = trial_of(out)
    entries = journal.ended_attempts(journal.read(folder))
    valid = Counter(
        (attempt.repeat.protocol, attempt.repeat.number) for attempt in entries if attempt.status == "valid"
    )
    assert valid == {(Protocol.TCP, number + 1): 1 for number in range(REPEATS)}
    assert all(attempt.reason for attempt in entries if attempt.status != "valid")
    assert sorted(path.name for path in (folder / "repeats").iterdir()) == sorted(
        attempt.folder for attempt in entries
    )
    assert_consistent(folder)
    assert all(
        problems(plan(), attempt.repeat.protocol, folder / "repeats" / attempt.folder) == ()
        for attempt in entries
        if attempt.status == "valid"
    )


@pytest.mark.parametrize("stride", STRIDES)
def test_a_kill_at_any_write_is_recovered(stride: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    robots_with_evidence(monkeypatch)
    out = tmp_path / "trials"
    moments = 1 - stride
    while not run(out, moments := moments + stride):
        assert run(out)
        assert_complete(out)
        shutil.rmtree(out)
    assert_complete(out)
    assert moments > 40, "too few writes were interrupted"


@pytest.mark.parametrize("stride", STRIDES)
def test_a_stop_at_any_write_is_recovered(stride: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    robots_with_evidence(monkeypatch)
    out = tmp_path / "trials"
    moments = 1 - stride
    while not run(out, moments := moments + stride, receive_stop_signal):
        if any(out.glob(f"*/{store.MANIFEST_FILE}")):
            assert_consistent(trial_of(out))
        assert run(out)
        assert_complete(out)
        shutil.rmtree(out)
    assert moments > 40, "too few writes were interrupted"


@settings(max_examples=8, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(moments=st.lists(st.integers(1, 60), max_size=6))
def test_a_kill_during_recovery_is_recovered(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, moments: list[int]
) -> None:
    robots_with_evidence(monkeypatch)
    out = tmp_path / "trials"
    for moment in moments:
        run(out, moment)
    assert run(out)
    assert_complete(out)
    shutil.rmtree(out)
