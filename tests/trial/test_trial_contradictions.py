"""Complete evidence of stored attempts has no problems; a changed file contradicts others and makes it void."""

import re
import shutil
import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import pytest

from fieldkit.core.model import Protocol, RepeatId
from fieldkit.measure.attempt import AttemptEvidence
from fieldkit.trial import hosts
from fieldkit.trial.plan import Plan
from fieldkit.trial.procedure import load_procedure
from fieldkit.trial.step_errors import StepErrors
from fieldkit.trial.stored import plans
from tests.helpers.paths import DATA
from tests.helpers.plans import problems

LOSSLESS, LOSSY = (
    next((DATA / "fieldkit" / "4" / "trials").glob(f"{start_time}*"))
    for start_time in ("20261122T010946", "20261122T013134")
)
PLAN = plans.read_plan(LOSSLESS)

BOOT = "a81d06aa-f870-44cd-b602-2c81365a2e18"
BEFORE_S, AFTER_S = 1_000, 1_100
JOBS = "capture asked 0 100000 1090.00\n"
SENDER_JOBS = f"{JOBS}record itself 0 100000 1001.50\nsend itself 0 100000 1060.00\nping itself 0 100000 1080.00\n"
RECEIVER_JOBS = f"{JOBS}listen itself 0 100000 1060.00\n"

LOG = """\
tcpdump: listening on wlan0, link-type RAW (Raw IP), snapshot length 128 bytes
{0} packets captured
{0} packets received by filter
0 packets dropped by kernel
"""

LENGTHS_BYTES = 8
"""Bytes of the two lengths of a record; its IP packet follows them."""
ICMP = 1
Packet = tuple[int, bytes]
"""Time in microseconds since 1970, and the bytes of the record after its time."""


@dataclass(frozen=True)
class Attempt:
    """A copy of a stored attempt; the states of its robots are in the format of the current job script."""

    folder: Path
    protocol: Protocol

    def problems(self, plan: Plan = PLAN) -> tuple[str, ...]:
        return problems(plan, self.protocol, self.folder)

    def replace_text(self, name: str, old: str, new: str) -> None:
        path = self.folder / name
        content = path.read_text(encoding="utf-8")
        assert old in content
        path.write_text(content.replace(old, new), encoding="utf-8")

    def change_file(self, name: str, change: Callable[[bytes], bytes]) -> None:
        path = self.folder / name
        path.write_bytes(change(path.read_bytes()))

    def packets(self, name: str) -> list[Packet]:
        data, at, packets = (self.folder / name).read_bytes(), 24, list[Packet]()
        while at < len(data):
            seconds, micros, captured_bytes = struct.unpack_from("<3I", data, at)
            packets.append((seconds * 10**6 + micros, data[at + 8 : at + 16 + captured_bytes]))
            at += 16 + captured_bytes
        return packets

    def change_capture(self, role: str, change: Callable[[list[Packet]], Sequence[Packet]]) -> None:
        """Change the packets of a capture, and the counts of tcpdump accordingly."""
        name = f"{role}.pcap"
        packets = self.packets(name)
        changed = change(packets)
        records = (struct.pack("<2I", *divmod(at, 10**6)) + rest for at, rest in changed)
        self.change_file(name, lambda data: data[:24] + b"".join(records))
        (self.folder / f"{role}-capture.log").write_text(LOG.format(len(changed)), encoding="utf-8")


def clock_state(at_ns: int, up_s: int, boot: str = BOOT) -> str:
    wall = f"{at_ns // 10**9}.{at_ns % 10**9:09d}"
    return f"==> boot <==\n{boot}\n==> clock <==\n{up_s}.00 {wall} {up_s}.00\n==> date <==\n{wall}\n"


@pytest.fixture(params=Protocol)
def attempt(request: pytest.FixtureRequest, tmp_path: Path) -> Attempt:
    return copy_attempt(request.param, tmp_path)


@pytest.fixture
def tcp(tmp_path: Path) -> Attempt:
    return copy_attempt(Protocol.TCP, tmp_path)


@pytest.fixture
def udp(tmp_path: Path) -> Attempt:
    return copy_attempt(Protocol.UDP, tmp_path)


