"""The time line of a repeat: bars of steps, faults and moves, and panels of flows, on one time axis."""

import json
import struct
from pathlib import Path

import numpy as np
import pytest

from fieldkit.analysis.cells import aggregate
from fieldkit.config import schema
from fieldkit.core.model import Role, TrackPoint
from fieldkit.measure.evidence import host, track
from fieldkit.measure.robot_state import exchanges
from fieldkit.report import timeline
from fieldkit.report.charts import Chart, Panel
from fieldkit.report.contents import repeat_to_draw
from fieldkit.report.trial_folders import load_evidence
from fieldkit.ros.streams import topic_samples
from fieldkit.trial import procedure
from fieldkit.trial.plan import PLAN_FILE
from fieldkit.trial.stored import plans, sources
from tests.helpers import recorded
from tests.ros.bags.test_measure_bag import write_bag

STARTED_NS = recorded.START_NS + 10 * recorded.SECOND_NS
"""Start of the recording; the transfer starts 2 s later, the ping 3 s later."""
BOOT_S = 100


@pytest.fixture
def trial(tmp_path: Path) -> Path:
    (tmp_path / "trials").mkdir()
    return recorded.make(tmp_path / "trials")


def write_jobs(trial: Path, **spans: tuple[float, float]) -> Path:
    """Write the start and end times of jobs on the sender, in s since the attempt's start; return its folder."""
    folder = trial / "repeats" / "udp-01"
    lines = [
        f"{name.replace('__', '.').replace('_', '-')} itself 0 {round(100 * (BOOT_S + start))} {BOOT_S + stop:.2f}"
        for name, (start, stop) in spans.items()
    ]
    clock = f"{BOOT_S}.00 {STARTED_NS // recorded.SECOND_NS}.000000000 {BOOT_S}.00"
    text = "\n".join(["==> jobs <==", *lines, "==> clock <==", clock, "==> end <==", ""])
    (folder / host.after_file(Role.SENDER)).write_text(text, encoding="utf-8")
    return folder


def time_line(trial: Path) -> Chart:
    evidence = load_evidence(sources.find([trial], print).read())
    row = repeat_to_draw(aggregate(evidence.repeats), evidence, "")
    assert row is not None
    chart, *_ = timeline.charts(row, evidence)
    assert chart.is_stacked
    return chart


def panels(trial: Path) -> list[Panel]:
    return list(time_line(trial).panels)


def bars(panel: Panel) -> dict[str, tuple[float, float]]:
    """Return the start and end of the bar in each lane, rounded to 10 ms."""
    return {panel.lanes[span.lane]: (round(span.start, 2), round(span.stop, 2)) for span in panel.spans}


def test_jobs_have_bars_and_panels_share_one_axis(trial: Path) -> None:
    write_jobs(trial, capture=(1.0, 6.0), ping=(2.9, 5.0))
    all_panels = panels(trial)
    drawn_bars = bars(all_panels[0])
    assert drawn_bars["capture"][1] - drawn_bars["capture"][0] == pytest.approx(5.0, abs=0.02)
    assert drawn_bars["ping"][1] - drawn_bars["ping"][0] == pytest.approx(2.1, abs=0.02)
    assert drawn_bars["send"][0] - drawn_bars["capture"][0] == pytest.approx(1.0, abs=0.02)
    assert len({(panel.left, panel.right) for panel in all_panels}) == 1
    assert [panel.x_label for panel in all_panels] == [""] * (len(all_panels) - 1) + ["time [s]"]
    assert all_panels[0].left == 0


