"""Values of telemetry sources over time: their clock, their source, and their messages and panels."""

import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import jsonschema
import pytest

from fieldkit.analysis.cells import aggregate
from fieldkit.config import schema
from fieldkit.config.profiles import RobotProfile
from fieldkit.core.model import Role
from fieldkit.export import timeline as mcap_timeline
from fieldkit.measure.attempt import AttemptEvidence
from fieldkit.measure.evidence import host
from fieldkit.report import timeline
from fieldkit.report.contents import repeat_to_draw
from fieldkit.report.trial_folders import load_evidence
from fieldkit.telemetry import telemetry_samples
from fieldkit.trial.plan import PLAN_FILE
from fieldkit.trial.stored import plans, sources
from tests.helpers import recorded

BOOT_NS = recorded.START_NS
SOURCES: Mapping[str, Any] = {
    "near": {"at": "laptop", "command": ["x"], "values": {"noise_dbm": {"json": "noise"}}},
    "lte": {
        "command": ["x"],
        "values": {"signal_dbm": {"json": "rsrp"}, "sinr_db": {"json": "sinr"}, "band": {"json": "band"}},
    },
    "other": {
        "command": ["x"],
        "values": {"signal_dbm": {"json": "rsrp"}, "noise_dbm": {"json": "noise"}, "tx_rate_bit_s": {"json": "rate"}},
    },
}


def run(seconds: str, code: str = "0", **values: object) -> str:
    output = json.dumps(values)
    return f"==> {seconds} {code} {len(output)} <==\n{output}\n"


def profile(plain: RobotProfile) -> RobotProfile:
    data = plain.model_dump(mode="json", by_alias=True)
    data["telemetry"] = {"sources": SOURCES}
    return schema.validate(schema.parse(json.dumps(data), source="x.yaml"), RobotProfile)


@pytest.fixture
def trial(tmp_path: Path) -> Path:
    """A trial whose sender has telemetry sources, 10 s after its boot."""
    (tmp_path / "trials").mkdir()
    trial = recorded.make(tmp_path / "trials")
    plan = plans.read_plan(trial)
    sender = plan.cast[Role.SENDER]
    cast = {**plan.cast, Role.SENDER: sender.model_copy(update={"profile": profile(sender.profile)})}
    (trial / PLAN_FILE).write_text(schema.dump(plan.model_copy(update={"cast": cast})), encoding="utf-8")
    folder = trial / "repeats" / "udp-01"
    lte = run("11.25", rsrp=-97.5, sinr=12, band="B3") + run("12.00", "1") + run("13.50", rsrp=-99.0)
    (folder / "sender-telemetry-lte.txt").write_text(lte, encoding="ascii")
    (folder / "sender-telemetry-other.txt").write_text(run("12.75", rsrp=-1, noise=-95, rate=2e6), encoding="ascii")
    clock = f"==> clock <==\n10.00 {BOOT_NS // 10**9 + 10}.000000000 10.00\n==> end <==\n"
    (folder / host.before_file(Role.SENDER)).write_text(clock, encoding="ascii")
    return trial


def since_boot_s(times_ns: Iterable[int]) -> Any:  # noqa: ANN401 (pytest)
    """Return times since the boot; its time is known to 10 ms, the resolution of /proc/uptime."""
    return pytest.approx([(time_ns - BOOT_NS) / 1e9 for time_ns in times_ns], abs=0.01)


def test_values_have_the_time_of_the_robots_clock_and_the_first_source(trial: Path) -> None:
    sender = plans.read_plan(trial).cast[Role.SENDER].profile
    evidence = AttemptEvidence(trial / "repeats" / "udp-01")
    samples = telemetry_samples.read(evidence, Role.SENDER, sender)
    assert since_boot_s(sample.utc_ns for sample in samples) == [11.25, 12.75, 13.5]
    assert [sample.source for sample in samples] == ["lte", "other", "lte"]
    series = telemetry_samples.series(evidence, Role.SENDER, sender)
    lte, other = [samples[0].utc_ns, samples[2].utc_ns], samples[1].utc_ns
    assert series == {
        "signal_dbm": [(lte[0], -97.5), (lte[1], -99.0)],
        "sinr_db": [(lte[0], 12.0)],
        "band": [],
        "noise_dbm": [],  # of the laptop, whose time of boot is unknown
        "tx_rate_bit_s": [(other, 2e6)],
    }
    assert telemetry_samples.series(evidence, Role.RECEIVER, plans.read_plan(trial).cast[Role.RECEIVER].profile) == {}
    (evidence.folder / host.before_file(Role.SENDER)).unlink()
    assert telemetry_samples.read(AttemptEvidence(evidence.folder), Role.SENDER, sender) == ()


def test_each_source_has_a_channel_in_the_export(trial: Path) -> None:
    messages: dict[str, list[Any]] = {}
    for message in mcap_timeline.messages(trial, plans.read_plan(trial)):
        jsonschema.validate(message.content, message.channel.schema)
        messages.setdefault(message.channel.name, []).append((message.time_ns, message.content))
    lte = messages["/sender/telemetry/lte"]
    assert since_boot_s(time_ns for time_ns, _ in lte) == [11.25, 13.5]
    assert {name: lte[0][1][name] for name in ("signal_dbm", "sinr_db", "band")} == {
        "signal_dbm": -97.5,
        "sinr_db": 12.0,
        "band": "B3",
    }
    assert len(messages["/sender/telemetry/other"]) == 1


def test_the_time_line_of_the_report_has_the_values_of_sources(trial: Path) -> None:
    evidence = load_evidence(sources.find([trial], print).read())
    row = repeat_to_draw(aggregate(evidence.repeats), evidence, "")
    assert row is not None
    chart, *_ = timeline.charts(row, evidence)
    series = {panel.title: panel.series for panel in chart.panels}
    (signal,) = series["signal of the radios"]
    assert list(signal.y) == [-97.5, -99.0]
    assert signal.x[1] - signal.x[0] == pytest.approx(2.25)
    (rate,) = series["PHY rate of the radios"]
    assert list(rate.y) == [2.0]
    (ratio,) = series["SINR of the radios"]
    assert list(ratio.y) == [12.0]
