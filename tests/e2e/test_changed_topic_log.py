"""The repeat of a topic between emulated robots is valid, and invalid after a change of the subscriber's log."""

import struct
import zlib
from pathlib import Path

import pytest

from fieldkit.agent.messaging import records
from fieldkit.measure.attempt import AttemptEvidence
from fieldkit.trial import gates, journal, store
from fieldkit.trial.stored import plans
from tests.helpers.labs import built_in_ros, write_procedure
from tests.helpers.runs import only_trial, run_here
from tests.helpers.texts import procedure

pytestmark = pytest.mark.emulated

STREAM = procedure(
    "stream",
    """\
- capture:
    during:
      - together:
          during:
            - topics: {name: dds, from: sender, to: receiver, over: dds, rate: 20Hz, bytes: 500B, duration: 3s}
            - topics: {name: zenoh, from: sender, to: receiver, over: zenoh, rate: 20Hz, bytes: 500B, duration: 3s}
""",
    protocols="udp",
)


def shift_arrivals(content: bytes, by_ns: int) -> bytes:
    """Return a log whose samples arrive `by_ns` later, with a matching checksum."""
    head, size = len(records.MAGIC), records.RECORD.size
    rows = [list(records.RECORD.unpack_from(content, at)) for at in range(head, len(content), size)]
    for row in rows:
        row[5] += by_ns if row[0] == records.SAMPLE else 0
    rows[-1][2] = 0
    rows[-1][2] = zlib.crc32(records.MAGIC + b"".join(records.RECORD.pack(*row) for row in rows))
    return records.MAGIC + b"".join(records.RECORD.pack(*row) for row in rows)


def test_a_changed_log_of_a_real_stream_is_detected(tmp_path: Path) -> None:
    built_in_ros(tmp_path)
    run = run_here(tmp_path, "trial", write_procedure(tmp_path, STREAM), "5m", "--yes")
    assert run.code == 0, run.out + run.err
    trial = only_trial(tmp_path)
    plan = plans.read_plan(trial)
    (attempt,) = journal.ended_attempts(journal.history(trial, plan))
    folder = store.attempt_folder(trial, attempt.folder)
    for name in ("dds", "zenoh"):
        log = folder / f"{name}.receiver-topic.bin"
        content = log.read_bytes()
        for changed, reason in (
            (shift_arrivals(content, 50_000_000), "later than its capture for every sample"),
            (shift_arrivals(content, -5_000_000), "earlier than the packets in its capture"),
            (content[:-40] + struct.pack("<d", 1.5) + content[-32:], "its checksum is wrong"),
        ):
            log.write_bytes(changed)
            problems = gates.judge(plan, attempt.repeat, AttemptEvidence(folder)).problems
            assert any(reason in problem for problem in problems), problems
        log.write_bytes(content)
    assert gates.judge(plan, attempt.repeat, AttemptEvidence(folder)).problems == ()