def test_fault_has_a_bar_for_its_cause_and_one_for_the_time_without_replies(trial: Path) -> None:
    folder = write_jobs(trial, fault_link_down=(1.0, 9.0), fault_link_down_heals=(5.0, 8.0))
    (folder / "fault-link-down.txt").write_text("lasted_s 2.000\ninterval_s 0.1\n", encoding="ascii")
    replies = [
        f"[{STARTED_NS // recorded.SECOND_NS + at_s}.000000] 64 bytes from 10.0.0.2: icmp_seq={at_s} ttl=64 time=1 ms"
        for at_s in (1, 2, 6, 7, 8)
    ]
    (folder / "fault-link-down-ping.txt").write_text(
        "\n".join(["PING 10.0.0.2 (10.0.0.2) 56(84) bytes of data.", *replies]), encoding="utf-8"
    )
    drawn_bars = bars(panels(trial)[0])
    cause, no_answer = drawn_bars["fault link-down"], drawn_bars["no answer link-down"]
    assert cause[1] - cause[0] == pytest.approx(2.0, abs=0.02)
    assert no_answer[1] - no_answer[0] == pytest.approx(4.0, abs=0.02)
    assert cause[0] - no_answer[0] == pytest.approx(1.0, abs=0.02)
    assert "fault-link-down" not in drawn_bars


def test_move_has_a_bar_from_its_first_to_its_last_position(trial: Path) -> None:
    folder = write_jobs(trial, capture=(1.0, 9.0))
    moved_points = [
        TrackPoint(STARTED_NS + 2 * 10**9 + round(n * 1e8), Role.RECEIVER, (10.0 + n / 10, 0.0, 0.2))
        for n in range(21)
    ]
    initial = [TrackPoint(1, Role.RECEIVER, (10.0, 0.0, 0.2)), TrackPoint(1, Role.SENDER, (0.0, 0.0, 0.2))]
    (folder / track.FILE).write_text(track.text([*initial, *moved_points]), encoding="ascii")
    start, stop = bars(panels(trial)[0])["move receiver"]
    assert stop - start == pytest.approx(2.0, abs=0.02)


def test_a_ping_without_any_reply_shows_all_its_losses(trial: Path) -> None:
    folder = write_jobs(trial, ping=(3.0, 5.0))
    summary = "10 packets transmitted, 0 received, 100% packet loss, time 1800ms"
    (folder / "ping.txt").write_text(f"{recorded.PING_HEAD}\n{summary}\n", encoding="utf-8")
    trips = next(panel for panel in panels(trial) if panel.title == "round trips")
    lost = next(series for series in trips.series if series.label == "no reply")
    assert len(lost.x) == 10
    assert trips.description == "0 round trips; 10 without a reply"


def add_steps(trial: Path, *texts: str) -> None:
    """Add steps to the trial's procedure."""
    plan = plans.read_plan(trial)
    extra = procedure.Procedure.model_validate(
        {"name": "los", "summary": "s", "scenario": "los", "topology": "master", "protocols": ["udp"], "repeats": 1}
        | {"steps": [json.loads(text) for text in texts]}
    )
    steps = (*plan.procedure.steps, *extra.steps)
    changed = plan.model_copy(update={"procedure": plan.procedure.model_copy(update={"steps": steps})})
    (trial / PLAN_FILE).write_text(schema.dump(changed), encoding="utf-8")


def test_recordings_of_both_robots_are_drawn_on_the_clock_of_the_first(trial: Path) -> None:
    add_steps(
        trial,
        '{"record": {"robot": "receiver", "topics": ["/scan"], "duration": "1s", "name": "back"}}',
        '{"transfer": {"from": "receiver", "to": "sender", "file": "back", "name": "up"}}',
    )
    write_bag(trial / "repeats" / "udp-01" / "back.bag", {"/scan": 11})  # with the same time stamps as scan.bag
    drawn_bars = bars(panels(trial)[0])
    ahead_s = drawn_bars["record scan"][0] - drawn_bars["record back"][0]
    assert ahead_s == pytest.approx(recorded.AHEAD_NS / 1e9, abs=0.02), "the clock of the receiver is ahead"