def copy_attempt(protocol: Protocol, folder: Path, trial: Path = LOSSLESS) -> Attempt:
    copy = Attempt(Path(shutil.copytree(trial / "repeats" / f"{protocol}-01", folder / "attempt")), protocol)
    for role, jobs in (("sender", SENDER_JOBS), ("receiver", RECEIVER_JOBS)):
        first_ns = 1_000 * copy.packets(f"{role}.pcap")[0][0]
        states = [clock_state(first_ns + (up_s - 1_050) * 10**9, up_s) for up_s in (BEFORE_S, AFTER_S)]
        (copy.folder / f"{role}-before.txt").write_text(states[0], encoding="utf-8")
        (copy.folder / f"{role}-after.txt").write_text(f"==> jobs <==\n{jobs}{states[1]}", encoding="utf-8")
    return copy


@pytest.mark.parametrize("trial", [LOSSLESS, LOSSY], ids=["lossless", "lossy"])
@pytest.mark.parametrize("protocol", Protocol)
def test_complete_evidence_has_no_contradictions(protocol: Protocol, trial: Path, tmp_path: Path) -> None:
    assert copy_attempt(protocol, tmp_path, trial).problems(plans.read_plan(trial)) == ()


def assert_problems(attempt: Attempt, *reasons: str) -> None:
    problems = attempt.problems()
    assert all(any(reason in problem for problem in problems) for reason in reasons), problems


