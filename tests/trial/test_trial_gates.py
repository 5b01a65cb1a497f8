"""Complete evidence passes all checks; evidence with one damaged file fails with the reason."""

import re
from collections.abc import Callable
from pathlib import Path

import pytest

from fieldkit.core.columns import Measured
from fieldkit.core.model import Protocol, Role
from fieldkit.measure.attempt import AttemptEvidence
from fieldkit.measure.evidence import oracle_delays, track
from fieldkit.measure.robot_state import exchanges
from fieldkit.steps.kinds.ping import PingStep
from fieldkit.steps.view import View
from fieldkit.trial import gates
from fieldkit.trial.procedure import load_procedure
from tests.helpers.captures import datagram, file_bytes, timed
from tests.helpers.casts import los_plan
from tests.helpers.plans import problems, write_states
from tests.ros.bags.test_measure_bag import write_bag

PLAN = los_plan(record_s=2.0, protocols=(Protocol.UDP,))
FRAMES = timed([frame for number in range(4) for frame in datagram(number, 8192)])

LOG = """\
tcpdump: listening on wlan0, link-type RAW (Raw IP), snapshot length 128 bytes
{captured} packets captured
{matched} packets received by filter
{dropped} packets dropped by kernel
"""
PING = """\
PING 10.42.0.2 (10.42.0.2) 8192(8220) bytes of data.
{sent} packets transmitted, 0 received, 100% packet loss
"""
FIRST_LINE_OF_LOG = LOG.split("\n", 1)[0]
FIRST_LINE_OF_PING = PING.split("\n", 1)[0]


def log(captured: int = len(FRAMES), matched: int = len(FRAMES), dropped: int = 0) -> str:
    return LOG.format(captured=captured, matched=matched, dropped=dropped)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    write_states(tmp_path)
    write_bag(tmp_path / "scan.bag", {"/scan": 11})
    (tmp_path / "recv.bag").touch()
    for name in ("sender.pcap", "receiver.pcap"):
        (tmp_path / name).write_bytes(file_bytes(FRAMES))
    for name in ("sender-capture.log", "receiver-capture.log"):
        (tmp_path / name).write_text(log(), encoding="utf-8")
    (tmp_path / "ping.txt").write_text(PING.format(sent=10), encoding="utf-8")
    return tmp_path


def test_complete_evidence_passes_even_with_lost_packets(folder: Path) -> None:
    assert problems(PLAN, Protocol.UDP, folder) == ()


def test_packets_captured_before_the_filter_are_ignored(folder: Path) -> None:
    (folder / "sender-capture.log").write_text(log(matched=len(FRAMES) + 1), encoding="utf-8")
    assert problems(PLAN, Protocol.UDP, folder) == ()


def test_a_tcpdump_without_a_match_count_is_accepted(folder: Path) -> None:
    reason_text = [line for line in log().splitlines(keepends=True) if "received by filter" not in line]
    (folder / "sender-capture.log").write_text("".join(reason_text), encoding="utf-8")
    assert problems(PLAN, Protocol.UDP, folder) == ()


def test_labs_with_an_intact_or_no_radio_model_are_accepted(folder: Path) -> None:
    (folder / "lateness.txt").write_text("bound 5000000\nlate 5000000 7\n", encoding="ascii")
    (folder / "track.csv").write_text(track.text([]), encoding="ascii")
    assert problems(PLAN, Protocol.UDP, folder) == ()


def text(name: str, content: str) -> Callable[[Path], object]:
    return lambda folder: (folder / name).write_text(content, encoding="utf-8")


def without(name: str) -> Callable[[Path], object]:
    return lambda folder: (folder / name).unlink()


def short_bag(folder: Path) -> None:
    (folder / "scan.bag").unlink()
    write_bag(folder / "scan.bag", {"/scan": 1})


def wrong_topic(folder: Path) -> None:
    (folder / "scan.bag").unlink()
    write_bag(folder / "scan.bag", {"/odom": 11})


def cut_capture(folder: Path) -> None:
    path = folder / "receiver.pcap"
    path.write_bytes(path.read_bytes()[:-3])


def fewer_frames(folder: Path) -> None:
    (folder / "receiver.pcap").write_bytes(file_bytes(FRAMES[:-1]))


