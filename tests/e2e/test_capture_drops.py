"""If tcpdump drops packets, values of a topic that need its captures are withheld, and a transfer is void."""

import re
from collections.abc import Iterator
from pathlib import Path

import pytest

from fieldkit.core.columns import Measured
from fieldkit.measure.attempt import AttemptEvidence
from fieldkit.trial import gates, journal, store
from fieldkit.trial.plan import Plan
from fieldkit.trial.stored import plans
from tests.helpers.labs import built_in_ros
from tests.helpers.runs import only_trial, run_here
from tests.helpers.texts import procedure

pytestmark = pytest.mark.emulated

STREAM = procedure(
    "stream",
    """\
- capture:
    name: topic
    during:
      - together:
          during:
            - topics: {from: sender, to: receiver, over: dds, rate: 20Hz, bytes: 500B, duration: 2s}
            - ping: {from: sender, to: receiver, count: 10, interval: 200ms, payload_bytes: 56}
- record: {robot: sender, topics: [/scan], duration: 1s, name: scan}
- capture:
    name: transfer
    during:
      - transfer: {from: sender, to: receiver, into: recv.bag, port: 1234}
""",
    protocols="udp",
)
TIMES = {"topic_jitter_s", "topic_delay_variation_p95_s"}
NEEDS_NO_CAPTURE = {"topic_sent", "topic_received", "topic_loss", *TIMES}
NEEDS_CAPTURES = {"topic_delay_median_s", "topic_delay_error_s", "topic_age_mean_s", "topic_packet_loss"}


@pytest.fixture(scope="module")
def attempt(tmp_path_factory: pytest.TempPathFactory) -> tuple[Plan, Path, journal.Attempt]:
    home = tmp_path_factory.mktemp("drops")
    built_in_ros(home)
    (home / "procedures").mkdir()
    (home / "procedures" / "stream.yaml").write_text(STREAM, encoding="utf-8")
    run = run_here(home, "trial", "stream", "5m", "--yes")
    assert run.code == 0, run.out + run.err
    trial = only_trial(home)
    plan = plans.read_plan(trial)
    (entry,) = journal.ended_attempts(journal.history(trial, plan))
    return plan, store.attempt_folder(trial, entry.folder), entry


def with_drops(attempt: tuple[Plan, Path, journal.Attempt], capture: str) -> tuple[tuple[str, ...], Measured]:
    """Return the problems and columns of an attempt in which tcpdump reports 12 packets dropped by the kernel."""
    plan, folder, entry = attempt
    log = folder / f"{capture}-capture.log"
    text = log.read_text(encoding="utf-8")
    log.write_text(
        re.sub(r"(?m)^0 packets dropped by kernel", "12 packets dropped by kernel", text), encoding="utf-8"
    )
    try:
        verdict = gates.judge(plan, entry.repeat, AttemptEvidence(folder))
    finally:
        log.write_text(text, encoding="utf-8")
    return verdict.problems, verdict.measured


def withheld_times(measured: Measured) -> Iterator[str]:
    """Yield the columns of times that are withheld because this machine delayed the subscriber's program."""
    yield from (name for name in TIMES if "its program was delayed" in measured.missing.get(name, ""))


@pytest.mark.parametrize("role", ["sender", "receiver"])
def test_values_from_the_logs_of_a_topic_are_not_withheld(
    attempt: tuple[Plan, Path, journal.Attempt], role: str
) -> None:
    problems, measured = with_drops(attempt, f"topic.{role}")
    assert problems == ()
    assert measured.values.keys() >= NEEDS_NO_CAPTURE - {*withheld_times(measured)}, measured.missing
    reason = f"the capture of {role} lacks 12 packets that its kernel dropped"
    assert {measured.missing[name] for name in NEEDS_CAPTURES} == {reason}
    assert measured.values["topic_capture_withheld"] == reason
    assert measured.values[f"topic.{role}_capture_dropped"] == 12


def test_without_drops_nothing_is_withheld(attempt: tuple[Plan, Path, journal.Attempt]) -> None:
    plan, folder, entry = attempt
    verdict = gates.judge(plan, entry.repeat, AttemptEvidence(folder))
    assert verdict.problems == ()
    assert "topic_packet_loss" in verdict.measured.values
    assert "topic_capture_withheld" not in verdict.measured.values


def test_a_transfer_is_void_if_its_capture_is_incomplete(attempt: tuple[Plan, Path, journal.Attempt]) -> None:
    problems, _ = with_drops(attempt, "transfer.sender")
    assert problems == ("transfer: sender capture: its kernel dropped 12 packets, its interface 0",)
