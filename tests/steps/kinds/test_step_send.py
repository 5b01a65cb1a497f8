"""A step `send`: bytes made up or a file of the robot's, and then a transfer as any other."""

import subprocess
from pathlib import Path

import pytest

from fieldkit.cli.dry_run import in_shell
from fieldkit.config import schema
from fieldkit.core.deadline import Deadline
from fieldkit.core.errors import ConfigurationError, RobotError
from fieldkit.core.model import FIXED_ROLES, Protocol, Role, Verdict
from fieldkit.measure.transfers.columns import COLUMNS
from fieldkit.remote import jobs
from fieldkit.steps.kinds.send import SendStep
from fieldkit.steps.scene import Said, Scene
from fieldkit.trial.procedure import Procedure
from tests.helpers.casts import CAST
from tests.helpers.idle_testbed import IdleTestbed
from tests.helpers.userlands import USERLANDS, LocalShell, path_of

SCENE = Scene(Protocol.UDP, CAST, "f")


def send(keys: str) -> SendStep:
    text = f"{{from: sender, to: receiver, {keys}}}"
    return schema.validate(schema.parse(text, source="x.yaml"), SendStep)


def park_miller(seed: int, size: int) -> bytes:
    """Numbers of the minimal standard generator, as hexadecimal text, by integers of any length."""
    text, number = "", seed
    while len(text) < size:
        number = 7**5 * number % (2**31 - 1)
        text += f"{number:08x}"
    return text[:size].encode()


def test_the_generator_is_the_minimal_standard() -> None:
    """Park and Miller 1988: of a generator that is right, number 10,000 after 1 is 1,043,618,065."""
    assert park_miller(1, 80_000)[-8:] == b"%08x" % 1_043_618_065


@pytest.mark.parametrize("userland", USERLANDS)
@pytest.mark.parametrize(("seed", "size"), [(1, 1), (1, 64), (7, 1000), (2**31 - 2, 1_234), (42, 100_001)])
def test_bytes_made_up_are_the_same_on_every_robot(tmp_path: Path, userland: str, seed: int, size: int) -> None:
    make = next(send(f"size: {size}B, seed: {seed}").jobs(SCENE))
    robot = LocalShell(tmp_path, path_of(userland, tmp_path / "bin"))
    done = robot.run(make.job.argv, deadline=Deadline.after(60.0))
    assert done.stdout == park_miller(seed, size)


def test_what_both_robots_are_told() -> None:
    make, listen, netcat = send("size: 2MB, port: 4000").jobs(SCENE)
    assert (make.role, make.program, make.job.stdout) == (Role.SENDER, "awk", "send.bin")
    assert make.job.argv[:5] == ("awk", "-v", "seed=1", "-v", "bytes=2000000")
    assert in_shell(listen.job) == "nc.traditional -u -l -p 4000 -w 2 > recv.bin 2> receiver-listen.log"
    assert in_shell(netcat.job) == "nc.traditional -u -q 0 10.42.0.2 4000 < send.bin 2> sender-send.log"


def test_a_name_stands_before_all_that_it_leaves() -> None:
    step = send("size: 2MB, name: up")
    assert [one.job.name for one in step.jobs(SCENE)] == ["up.make", "up.listen", "up.send"]
    assert all(name.startswith("up.") for name in step.files())
    assert {"up.send.bin", "up.recv.bin", "up.sender-make.log"} < set(step.files())


