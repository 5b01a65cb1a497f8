"""Complete evidence of stored attempts passes; one changed file contradicts the others and voids the attempt."""

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
    next((DATA / "fieldkit" / "4" / "trials").glob(f"{began}*")) for began in ("20261122T010946", "20261122T013134")
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

HEADS = 8
"""Offset of a record's lengths, after which its IP packet starts."""
ICMP = 1
Packet = tuple[int, bytes]
"""Time in microseconds since 1970, and the rest of the record from its lengths."""


@dataclass(frozen=True)
class Attempt:
    """A copy of a stored attempt, with the state of its robots in the format of the present job script."""

    folder: Path
    protocol: Protocol

    def problems(self, plan: Plan = PLAN) -> tuple[str, ...]:
        return problems(plan, self.protocol, self.folder)

    def text(self, name: str, old: str, new: str) -> None:
        path = self.folder / name
        content = path.read_text(encoding="utf-8")
        assert old in content
        path.write_text(content.replace(old, new), encoding="utf-8")

    def file(self, name: str, change: Callable[[bytes], bytes]) -> None:
        path = self.folder / name
        path.write_bytes(change(path.read_bytes()))

    def packets(self, name: str) -> list[Packet]:
        data, at, packets = (self.folder / name).read_bytes(), 24, list[Packet]()
        while at < len(data):
            seconds, micros, captured_bytes = struct.unpack_from("<3I", data, at)
            packets.append((seconds * 10**6 + micros, data[at + 8 : at + 16 + captured_bytes]))
            at += 16 + captured_bytes
        return packets

    def capture(self, role: str, change: Callable[[list[Packet]], Sequence[Packet]]) -> None:
        """Change the packets of a capture, and adapt the counts of tcpdump."""
        name = f"{role}.pcap"
        packets = self.packets(name)
        changed = change(packets)
        records = (struct.pack("<2I", *divmod(at, 10**6)) + rest for at, rest in changed)
        self.file(name, lambda data: data[:24] + b"".join(records))
        (self.folder / f"{role}-capture.log").write_text(LOG.format(len(changed)), encoding="utf-8")


def note(at_ns: int, up_s: int, boot: str = BOOT) -> str:
    wall = f"{at_ns // 10**9}.{at_ns % 10**9:09d}"
    return f"==> boot <==\n{boot}\n==> clock <==\n{up_s}.00 {wall} {up_s}.00\n==> date <==\n{wall}\n"


@pytest.fixture(params=Protocol)
def attempt(request: pytest.FixtureRequest, tmp_path: Path) -> Attempt:
    return of(request.param, tmp_path)


@pytest.fixture
def tcp(tmp_path: Path) -> Attempt:
    return of(Protocol.TCP, tmp_path)


@pytest.fixture
def udp(tmp_path: Path) -> Attempt:
    return of(Protocol.UDP, tmp_path)


def of(protocol: Protocol, folder: Path, trial: Path = LOSSLESS) -> Attempt:
    copy = Attempt(Path(shutil.copytree(trial / "repeats" / f"{protocol}-01", folder / "attempt")), protocol)
    for role, jobs in (("sender", SENDER_JOBS), ("receiver", RECEIVER_JOBS)):
        first_ns = 1_000 * copy.packets(f"{role}.pcap")[0][0]
        moments = [note(first_ns + (up_s - 1_050) * 10**9, up_s) for up_s in (BEFORE_S, AFTER_S)]
        (copy.folder / f"{role}-before.txt").write_text(moments[0], encoding="utf-8")
        (copy.folder / f"{role}-after.txt").write_text(f"==> jobs <==\n{jobs}{moments[1]}", encoding="utf-8")
    return copy


@pytest.mark.parametrize("trial", [LOSSLESS, LOSSY], ids=["lossless", "lossy"])
@pytest.mark.parametrize("protocol", Protocol)
def test_complete_evidence_has_no_contradictions(protocol: Protocol, trial: Path, tmp_path: Path) -> None:
    assert of(protocol, tmp_path, trial).problems(plans.read_plan(trial)) == ()


def demand(attempt: Attempt, *reasons: str) -> None:
    problems = attempt.problems()
    assert all(any(reason in problem for problem in problems) for reason in reasons), problems