@pytest.mark.parametrize(("ahead_ns", "is_corrected"), [(100 * 10**9, True), (5 * 10**6, False)])
def test_jobs_of_a_third_robot_are_drawn_on_the_clock_of_the_first(
    trial: Path, ahead_ns: int, is_corrected: bool
) -> None:
    folder = write_jobs(trial, capture=(1.0, 6.0))
    after = (folder / host.after_file(Role.SENDER)).read_text(encoding="utf-8")
    for role, offset_ns in ((Role.SENDER, 0), (Role.RELAY, ahead_ns)):
        seconds, nanoseconds = divmod(STARTED_NS + offset_ns, recorded.SECOND_NS)
        clock = f"{BOOT_S}.00 {seconds}.{nanoseconds:09d} {BOOT_S}.00"
        (folder / host.before_file(role)).write_text(f"==> clock <==\n{clock}\n==> end <==\n", encoding="ascii")
        jobs, _, _ = after.replace("capture", f"forward-{role}").partition("==> clock <==")
        (folder / host.after_file(role)).write_text(f"{jobs}==> clock <==\n{clock}\n==> end <==\n", encoding="ascii")
    request_and_response_ns = (STARTED_NS - 10**7, STARTED_NS + 10**7)
    text = exchanges.text(dict.fromkeys((Role.SENDER, Role.RELAY), request_and_response_ns))
    (folder / exchanges.FILE).write_text(text, encoding="ascii")
    chart = time_line(trial)
    drawn_bars = bars(chart.panels[0])
    assert drawn_bars["forward-relay"] == pytest.approx(drawn_bars["forward-sender"], abs=0.05)
    assert ("Times of the relay are corrected by -100000.000 ms" in chart.caption) == is_corrected


def test_iperf3_has_a_panel_of_its_rate_per_second(trial: Path) -> None:
    add_steps(trial, '{"iperf3": {"from": "sender", "to": "receiver", "duration": "3s"}}')
    folder = write_jobs(trial, iperf3_client=(4.0, 7.0))
    intervals = [{"sum": {"seconds": 1.0, "bytes": size}} for size in (125_000, 250_000, 0)]
    test = {"start": {}, "intervals": intervals, "end": {}}
    (folder / "receiver-iperf3.json").write_text(json.dumps(test), encoding="utf-8")
    rates = next(panel for panel in panels(trial) if panel.title == "payload of iperf3")
    (series,) = rates.series
    assert list(series.y) == [1.0, 2.0, 0.0, 0.0]
    assert np.diff(series.x) == pytest.approx([1.0, 1.0, 1.0])


def test_a_topic_has_a_panel_of_its_delays_and_losses(trial: Path) -> None:
    add_steps(
        trial, '{"topics": {"from": "sender", "to": "receiver", "over": "dds", "rate": "10Hz", "bytes": "100B"}}'
    )
    folder = write_jobs(trial, publish=(4.0, 7.0))
    after = folder / host.after_file(Role.SENDER)
    text = after.read_text(encoding="utf-8").replace("publish", "subscribe")
    (folder / host.after_file(Role.RECEIVER)).write_text(text, encoding="utf-8")
    stream_start_ns = STARTED_NS + 4 * 10**9

    def record(kind: int, sequence: int, sent_ns: int, at_ns: int) -> bytes:
        return struct.pack("<HHIqqq", kind, 0, 100, sequence, sent_ns, at_ns)

    def log(name: str, numbers: tuple[int, ...], late_ns: int) -> None:
        samples = [
            record(1, n, stream_start_ns + n * 10**8, stream_start_ns + n * 10**8 + late_ns + (n == 3) * 5 * 10**6)
            for n in numbers
        ]
        content = topic_samples.LOG_MAGIC + b"".join(samples) + record(7, len(numbers), 0, stream_start_ns + 10**9)
        (folder / name).write_bytes(content)

    log("sender-topic.bin", (0, 1, 2, 3, 4), 0)
    log("receiver-topic.bin", (0, 2, 3), 10**6)
    delays = next(panel for panel in panels(trial) if "beyond its fastest sample" in panel.title)
    received, lost = delays.series
    assert list(received.y) == pytest.approx([0.0, 0.0, 5.0])
    assert np.diff(lost.x) == pytest.approx([0.3])
    assert delays.description == "5 samples sent, 2 lost, 3 received"