@pytest.mark.parametrize(
    ("damage", "reason"),
    [
        (without("scan.bag"), "scan.bag: there is no bag"),
        (text("scan.bag", ""), "scan.bag: the bag is empty"),
        (wrong_topic, "scan.bag: no message of /scan"),
        (short_bag, "scan.bag: spans only 0.0 s of 4 s"),
        (without("recv.bag"), "recv.bag is missing"),
        (without("sender.pcap"), "sender capture: cannot be read: No such file or directory"),
        (text("sender-capture.log", "tcpdump: wlan0: No such device\n"), "tcpdump was not listening"),
        (
            text("sender-capture.log", FIRST_LINE_OF_LOG),
            "sender capture: tcpdump ended without its counters",
        ),
        (text("sender-capture.log", log(dropped=3)), "sender capture: its kernel dropped 3 packets, its interface 0"),
        (
            text("sender-capture.log", f"{log()}2 packets dropped by interface\n"),
            "sender capture: its kernel dropped 0 packets, its interface 2",
        ),
        (
            text("sender-capture.log", log(matched=23)),
            "sender capture: 23 packets matched the filter, but tcpdump wrote 24",
        ),
        (
            text("lateness.txt", "bound 5000000\nlate 5000000 7\nlate 5242880 2\nlate 41943040 1\n"),
            "lateness.txt: 3 packets arrived too late, by up to 41.9 ms; the bound is 5 ms",
        ),
        (text("track.csv", "utc_ns"), "track.csv: is not a track of robots"),
        (
            text("track.csv", track.text([]).replace("lines 0", "lines 1")),
            "track.csv: is truncated: it has 0 of 1 lines",
        ),
        (text("link.csv", "utc_ns"), "link.csv: is not a file of link samples"),
        (text("lateness.txt", "bound"), "lateness.txt: is not a file of packet lateness"),
        (cut_capture, "receiver capture: ends inside the packet at byte"),
        (fewer_frames, "receiver capture: the file has 23 packets, but tcpdump counted 24"),
        (without("ping.txt"), "ping.txt is missing"),
        (text("ping.txt", FIRST_LINE_OF_PING), "ping.txt: ping was stopped early; its summary is missing"),
        (text("ping.txt", PING.format(sent=7)), "ping.txt: ping sent 7 of 10 requests"),
    ],
)
def test_one_damaged_file_gives_at_most_two_reasons(
    folder: Path, damage: Callable[[Path], object], reason: str
) -> None:
    plan = los_plan(record_s=4.0) if damage is short_bag else PLAN
    damage(folder)
    reasons = problems(plan, Protocol.UDP, folder)
    assert any(reason in text_of_reason for text_of_reason in reasons), reasons
    assert len(reasons) <= 2, "one cause has at most two symptoms"
    assert not [text_of_reason for text_of_reason in reasons if "cannot be measured" in text_of_reason]


