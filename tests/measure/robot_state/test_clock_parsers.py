"""Reports of chronyc, timedatectl and pmc: real outputs of several versions, and outputs without a value."""

import re
from pathlib import Path

import pytest

from fieldkit.measure.robot_state import (
    attempt_states,
    chrony,
    clock_states,
    health,
    interfaces,
    neighbourhood,
    ptp,
    snapshots,
    timesyncd,
)
from fieldkit.measure.robot_state.snapshots import SourceOutput
from tests.helpers.paths import DATA


def output(name: str, code: int | None = 0) -> SourceOutput:
    return SourceOutput((DATA / name).read_text(encoding="utf-8").strip("\n"), code)


@pytest.mark.parametrize("suffix", ["csv", "txt"])
def test_chrony_reports_offset_error_and_source(suffix: str) -> None:
    report = chrony.parse(output(f"chrony/synchronized-4.3.{suffix}"))
    assert report.is_synchronized
    assert report.reference == "10.9.0.2"
    assert report.offset_s == pytest.approx(2.537e-6), "the clock is fast, so it is ahead of the source"
    assert report.error_s == pytest.approx(1.475e-6 + 0.5 * 9.682e-6, abs=5e-9)


def test_a_slow_clock_is_behind_even_if_its_leap_status_is_normal() -> None:
    report = chrony.parse(output("chrony/slow-2023.txt"))
    assert (report.offset_s, report.reference) == (-1557.763061523, "kube30")
    assert chrony.parse(output("chrony/synchronized-2022.txt")).offset_s == -0.000107969


@pytest.mark.parametrize("suffix", ["csv", "txt"])
@pytest.mark.parametrize(
    ("name", "problem"),
    [("none", "chrony has no source"), ("local", "chrony has no source and serves its own clock")],
)
def test_the_0_that_chrony_prints_without_a_source_is_not_an_offset(name: str, problem: str, suffix: str) -> None:
    report = chrony.parse(output(f"chrony/{name}-4.3.{suffix}"))
    assert (report.offset_s, report.error_s, report.problem) == (None, None, problem)


@pytest.mark.parametrize(
    ("result", "problem"),
    [
        (output("chrony/no-daemon-4.3.txt", 1), "chronyd does not run"),
        (SourceOutput("", 137), "chronyc did not answer in time"),
        (SourceOutput("", None), "chronyc was interrupted"),
        (SourceOutput("Segmentation fault", 139), "chronyc failed with exit code 139"),
        (SourceOutput("", 0), "the output of chronyc cannot be read"),
        (SourceOutput("0A090002,a,9,1,nan,0,0,0,0,0,0.1,0.1,0.5,Normal", 0), "the output of chronyc cannot be read"),
        (SourceOutput("0A090002,a,9,1,0.1,0,0,0,0,0,-0.1,0.1,0.5,Normal", 0), "the output of chronyc cannot be read"),
        (SourceOutput("0A090002,a,9,1,1e99,0,0,0,0,0,0.1,0.1,0.5,Normal", 0), "the output of chronyc cannot be read"),
    ],
)
def test_chrony_without_a_usable_output_has_no_value(result: SourceOutput, problem: str) -> None:
    report = chrony.parse(result)
    assert (report.offset_s, report.problem) == (None, problem)


def test_timesyncd_reports_the_correction_at_the_last_poll() -> None:
    report = timesyncd.parse(output("timedatectl/status-245.txt"), None)
    assert report is not None
    assert report.reference == "3.debian.pool.ntp.org", "the output has no address"
    assert report.offset_s == 1.087495, "the server is behind the clock"
    assert report.error_s == pytest.approx(0.040580 + 2.156880 / 2 + 1.087495)
    report = timesyncd.parse(output("timedatectl/status-jitter.txt"), None)
    assert report is not None
    assert report.offset_s == pytest.approx(0.005086)
    report = timesyncd.parse(output("timedatectl/status-first.txt"), None)
    assert report is not None
    assert (report.offset_s, report.reference) == (-7.493693, "192.168.10.2")
    assert report.error_s == pytest.approx(0.044448 + 517e-6 / 2 + 7.493693)


@pytest.mark.parametrize(
    ("text", "seconds"),
    [
        ("0", 0.0),
        ("+1.5ms", 0.0015),
        ("-39us", -39e-6),
        ("34min 8s", 2048.0),
        ("1y 1month", 31_557_600 + 2_629_800),
        ("1parsec", None),
        ("", None),
        ("1", None),
        ("ms", None),
        ("1s " * 50, None),
    ],
)
def test_time_spans_of_systemd_are_parsed(text: str, seconds: float | None) -> None:
    assert timesyncd.span_s(text) == (None if seconds is None else pytest.approx(seconds))