@pytest.mark.parametrize(("role", "capture_role"), [("sender", "sender"), ("receiver", "receiver")])
def test_other_files_contradict_a_capture_that_ended_too_early(
    attempt: Attempt, role: str, capture_role: str
) -> None:
    """The exit code and the counters of tcpdump do not show that the capture is incomplete."""
    attempt.change_capture(role, lambda packets: packets[: len(packets) // 3])
    assert_problems(attempt, f"the {capture_role}'s capture")


@pytest.mark.parametrize("role", ["sender", "receiver"])
def test_other_files_contradict_a_capture_that_lacks_its_beginning(attempt: Attempt, role: str) -> None:
    attempt.change_capture(role, lambda packets: packets[6:])
    assert_problems(attempt, f"the {role}'s capture")


@pytest.mark.parametrize(
    ("role", "reason"),
    [
        ("sender", "or the sender's capture is incomplete"),
        ("receiver", "a connection whose SYN is not in the receiver's capture"),
    ],
)
def test_a_handshake_that_is_missing_in_one_capture_is_a_problem(tcp: Attempt, role: str, reason: str) -> None:
    tcp.change_capture(role, lambda packets: packets[3:])
    assert_problems(tcp, reason)


@pytest.mark.parametrize(("syn_count", "is_reported"), [(1, True), (2, False)])
def test_a_refused_connection_is_a_problem_if_the_first_syn_was_refused(
    tcp: Attempt, syn_count: int, *, is_reported: bool
) -> None:
    """After lost SYNs, a refusal is no problem, because the listener may have reached its time limit before."""

    def with_reset(packets: list[Packet]) -> list[Packet]:
        (at, syn), (syn_ack_us, syn_ack) = packets[:2]
        assert syn_ack[41] == 0x12, "SYN and ACK"
        return [(at, syn)] * syn_count + [(syn_ack_us, syn_ack[:41] + bytes([0x14]) + syn_ack[42:])]

    for role in ("sender", "receiver"):
        tcp.change_capture(role, with_reset)
    tcp.change_file("recv.bag", lambda _: b"")
    message = "the receiver refused the connection: no program was listening when the sender started"
    assert (message in " ".join(tcp.problems())) == is_reported


def test_a_missing_bag_is_the_only_problem(attempt: Attempt) -> None:
    (attempt.folder / "scan.bag").unlink()
    assert attempt.problems() == ("scan.bag: there is no bag",)


def test_evidence_of_a_link_that_lost_all_packets_has_no_contradictions(udp: Attempt) -> None:
    sender = udp.packets("sender.pcap")[0][1][8 + 12 : 8 + 16]
    udp.change_capture("receiver", lambda _: [])
    udp.change_capture(
        "sender", lambda packets: [packet for packet in packets if packet[1][8 + 12 : 8 + 16] == sender]
    )
    (udp.folder / "recv.bag").write_bytes(b"")
    sent = "10 packets transmitted, 0 received, 100% packet loss, time 1800ms\n"
    (udp.folder / "ping.txt").write_text(f"PING 10.42.0.2 (10.42.0.2) 8192(8220) bytes of data.\n\n{sent}")
    assert udp.problems() == ()


SECTIONS = ["boot", "clock", "date"]


@pytest.mark.parametrize("section", SECTIONS)
def test_sections_that_a_robot_never_provides_are_no_problem(attempt: Attempt, section: str) -> None:
    """The section is missing both before and after the attempt, because the robot lacks the tool."""
    for role in ("sender", "receiver"):
        for moment in ("before", "after"):
            path = attempt.folder / f"{role}-{moment}.txt"
            path.write_text(path.read_text(encoding="utf-8").replace(f"==> {section} <==", "==> other <=="))
    assert attempt.problems() == ()


@pytest.mark.parametrize("moment", ["before", "after"])
@pytest.mark.parametrize("section", SECTIONS)
@pytest.mark.parametrize("role", ["sender", "receiver"])
def test_a_section_that_is_missing_only_before_or_after_is_a_problem(
    attempt: Attempt, role: str, moment: str, section: str
) -> None:
    attempt.replace_text(f"{role}-{moment}.txt", f"==> {section} <==", "==> other <==")
    assert_problems(attempt, f"the section {section} is missing in its state")


@pytest.mark.parametrize("role", ["sender", "receiver"])
def test_a_missing_section_of_jobs_is_a_problem(attempt: Attempt, role: str) -> None:
    attempt.replace_text(f"{role}-after.txt", "==> jobs <==", "==> other <==")
    assert_problems(attempt, "the section jobs is missing in its state")


@pytest.mark.parametrize("moment", ["before", "after"])
@pytest.mark.parametrize("role", ["sender", "receiver"])
def test_a_missing_state_is_a_problem(attempt: Attempt, role: str, moment: str) -> None:
    (attempt.folder / f"{role}-{moment}.txt").unlink()
    assert_problems(attempt, f"{role}-{moment}.txt is missing, or cannot be read")


@pytest.mark.parametrize("job", ["capture asked 0 100000 1090.00\n", "listen itself 0 100000 1060.00\n"])
def test_a_job_without_a_record_of_its_exit_is_a_problem(attempt: Attempt, job: str) -> None:
    attempt.replace_text("receiver-after.txt", job, "")
    assert_problems(attempt, f"its job {job.partition(' ')[0]} ran, but its exit was not recorded")


def test_a_reboot_is_a_problem_unless_a_step_reboots_the_robot(tcp: Attempt) -> None:
    procedure, scene = load_procedure("selfheal"), PLAN.scene(RepeatId(Protocol.TCP, 1), "")
    for role in ("sender", "receiver"):
        tcp.replace_text(f"{role}-after.txt", BOOT, BOOT.replace("a", "b"))
    problems = hosts.problems(procedure, scene, AttemptEvidence(tcp.folder), StepErrors())
    assert list(problems) == ["turtlebot-1: the robot rebooted during the repeat"], (
        "this robot should lose only its link"
    )


def test_a_file_that_differs_from_the_file_that_tcp_delivered_is_a_problem(tcp: Attempt) -> None:
    tcp.change_file("recv.bag", lambda data: data[:100] + bytes([data[100] ^ 1]) + data[101:])
    assert_problems(tcp, "recv.bag is not a prefix of scan.bag")


def test_a_file_that_is_longer_than_the_received_data_is_a_problem(attempt: Attempt) -> None:
    attempt.change_file("recv.bag", lambda data: data + b"more" * 10_000)
    assert_problems(attempt, "capture contains")


def test_a_file_that_is_shorter_than_the_data_that_tcp_delivered_is_a_problem(tcp: Attempt) -> None:
    tcp.change_file("recv.bag", lambda data: data[:-1])
    assert_problems(tcp, "although its listener exited normally")


def test_a_listener_that_reached_its_limit_may_have_read_less_than_tcp_delivered(tcp: Attempt) -> None:
    tcp.change_file("recv.bag", lambda data: data[:-1])
    tcp.replace_text("receiver-after.txt", "listen itself 0", "listen limit 1")
    assert tcp.problems() == ()


def test_sending_more_bytes_than_the_file_has_is_a_problem(attempt: Attempt) -> None:
    for name in ("scan.bag", "recv.bag"):
        attempt.change_file(name, lambda data: data[:-100])
    assert_problems(attempt, "bytes left the sender, but scan.bag has")


def test_a_complete_file_is_a_problem_if_its_capture_lacks_packets(udp: Attempt) -> None:
    udp.change_file("recv.bag", lambda _: (udp.folder / "scan.bag").read_bytes())
    packets = udp.packets("sender.pcap")

    def with_copies(_: list[Packet]) -> list[Packet]:
        return [*packets[:6], *packets[:6], *packets[12:]]

    udp.change_capture("receiver", with_copies)
    assert_problems(udp, "recv.bag is complete, but the receiver's capture lacks ")


@pytest.mark.parametrize("role", ["sender", "receiver"])
def test_replies_that_are_missing_in_a_capture_are_a_problem(attempt: Attempt, role: str) -> None:
    attempt.change_capture(role, lambda packets: packets[:-30])
    assert_problems(attempt, f"but the {role}'s capture has only")


@pytest.mark.parametrize("role", ["sender", "receiver"])
def test_packets_of_another_ping_do_not_count_as_replies(attempt: Attempt, role: str) -> None:
    """Half of the captured packets belong to a parallel ping, which has another identifier."""

    def change_identifiers(packets: list[Packet]) -> list[Packet]:
        echoes = [
            at for at, (_, rest) in enumerate(packets) if rest[LENGTHS_BYTES + 9] == ICMP and not _is_later(rest)
        ]
        assert len(echoes) > 4
        # Requests and replies alternate: select both packets of every other exchange.
        every_other = [at for number, at in enumerate(echoes) if number // 2 % 2]
        others = {
            at: packets[at][1][: LENGTHS_BYTES + 24] + b"??" + packets[at][1][LENGTHS_BYTES + 26 :]
            for at in every_other
        }
        return [(time_us, others.get(at, rest)) for at, (time_us, rest) in enumerate(packets)]

    attempt.change_capture(role, change_identifiers)
    assert_problems(attempt, f"but the {role}'s capture has only")


def _is_later(rest: bytes) -> bool:
    return int.from_bytes(rest[LENGTHS_BYTES + 6 : LENGTHS_BYTES + 8], "big") & 0x1FFF > 0


def test_counters_of_ping_that_contradict_its_lines_are_a_problem(attempt: Attempt) -> None:
    content = (attempt.folder / "ping.txt").read_text(encoding="utf-8")
    answers = sum("bytes from" in line for line in content.splitlines())
    attempt.replace_text("ping.txt", f"{answers} received", f"{answers - 1} received")
    assert_problems(attempt, f"ping counted {answers - 1} answers and printed {answers}")


def test_a_round_trip_time_of_zero_is_a_problem(udp: Attempt) -> None:
    """Ping of iputils prints this if its log has "time of day goes back"."""
    lines = (udp.folder / "ping.txt").read_text(encoding="utf-8")
    match = re.search(r"time=[0-9.]+ ms", lines)
    assert match
    udp.replace_text("ping.txt", match[0], "time=0.000 ms")
    reason = "ping.txt has a round-trip time of 0: the clock was set back while ping waited"
    assert reason in udp.problems()


@pytest.mark.parametrize(
    ("shift_s", "reason"), [(-3600, "before the start of the attempt"), (3600, "after the end of the attempt")]
)
def test_a_capture_from_before_or_after_the_attempt_is_a_problem(attempt: Attempt, shift_s: int, reason: str) -> None:
    attempt.change_capture("receiver", lambda packets: [(at + shift_s * 10**6, rest) for at, rest in packets])
    assert_problems(attempt, reason)


def test_a_clock_that_was_set_back_and_ahead_during_a_capture_is_a_problem(attempt: Attempt) -> None:
    def set_back_and_ahead(packets: list[Packet]) -> list[Packet]:
        middle = range(len(packets) // 3, len(packets) // 2)
        return [(at - 200_000 * (index in middle), rest) for index, (at, rest) in enumerate(packets)]

    attempt.change_capture("receiver", set_back_and_ahead)
    assert_problems(attempt, "receiver capture: a packet is 0.")


@pytest.mark.parametrize("role", ["sender", "receiver"])
def test_a_clock_that_was_set_during_the_attempt_is_a_problem(attempt: Attempt, role: str) -> None:
    name, robot = f"{role}-after.txt", {"sender": "turtlebot-1", "receiver": "turtlebot-2"}[role]
    first_ns = 1_000 * attempt.packets(f"{role}.pcap")[0][0]
    true, changed = (clock_state(first_ns + 50 * 10**9 + step_ns, AFTER_S) for step_ns in (0, 200_000_000))
    attempt.replace_text(name, true, changed)
    assert attempt.problems() == (
        f"{robot}: its clock was set ahead by 0.200 s (uncertainty 0.010 s) during the repeat",
    )


def test_a_reboot_is_a_problem(attempt: Attempt) -> None:
    attempt.replace_text("receiver-after.txt", BOOT, BOOT.replace("a", "b"))
    attempt.replace_text("receiver-after.txt", "capture asked 0", "capture itself -")
    assert_problems(attempt, "turtlebot-2: the robot rebooted during the repeat")


@pytest.mark.parametrize(
    ("name", "old", "new", "reason"),
    [
        (
            "receiver",
            "capture asked",
            "capture itself",
            "turtlebot-2: its job capture exited before fieldkit stopped it",
        ),
        ("sender", "capture asked 0", "capture limit 0", "turtlebot-1: its job capture did not exit"),
        ("receiver", "listen itself 0", "listen itself 143", "its job listen was killed by SIGTERM, not by fieldkit"),
        ("sender", "send itself 0", "send itself 137", "its job send was killed by SIGKILL, not by fieldkit"),
        ("sender", "send itself 0 100000 1060.00", "send itself - 100000 -", "its job send was killed"),
        (
            "sender",
            "record itself 0 100000 1001.50",
            "record itself 0 100000 1000.40",
            "exited after 0.4 s instead of 1 s",
        ),
        ("sender", "ping itself 0", "ping asked 0", "its job ping was stopped by fieldkit before it had finished"),
    ],
)
def test_a_job_that_fieldkit_did_not_end_is_a_problem(
    attempt: Attempt, name: str, old: str, new: str, reason: str
) -> None:
    attempt.replace_text(f"{name}-after.txt", old, new)
    (problem,) = attempt.problems()
    assert reason in problem


def test_a_traditional_netcat_that_a_signal_terminated_is_a_problem(attempt: Attempt) -> None:
    attempt.replace_text("sender-after.txt", "send itself 0", "send itself 1")
    (attempt.folder / "sender-send.log").write_text("\n", encoding="ascii")
    assert attempt.problems() == ("sender-send.log: netcat was terminated by a signal",)


@pytest.mark.parametrize(
    ("code", "log", "is_problem"),
    [
        (1, "\n", True),
        (1, "", True),
        (1, "nc: write error: No space left on device\n", True),
        (2, "write: No space left on device\n", True),
        (0, "", False),
        (1, "no connection : Connection timed out\n", False),
        (2, "Ncat: Idle timeout expired (2000 ms). QUITTING.\n", False),
    ],
)
def test_a_listener_that_was_stopped_or_could_not_write_is_a_problem(
    attempt: Attempt, code: int, log: str, *, is_problem: bool
) -> None:
    attempt.replace_text("receiver-after.txt", "listen itself 0", f"listen itself {code}")
    (attempt.folder / "receiver-listen.log").write_text(log, encoding="ascii")
    reason = "receiver-listen.log: netcat was terminated by a signal, or could not write recv.bag"
    assert attempt.problems() == ((reason,) if is_problem else ())