@pytest.mark.parametrize(("role", "capture_role"), [("sender", "sender"), ("receiver", "receiver")])
def test_a_capture_that_ended_in_the_middle(attempt: Attempt, role: str, capture_role: str) -> None:
    """It looks complete: exit code 0, consistent counters."""
    attempt.capture(role, lambda packets: packets[: len(packets) // 3])
    demand(attempt, f"the {capture_role}'s capture")


@pytest.mark.parametrize("role", ["sender", "receiver"])
def test_a_capture_without_its_beginning(attempt: Attempt, role: str) -> None:
    attempt.capture(role, lambda packets: packets[6:])
    demand(attempt, f"the {role}'s capture")


@pytest.mark.parametrize(
    ("role", "reason"),
    [
        ("sender", "or the sender's capture is incomplete"),
        ("receiver", "a connection whose SYN is not in the receiver's capture"),
    ],
)
def test_a_handshake_missing_in_one_capture(tcp: Attempt, role: str, reason: str) -> None:
    tcp.capture(role, lambda packets: packets[3:])
    demand(tcp, reason)


@pytest.mark.parametrize(("calls", "is_reported"), [(1, True), (2, False)])
def test_a_connection_that_was_refused(tcp: Attempt, calls: int, *, is_reported: bool) -> None:
    """An immediate refusal: no listener; a refusal after lost calls: perhaps the listener was at its time limit."""

    def with_reset(packets: list[Packet]) -> list[Packet]:
        (at, call), (answered, answer) = packets[:2]
        assert answer[41] == 0x12, "SYN and ACK"
        return [(at, call)] * calls + [(answered, answer[:41] + bytes([0x14]) + answer[42:])]

    for role in ("sender", "receiver"):
        tcp.capture(role, with_reset)
    tcp.file("recv.bag", lambda _: b"")
    message = "the receiver refused the connection: no program was listening when the sender started"
    assert (message in " ".join(tcp.problems())) == is_reported


def test_a_bag_that_is_missing_contradicts_nothing(attempt: Attempt) -> None:
    (attempt.folder / "scan.bag").unlink()
    assert attempt.problems() == ("scan.bag: there is no bag",)


def test_a_link_that_lost_everything_contradicts_nothing(udp: Attempt) -> None:
    sender = udp.packets("sender.pcap")[0][1][8 + 12 : 8 + 16]
    udp.capture("receiver", lambda _: [])
    udp.capture("sender", lambda packets: [packet for packet in packets if packet[1][8 + 12 : 8 + 16] == sender])
    (udp.folder / "recv.bag").write_bytes(b"")
    sent = "10 packets transmitted, 0 received, 100% packet loss, time 1800ms\n"
    (udp.folder / "ping.txt").write_text(f"PING 10.42.0.2 (10.42.0.2) 8192(8220) bytes of data.\n\n{sent}")
    assert udp.problems() == ()


SECTIONS = ["boot", "clock", "date"]


@pytest.mark.parametrize("section", SECTIONS)
def test_sections_that_a_robot_never_provides_contradict_nothing(attempt: Attempt, section: str) -> None:
    """The section is missing before and after, because the robot lacks the tool."""
    for role in ("sender", "receiver"):
        for moment in ("before", "after"):
            note = attempt.folder / f"{role}-{moment}.txt"
            note.write_text(note.read_text(encoding="utf-8").replace(f"==> {section} <==", "==> other <=="))
    assert attempt.problems() == ()


@pytest.mark.parametrize("moment", ["before", "after"])
@pytest.mark.parametrize("section", SECTIONS)
@pytest.mark.parametrize("role", ["sender", "receiver"])
def test_a_section_that_is_present_only_once(attempt: Attempt, role: str, moment: str, section: str) -> None:
    attempt.text(f"{role}-{moment}.txt", f"==> {section} <==", "==> other <==")
    demand(attempt, f"the section {section} is missing in its state")


@pytest.mark.parametrize("role", ["sender", "receiver"])
def test_jobs_without_any_record(attempt: Attempt, role: str) -> None:
    attempt.text(f"{role}-after.txt", "==> jobs <==", "==> other <==")
    demand(attempt, "the section jobs is missing in its state")


@pytest.mark.parametrize("moment", ["before", "after"])
@pytest.mark.parametrize("role", ["sender", "receiver"])
def test_a_state_that_is_missing(attempt: Attempt, role: str, moment: str) -> None:
    (attempt.folder / f"{role}-{moment}.txt").unlink()
    demand(attempt, f"{role}-{moment}.txt is missing, or cannot be read")


@pytest.mark.parametrize("job", ["capture asked 0 100000 1090.00\n", "listen itself 0 100000 1060.00\n"])
def test_a_job_without_a_record_of_its_end(attempt: Attempt, job: str) -> None:
    attempt.text("receiver-after.txt", job, "")
    demand(attempt, f"its job {job.partition(' ')[0]} ran, but its exit was not recorded")


def test_a_robot_that_a_step_reboots_may_reboot(tcp: Attempt) -> None:
    procedure, scene = load_procedure("selfheal"), PLAN.scene(RepeatId(Protocol.TCP, 1), "")
    for role in ("sender", "receiver"):
        tcp.text(f"{role}-after.txt", BOOT, BOOT.replace("a", "b"))
    problems = hosts.problems(procedure, scene, AttemptEvidence(tcp.folder), StepErrors())
    assert list(problems) == ["turtlebot-1: the robot rebooted during the repeat"], (
        "of the robot that only loses its link"
    )


def test_a_file_that_tcp_cannot_have_delivered(tcp: Attempt) -> None:
    tcp.file("recv.bag", lambda data: data[:100] + bytes([data[100] ^ 1]) + data[101:])
    demand(tcp, "recv.bag is not a prefix of scan.bag")


def test_a_file_with_more_than_arrived(attempt: Attempt) -> None:
    attempt.file("recv.bag", lambda data: data + b"more" * 10_000)
    demand(attempt, "capture contains")


def test_a_file_with_less_than_tcp_delivered(tcp: Attempt) -> None:
    tcp.file("recv.bag", lambda data: data[:-1])
    demand(tcp, "although its listener exited normally")


def test_a_listener_at_its_limit_may_leave_bytes_that_tcp_delivered(tcp: Attempt) -> None:
    tcp.file("recv.bag", lambda data: data[:-1])
    tcp.text("receiver-after.txt", "listen itself 0", "listen limit 1")
    assert tcp.problems() == ()


def test_more_bytes_than_the_file_has_left_the_sender(attempt: Attempt) -> None:
    for name in ("scan.bag", "recv.bag"):
        attempt.file(name, lambda data: data[:-100])
    demand(attempt, "bytes left the sender, but scan.bag has")


def test_a_complete_file_with_lost_packets_replaced_by_copies(udp: Attempt) -> None:
    udp.file("recv.bag", lambda _: (udp.folder / "scan.bag").read_bytes())
    packets = udp.packets("sender.pcap")

    def with_copies(_: list[Packet]) -> list[Packet]:
        return [*packets[:6], *packets[:6], *packets[12:]]

    udp.capture("receiver", with_copies)
    demand(udp, "recv.bag is complete, but the receiver's capture lacks ")


@pytest.mark.parametrize("role", ["sender", "receiver"])
def test_replies_that_are_in_no_capture(attempt: Attempt, role: str) -> None:
    attempt.capture(role, lambda packets: packets[:-30])
    demand(attempt, f"but the {role}'s capture has only")


@pytest.mark.parametrize("role", ["sender", "receiver"])
def test_replies_that_match_only_packets_of_another_ping(attempt: Attempt, role: str) -> None:
    """Of a parallel ping with another identifier: half of the packets of each are as many as those of one."""

    def shared(packets: list[Packet]) -> list[Packet]:
        echoes = [at for at, (_, rest) in enumerate(packets) if rest[HEADS + 9] == ICMP and not _is_later(rest)]
        assert len(echoes) > 4
        # Requests and replies alternate: keep both of every other exchange.
        every_other = [at for number, at in enumerate(echoes) if number // 2 % 2]
        others = {at: packets[at][1][: HEADS + 24] + b"??" + packets[at][1][HEADS + 26 :] for at in every_other}
        return [(time_us, others.get(at, rest)) for at, (time_us, rest) in enumerate(packets)]

    attempt.capture(role, shared)
    demand(attempt, f"but the {role}'s capture has only")


def _is_later(rest: bytes) -> bool:
    return int.from_bytes(rest[HEADS + 6 : HEADS + 8], "big") & 0x1FFF > 0


def test_a_ping_whose_counters_contradict_its_lines(attempt: Attempt) -> None:
    content = (attempt.folder / "ping.txt").read_text(encoding="utf-8")
    answers = sum("bytes from" in line for line in content.splitlines())
    attempt.text("ping.txt", f"{answers} received", f"{answers - 1} received")
    demand(attempt, f"ping counted {answers - 1} answers and printed {answers}")


def test_a_reply_with_a_round_trip_time_of_zero(udp: Attempt) -> None:
    """The output of iputils if its log has "time of day goes back"."""
    lines = (udp.folder / "ping.txt").read_text(encoding="utf-8")
    match = re.search(r"time=[0-9.]+ ms", lines)
    assert match
    udp.text("ping.txt", match[0], "time=0.000 ms")
    reason = "ping.txt has a round-trip time of 0: the clock was set back while ping waited"
    assert reason in udp.problems(), "among other reasons"


@pytest.mark.parametrize(
    ("shift_s", "reason"), [(-3600, "before the start of the attempt"), (3600, "after the end of the attempt")]
)
def test_a_capture_of_another_time(attempt: Attempt, shift_s: int, reason: str) -> None:
    attempt.capture("receiver", lambda packets: [(at + shift_s * 10**6, rest) for at, rest in packets])
    demand(attempt, reason)


def test_a_clock_that_was_set_back_within_a_capture_and_ahead_again(attempt: Attempt) -> None:
    def stepped(packets: list[Packet]) -> list[Packet]:
        middle = range(len(packets) // 3, len(packets) // 2)
        return [(at - 200_000 * (index in middle), rest) for index, (at, rest) in enumerate(packets)]

    attempt.capture("receiver", stepped)
    demand(attempt, "receiver capture: a packet is 0.")


@pytest.mark.parametrize("role", ["sender", "receiver"])
def test_a_clock_that_was_set(attempt: Attempt, role: str) -> None:
    name, robot = f"{role}-after.txt", {"sender": "turtlebot-1", "receiver": "turtlebot-2"}[role]
    first_ns = 1_000 * attempt.packets(f"{role}.pcap")[0][0]
    true, changed = (note(first_ns + 50 * 10**9 + step_ns, AFTER_S) for step_ns in (0, 200_000_000))
    attempt.text(name, true, changed)
    assert attempt.problems() == (
        f"{robot}: its clock was set ahead by 0.200 s (uncertainty 0.010 s) during the repeat",
    )


def test_a_robot_that_rebooted(attempt: Attempt) -> None:
    attempt.text("receiver-after.txt", BOOT, BOOT.replace("a", "b"))
    attempt.text("receiver-after.txt", "capture asked 0", "capture itself -")
    demand(attempt, "turtlebot-2: the robot rebooted during the repeat")


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
def test_a_job_that_was_ended_by_another_program(
    attempt: Attempt, name: str, old: str, new: str, reason: str
) -> None:
    attempt.text(f"{name}-after.txt", old, new)
    (problem,) = attempt.problems()
    assert reason in problem


def test_a_traditional_netcat_that_caught_a_signal(attempt: Attempt) -> None:
    attempt.text("sender-after.txt", "send itself 0", "send itself 1")
    (attempt.folder / "sender-send.log").write_text("\n", encoding="ascii")
    assert attempt.problems() == ("sender-send.log: netcat was terminated by a signal",)


@pytest.mark.parametrize(
    ("code", "log", "cut"),
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
def test_a_listener_that_was_stopped_or_could_not_write(attempt: Attempt, code: int, log: str, *, cut: bool) -> None:
    attempt.text("receiver-after.txt", "listen itself 0", f"listen itself {code}")
    (attempt.folder / "receiver-listen.log").write_text(log, encoding="ascii")
    reason = "receiver-listen.log: netcat was terminated by a signal, or could not write recv.bag"
    assert attempt.problems() == ((reason,) if cut else ())