def test_an_exception_while_measuring_makes_the_attempt_failed(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def measure(step: PingStep, view: View) -> Measured:
        raise OverflowError("int too large to convert to float")

    monkeypatch.setattr(PingStep, "measure", measure)
    (reason_text,) = problems(PLAN, Protocol.UDP, folder)
    reason = "the evidence of the step ping cannot be measured: OverflowError: int too large to convert to float"
    assert re.fullmatch(rf"{reason} \(test_trial_gates.py, line [0-9]+\)", reason_text)
    verdict = gates.judge(PLAN, next(PLAN.repeats_in_order()), AttemptEvidence(folder))
    assert verdict.measured.missing["rtt_loss"] == reason_text
    (traceback,) = verdict.step_errors
    assert "in measure" in traceback
    assert verdict.has_failed
    assert verdict.measured.values["sent_bytes"] == (folder / "scan.bag").stat().st_size


def test_an_exception_of_a_reader_of_an_optional_file_is_logged(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The error must not make the file count as missing."""

    def read_lateness(path: Path) -> None:
        raise KeyError(path.name)

    monkeypatch.setattr(oracle_delays, "read_lateness", read_lateness)
    verdict = gates.judge(PLAN, next(PLAN.repeats_in_order()), AttemptEvidence(folder))
    (reason,) = verdict.problems
    assert reason.startswith("lateness.txt cannot be read: KeyError: 'lateness.txt' (test_trial_gates.py, line")
    (traceback,) = verdict.step_errors
    assert "in read_lateness" in traceback
    assert verdict.has_failed


@pytest.mark.parametrize("method", ["check", "output_columns", "jobs"])
def test_an_exception_of_any_method_makes_the_attempt_failed(
    folder: Path, monkeypatch: pytest.MonkeyPatch, method: str
) -> None:
    def raise_error(*_: object) -> None:
        raise KeyError("wlan0")

    monkeypatch.setattr(PingStep, method, raise_error)
    verdict = gates.judge(PLAN, next(PLAN.repeats_in_order()), AttemptEvidence(folder))
    *_, reason = verdict.problems  # the jobs of the capture that contains the ping raise too
    assert "the step ping cannot be " in reason
    assert "KeyError: 'wlan0' (test_trial_gates.py, line" in reason
    assert verdict.has_failed
    (folder / "scan.bag").unlink()
    assert not gates.judge(PLAN, next(PLAN.repeats_in_order()), AttemptEvidence(folder)).has_failed, (
        "another attempt may be valid"
    )


def test_an_impossible_value_makes_the_attempt_void_and_is_missing(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A table that contains the value could not be read again."""
    measured = PingStep.measure

    def measure_impossible_values(self: PingStep, view: View) -> Measured:
        result = measured(self, view)
        return Measured({**result.values, "rtt_loss": -38460.0, "rtt_min_s": float("nan")}, result.missing)

    monkeypatch.setattr(PingStep, "measure", measure_impossible_values)
    verdict = gates.judge(PLAN, next(PLAN.repeats_in_order()), AttemptEvidence(folder))
    assert verdict.problems == (
        "the evidence gives rtt_loss as -38460, not from 0 to 1",
        "the evidence gives rtt_min_s as nan, not a number",
    )
    assert not {"rtt_loss", "rtt_min_s"} & verdict.measured.values.keys()


def test_a_value_missing_without_a_reason_makes_the_attempt_void(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    measured = PingStep.measure

    def measure_without_loss(self: PingStep, view: View) -> Measured:
        result = measured(self, view)
        return Measured({name: value for name, value in result.values.items() if name != "rtt_loss"}, result.missing)

    monkeypatch.setattr(PingStep, "measure", measure_without_loss)
    assert problems(PLAN, Protocol.UDP, folder) == ("the step ping gives neither a value nor a reason for rtt_loss",)


def test_evidence_disturbed_by_a_fault_may_be_incomplete(tmp_path: Path) -> None:
    """The evidence of the faults must be complete, but there is none of the pings during them."""
    plan = los_plan().model_copy(update={"procedure": load_procedure("selfheal")})
    write_states(tmp_path)
    reasons = problems(plan, Protocol.TCP, tmp_path)
    assert [reason.partition(":")[0] for reason in reasons] == ["fault-link-down.txt", "fault-reboot.txt"]


def test_times_are_missing_if_the_clock_counts_instructions(folder: Path) -> None:
    def measured(simulators: dict[str, str]) -> Measured:
        plan = PLAN.model_copy(update={"simulators": simulators})
        (repeat, *_) = plan.repeats_in_order()
        return gates.judge(plan, repeat, AttemptEvidence(folder)).measured

    (folder / "sender-before.txt").write_text("==> clock <==\n100.00 1700000100.000000000 100.00\n==> end <==\n")
    second_ns = 1_700_000_100 * 10**9
    (folder / exchanges.FILE).write_text(exchanges.text({Role.SENDER: (second_ns - 10**7, second_ns + 10**7)}))
    values_of_real_clock, withheld = measured({}), measured({"wifi": "linux", "clock": "instructions"})
    missing_names = values_of_real_clock.values.keys() - withheld.values.keys()
    assert {"bag_duration_s", "sender_laptop_offset_s"} <= missing_names
    assert all(name.endswith(("_s", "_ppm")) for name in missing_names)
    assert {withheld.missing[name] for name in missing_names} == {
        "the backend's clock counts instructions of a virtual processor, so it measures no real durations"
    }
    assert withheld.values["file_loss"] == values_of_real_clock.values["file_loss"]
