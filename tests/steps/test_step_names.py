"""Steps with names: prefixes of jobs, files and columns, the capture and ping of each step, and lists of a plan."""

from datetime import UTC, datetime
from pathlib import Path

import pytest

from fieldkit.config import schema
from fieldkit.core.columns import fault_column_name
from fieldkit.core.errors import ConfigurationError
from fieldkit.core.model import FaultKind, Protocol, RepeatId, Role
from fieldkit.core.units import parse_distance
from fieldkit.measure.attempt import AttemptEvidence
from fieldkit.steps.base import Step
from fieldkit.steps.nest import own_jobs
from fieldkit.steps.view import View, capture_around
from fieldkit.trial import gates, planned_evidence, rows
from fieldkit.trial.plan import Plan
from fieldkit.trial.procedure import Procedure
from fieldkit.trial.request import TrialRequest, make_plan
from tests.helpers.captures import datagram, file_bytes, timed
from tests.helpers.casts import CAST, los_plan
from tests.ros.bags.test_measure_bag import write_bag

HEAD = "name: x\nsummary: x\nscenario: los\ntopology: master\nprotocols: [udp]\nrepeats: 1\nsteps:\n"
STEPS = """\
  - record: {robot: sender, topics: [/scan], duration: 2s}
  - record: {robot: sender, topics: [/imu], duration: 2s, name: imu}
  - capture:
      during:
        - transfer: {name: up, from: sender, to: receiver, file: imu}
        - capture:
            name: inner
            robots: [sender]
            during:
              - ping: {name: up, from: sender, to: receiver, payload_bytes: 8192}
              - ping: {from: receiver, to: sender}
  - transfer: {name: bare, from: sender, to: receiver, file: scan.bag}
  - fault: {name: cut, robot: sender, kind: link-down, for: 1s}
"""
REPEAT = RepeatId(Protocol.UDP, 1)
LOG = """\
tcpdump: listening on wlan0
{0} packets captured
{0} packets received by filter
0 packets dropped by kernel
"""
PING = """\
PING 10.42.0.2 (10.42.0.2) 8192(8220) bytes of data.
[1700000000.000000] 8200 bytes from 10.42.0.2: icmp_seq=1 ttl=64 time={ms} ms
10 packets transmitted, 1 received, 90% packet loss
"""


def load(steps: str = STEPS) -> Procedure:
    return schema.validate(schema.parse(HEAD + steps, source="x.yaml"), Procedure)


def plan_of(steps: str = STEPS) -> Plan:
    request = TrialRequest(procedure=load(steps), distance=parse_distance("5m"))
    return make_plan(request, backend="field", cast=CAST, now=datetime(2026, 11, 20, tzinfo=UTC))


def steps_by_name(plan: Plan) -> dict[tuple[str, str], Step]:
    return {(placed.kind, placed.step.name): placed.step for placed in plan.procedure.walk()}


def test_jobs_and_files_of_named_step_have_its_prefix() -> None:
    plan = plan_of()
    scene = plan.scene(REPEAT, "folder")
    for (kind, name), step in steps_by_name(plan).items():
        prefix = "" if name in {"", "scan"} else f"{name}."
        jobs = [planned.job for planned in own_jobs(step, scene)]
        assert jobs
        files = {file for job in jobs for file in (job.log, job.stdout) if file}
        names = {job.name for job in jobs} | files
        assert {text for text in names if not text.startswith(prefix)} == set(), kind
        assert files <= set(step.files())


def test_step_without_name_has_unprefixed_files() -> None:
    scene = los_plan().scene(REPEAT, "folder")
    assert [(planned.job.name, planned.job.log) for planned in los_plan().jobs(scene)] == [
        ("record", "sender-record.log"),
        ("capture", "sender-capture.log"),
        ("capture", "receiver-capture.log"),
        ("listen", "receiver-listen.log"),
        ("send", "sender-send.log"),
        ("ping", "sender-ping.log"),
    ]
    assert "name" not in los_plan().procedure.model_dump(mode="json")["steps"][1]["capture"]


def test_plan_lists_transfers_pings_and_captures() -> None:
    plan = plan_of()
    transfers = [
        (transfer.name, transfer.sent_file, transfer.received_file, transfer.captures)
        for transfer in planned_evidence.transfers(plan, Protocol.UDP)
    ]
    assert transfers == [
        ("up", "imu.bag", "up.recv.bag", ("sender.pcap", "receiver.pcap")),
        ("bare", "scan.bag", "bare.recv.bag", (None, None)),
    ]
    pings = [(ping.name, ping.role, ping.file) for ping in planned_evidence.ping_sources(plan)]
    assert pings == [("up", Role.SENDER, "up.ping.txt"), ("", Role.RECEIVER, "ping.txt")]
    assert planned_evidence.captures(plan) == {
        "sender.pcap": Role.SENDER,
        "inner.sender.pcap": Role.SENDER,
        "receiver.pcap": Role.RECEIVER,
    }
    assert planned_evidence.bags(plan) == {Role.SENDER: "scan.bag"}
    assert [file.name for file in plan.scenes()[0].recordings[Role.SENDER]] == ["scan.bag", "imu.bag"]