@pytest.mark.parametrize(
    ("file", "copied"),
    [("/opt/maps/a b.pgm", "/opt/maps/a b.pgm"), ("maps/lab.pgm", "maps/lab.pgm"), ("~/lab.pgm", "lab.pgm")],
)
def test_a_file_is_copied_from_where_it_lies(tmp_path: Path, file: str, copied: str) -> None:
    step = send(f"size: 1kB, file: '{file}'")
    make = next(step.jobs(SCENE))
    assert make.job.argv[3:] == ("sh", copied, "send.bin")
    assert make.program == "cp"
    if not copied.startswith("/"):
        (tmp_path / copied).parent.mkdir(exist_ok=True)
        (tmp_path / copied).write_bytes(b"map")
        LocalShell(tmp_path).run(make.job.argv, deadline=Deadline.after(60.0))
        assert (tmp_path / "send.bin").read_bytes() == b"map"
        (need,) = step.needs(SCENE)
        done = subprocess.run(need.argv, env={"HOME": str(tmp_path)}, capture_output=True, text=True, check=True)
        assert need.judge(Said(done.stdout.strip(), 0))[0] is Verdict.WARN, "3 bytes, and not 1000"


@pytest.mark.parametrize(
    ("said", "verdict", "words"),
    [
        (Said("1900", 0), Verdict.OK, "1.9 kB"),
        (Said("501", 0), Verdict.OK, "0.5 kB"),
        (Said("499", 0), Verdict.WARN, "but the procedure has 1.0 kB"),
        (Said("2001", 0), Verdict.WARN, "but the procedure has 1.0 kB"),
        (Said("0", 0), Verdict.FAIL, "it is empty"),
        (Said("sh: 1: cannot open maps/lab.pgm: No such file", 2), Verdict.FAIL, "cannot open"),
        (Said("", 0), Verdict.FAIL, ""),
    ],
)
def test_the_file_is_looked_for_before_the_first_repeat(said: Said, verdict: Verdict, words: str) -> None:
    (need,) = send("size: 1kB, file: maps/lab.pgm").needs(SCENE)
    found, detail, remedy = need.judge(said)
    assert found is verdict
    assert words in detail
    assert (remedy == "") == (verdict is Verdict.OK)


def test_bytes_made_up_need_no_file() -> None:
    assert not list(send("size: 1kB").needs(SCENE))


@pytest.mark.parametrize(
    ("keys", "why"),
    [
        ("port: 4000", "size"),
        ("size: 1000", "write for example 1000B"),
        ("size: 0B", "greater than 0"),
        ("size: 1kB, seed: 0", "greater than 0"),
        ("size: 1kB, file: ''", "file"),
    ],
)
def test_what_cannot_be_sent_is_refused(keys: str, why: str) -> None:
    with pytest.raises(ConfigurationError, match=why):
        send(keys)


def test_room_is_reserved_on_both_robots_and_packets_are_as_many() -> None:
    step = send("size: 3MB")
    assert [step.bytes_left(SCENE, role) for role in (Role.SENDER, Role.RECEIVER, Role.RELAY)] == [3e6, 3e6, 0.0]
    (flow,) = step.flows(SCENE)
    assert flow.port == 1234
    assert flow.frames == pytest.approx(6 * 3e6 / 8192)
    assert step.output_columns() == COLUMNS
    assert not list(step.refusals(SCENE))


def test_one_without_a_name_stands_in_for_the_transfer() -> None:
    head = "name: x\nsummary: X\nscenario: los\ntopology: masterless\nprotocols: [udp]\nrepeats: 1\nsteps:\n"
    ends = "from: sender, to: receiver"
    record = "- record: {robot: sender, topics: [/scan], duration: 1s}\n"
    text = f"{head}{record}- transfer: {{{ends}}}\n- send: {{{ends}, size: 1kB}}\n"
    with pytest.raises(ConfigurationError, match="a transfer comes twice"):
        schema.validate(schema.parse(text, source="x.yaml"), Procedure)
    named = text.replace("size: 1kB", "size: 1kB, name: up")
    assert schema.validate(schema.parse(named, source="x.yaml"), Procedure)


def test_what_cannot_be_made_is_told(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(jobs, "run", lambda shell, job: 1)
    testbed = IdleTestbed({role: LocalShell(tmp_path) for role in FIXED_ROLES})
    with pytest.raises(
        RobotError, match="turtlebot-1: the file to send could not be created: cp ended with exit code 1"
    ):
        send("size: 1kB, file: gone").run(SCENE, testbed, lambda name, expected_s: None)