def test_timesyncd_that_is_disabled_or_unsynchronized_gives_no_value() -> None:
    failed_query = SourceOutput("Failed to query server: The name org.freedesktop.timesync1 was not provided", 1)
    properties = "Timezone=UTC\nLocalRTC=no\nCanNTP=yes\nNTP={}\nNTPSynchronized={}\n"
    assert timesyncd.parse(failed_query, SourceOutput(properties.format("no", "yes"), 0)) is None
    report = timesyncd.parse(failed_query, SourceOutput(properties.format("yes", "no"), 0))
    assert report is not None
    assert report.problem == "timedatectl failed with exit code 1"
    status = output("timedatectl/status-jitter.txt")
    report = timesyncd.parse(status, SourceOutput(properties.format("yes", "no"), 0))
    assert report is not None
    assert (report.offset_s, report.problem) == (None, "systemd-timesyncd has not synchronized the clock")
    unanswered_status = SourceOutput(
        "       Server: 10.0.0.1 (ntp)\nPoll interval: 32s (min: 32s; max 34min 8s)\n Packet count: 0", 0
    )
    report = timesyncd.parse(unanswered_status, None)
    assert report is not None
    assert report.problem == "systemd-timesyncd has no answer from its server"


def test_ptp_reports_the_local_clock() -> None:
    report = ptp.parse(output("linuxptp/current-1.2.txt"))
    assert (report.offset_s, report.error_s, report.reference) == (310e-9, 9310e-9, "00a069.fffe.0b552d")
    for name, problem in (
        ("master-3.1", "ptp4l has no source and serves its own clock"),
        ("uncalibrated-3.1", "ptp4l is not synchronized to its master"),
        ("no-answer-3.1", "ptp4l does not answer"),
    ):
        report = ptp.parse(output(f"linuxptp/{name}.txt"))
        assert (report.offset_s, report.problem) == (None, problem)
    uncalibrated = output("linuxptp/uncalibrated-3.1.txt")
    report = ptp.parse(SourceOutput(uncalibrated.text.replace("UNCALIBRATED", "SLAVE"), 0))
    assert (report.offset_s, report.error_s) == (125e-9, 2138e-9)


def test_the_program_with_a_source_is_chosen() -> None:
    reports = clock_states.reports(
        {"chrony": output("chrony/none-4.3.csv"), "ptp": output("linuxptp/current-1.2.txt")},
    )
    assert [report.program for report in reports] == ["chrony", "ptp4l"]
    report = clock_states.choose_report(reports)
    assert report is not None
    assert report.program == "ptp4l"
    unsynchronized = clock_states.choose_report(
        clock_states.reports({"timedatectl": SourceOutput("NTP=no\nNTPSynchronized=no", 0)})
    )
    assert unsynchronized is not None
    assert unsynchronized.problem == "no program synchronizes the clock"
    assert clock_states.choose_report(clock_states.reports({})) is None


def test_a_source_cannot_print_the_output_of_another(tmp_path: Path) -> None:
    (tmp_path / "file").write_text(
        "==> chrony <==\n ==> ptp <==\n  fake\n code 0\n \n code 1\n==> chrony <==\n second\n code 0\n",
        encoding="utf-8",
    )
    outputs = snapshots.read(tmp_path / "file")
    assert set(outputs) == {"chrony"}
    assert outputs["chrony"] == SourceOutput("==> ptp <==\n fake\ncode 0", 1), (
        "the first section is used, with its last exit code"
    )
    assert snapshots.parse("==> chrony <==\n half of a li")["chrony"].failure == "was interrupted"


def test_the_script_has_a_command_for_each_parser() -> None:
    script = (Path(snapshots.__file__).parents[2] / "remote" / "snapshot.sh").read_text(encoding="ascii")
    names = set(re.findall(r"start_source ([a-z-]+) ", script))
    assert names == attempt_states.CLOCK_SOURCES | attempt_states.RADIO_SOURCES | {
        health.NAME,
        health.THROTTLED_NAME,
        interfaces.NAME,
    }


def test_the_names_of_sources_that_need_a_parser_are_complete() -> None:
    clock_sources = {chrony.NAME, timesyncd.NAME, timesyncd.STATE_NAME, ptp.NAME}
    assert clock_sources == attempt_states.CLOCK_SOURCES
    radio_sources = (
        neighbourhood.INFO_NAME,
        neighbourhood.REGULATORY_NAME,
        neighbourhood.SCAN_NAME,
        neighbourhood.SURVEY_NAME,
    )
    assert set(radio_sources) == attempt_states.RADIO_SOURCES