def test_step_uses_innermost_capture_around_it(tmp_path: Path) -> None:
    within = {placed.step.name or placed.kind: placed.within for placed in plan_of().procedure.walk()}["ping"]
    assert capture_around(within, Role.SENDER) == "inner.sender.pcap"
    assert capture_around(within, Role.RECEIVER) == "receiver.pcap"
    assert capture_around(within, Role.RELAY) is None
    assert capture_around((), Role.SENDER) is None
    (tmp_path / "sender.pcap").write_bytes(file_bytes(timed(datagram(1, 8192))))
    (tmp_path / "inner.sender.pcap").write_bytes(file_bytes(timed(datagram(1, 100))))
    view = View(plan_of().scenes()[0], AttemptEvidence(tmp_path), within)
    inner = view.capture(Role.SENDER)
    assert inner is not None
    assert inner.frames == 1
    assert view.capture(Role.RELAY) is None


def test_gates_and_rows_prefix_columns_reasons_and_summaries(tmp_path: Path) -> None:
    for name in ("scan.bag", "imu.bag"):
        write_bag(tmp_path / name, {"/scan": 11, "/imu": 11})
    (tmp_path / "up.recv.bag").write_bytes((tmp_path / "imu.bag").read_bytes())
    (tmp_path / "up.ping.txt").write_text(PING.format(ms="16.0"), encoding="ascii")
    (tmp_path / "ping.txt").write_text(PING.format(ms="4.0"), encoding="ascii")
    frames = timed([packet for number in range(4) for packet in datagram(number, 8192)])
    for name in ("sender", "receiver", "inner.sender"):
        (tmp_path / f"{name}.pcap").write_bytes(file_bytes(frames))
        log = name.replace("sender", "sender-capture.log").replace("receiver", "receiver-capture.log")
        (tmp_path / log).write_text(LOG.format(len(frames)), encoding="ascii")
    plan = plan_of()
    verdict = gates.judge(plan, REPEAT, AttemptEvidence(tmp_path))
    values, missing = verdict.measured.values, verdict.measured.missing
    assert (values["up.file_loss"], values["up.rtt_median_s"], values["rtt_median_s"]) == (0, 0.016, 0.004)
    assert (values["sender_captured"], values["inner.sender_captured"]) == (len(frames), len(frames))
    assert missing["inner.receiver_captured"] == "the receiver does not capture"
    # The paper's values use the ping of the same name; the other transfer has no such ping.
    assert values["up.paper_delay_s"] == 0.016
    assert "bare.paper_delay_s" in missing
    assert {name for name in (*values, *missing) if name.startswith(("file_loss", "link_down"))} == set()
    assert "bare: bare.recv.bag is missing" in verdict.problems
    assert "cut.link_down_outage_s" in missing
    text = rows.describe(plan, values)
    assert text.startswith(
        "up: file loss 0.0 %, up: ping loss 90.0 %, ping loss 90.0 %, "
        "up: RTT 16.0 ms (8192 bytes), RTT 4.0 ms (8192 bytes)"
    )


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (
            "ping: {name: up, ",
            "ping: {name: 2up, ",
            "'2up' is not a name of at most 31 lower-case letters, digits and _",
        ),
        ("ping: {name: up, ", "ping: {name: up.2, ", "'up.2' is not a name"),
        ("ping: {name: up, ", "ping: {", "a ping is defined twice; give each of them another name."),
        (
            "transfer: {name: bare",
            "transfer: {name: up",
            "a transfer named up is defined twice; rename one",
        ),
        ("name: imu}", "name: scan}", "a recording on sender is defined twice; give each of them another name."),
        ("file: imu", "file: odom", "sends odom, but no recording of that name is made on sender before it"),
        (", file: imu", "", "names no file, but 2 files are recorded there before it: write file:"),
        ("            name: inner\n", "", "a capture on sender is defined twice; give each of them another name."),
        ("robots: [sender]", "robots: [sender, sender]", "a robot is named twice"),
    ],
)
def test_ambiguous_steps_are_rejected(old: str, new: str, message: str) -> None:
    assert old in STEPS
    with pytest.raises(ConfigurationError) as caught:
        load(STEPS.replace(old, new))
    assert message in caught.value.what


@pytest.mark.parametrize("file", ["imu", "imu.bag"])
def test_transfer_names_bag_or_file(file: str) -> None:
    plan = plan_of(STEPS.replace("file: imu", f"file: {file}"))
    assert planned_evidence.transfers(plan, Protocol.UDP)[0].sent_file == "imu.bag"
    assert plan.refusals({}) == ()


def test_refusal_of_unknown_file_lists_recorded_files() -> None:
    (refusal,) = plan_of(STEPS.replace("file: imu", "file: imu/imu_0.db3")).refusals({})
    assert refusal.what == "it cannot send imu/imu_0.db3: its recorder writes scan.bag, imu.bag"
    assert refusal.remedy == "write file: scan.bag"


def test_summary_starts_with_gap_of_ping() -> None:
    ping = "{ping: {from: sender, to: receiver, gap: true}}"
    plan = plan_of(f"  - fault: {{name: cut, robot: sender, kind: link-down, for: 7s, during: [{ping}]}}\n")
    outage_s, recovered = (fault_column_name(FaultKind.LINK_DOWN, suffix) for suffix in ("outage_s", "recovered"))
    fault_values = {f"cut.{outage_s}": 7.2, f"cut.{recovered}": True}
    text = rows.describe(plan, {**fault_values, "rtt_gap_s": 3.2, "rtt_gap_lost": 29, "rtt_median_s": 0.0032})
    assert text == "longest gap 3.2 s with 29 lost, RTT 3.2 ms, cut: link-down: no answer for 7.2 s"
