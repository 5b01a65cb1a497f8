"""A transfer between two robots of this machine over loopback."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import pytest

from fieldkit.core.deadline import Deadline
from fieldkit.core.errors import RobotError
from fieldkit.core.model import DelayParts, Lateness, LinkSample, Protocol, Role, TrackPoint
from fieldkit.measure.evidence import oracle_delays
from fieldkit.remote import evidence, jobs
from fieldkit.remote.shell import Shell
from fieldkit.steps.kinds.transfer import TransferStep
from fieldkit.steps.scene import RecordedFile, Scene
from tests.helpers.casts import CAST
from tests.helpers.idle_testbed import IdleTestbed
from tests.helpers.sshd import free_port, wait_until
from tests.helpers.userlands import LocalSession, LocalShell

pytestmark = pytest.mark.emulated

FOLDER = jobs.work_folder("trial", "udp-01-1")


@dataclass(frozen=True)
class FakeOracle:
    """An oracle that returns the given delays in order."""

    parts: Iterator[DelayParts]

    port: int

    def delays(self, source: Role, destination: Role, protocol: Protocol, port: int, *, link: str = "") -> DelayParts:
        assert (source, destination, protocol, port, link) == (
            Role.SENDER,
            Role.RECEIVER,
            Protocol.TCP,
            self.port,
            "",
        )
        return next(self.parts)

    def track(self, since_utc_ns: int) -> tuple[TrackPoint, ...]:
        raise AssertionError(since_utc_ns)

    def lateness(self) -> Lateness:
        raise AssertionError

    def links(self, *, continue_sampling: bool) -> dict[Role, list[LinkSample]]:
        raise AssertionError(continue_sampling)

    def record_air(self, folder: Path | None) -> None:
        raise AssertionError(folder)


class TestbedWithOracle(IdleTestbed):
    """A testbed with an oracle, if delays are given."""

    oracle: FakeOracle | None

    def __init__(self, shells: Mapping[Role, Shell], delays: Sequence[DelayParts], port: int) -> None:
        super().__init__(shells)
        self.oracle = FakeOracle(iter(delays), port) if delays else None


class LateShell(LocalShell):
    """A robot that accepts a command only after a job of the other robot has exited."""

    until: Path

    def begin(self, argv: Sequence[str], *, deadline: Deadline, until: bytes | None = None) -> LocalSession:
        if "run" in argv:
            wait_until(self.until.is_file, Deadline.after(60))
        return super().begin(argv, deadline=deadline, until=until)


def transfer(
    protocol: Protocol,
    sender: LocalShell,
    receiver: LocalShell,
    delays: Sequence[DelayParts] = (),
    *,
    idle: str = "5s",
    limit: str = "120s",
) -> None:
    for shell in (sender, receiver):
        shell.home.mkdir()
        jobs.install(shell, Deadline.after(30))
        evidence.begin(shell, FOLDER, "sender", "lo")
    (sender.home / FOLDER / "scan.bag").write_bytes(b"x" * 20_000)
    cast = {role: robot.model_copy(update={"address": "127.0.0.1"}) for role, robot in CAST.items()}
    port = free_port()
    step = TransferStep.model_validate(
        {"from": "sender", "to": "receiver", "port": port, "idle": idle, "limit": limit}
    )
    bag = RecordedFile(Role.SENDER, "scan.bag", 20_000)
    scene = Scene(protocol, cast, FOLDER, {Role.SENDER: (bag,)}, laptop_folder=sender.home.parent)
    robots = TestbedWithOracle({Role.SENDER: sender, Role.RECEIVER: receiver}, delays, port)
    try:
        step.run(scene, robots, lambda name, expected_s: None)
    finally:
        sender.close()
        receiver.close()


@pytest.mark.parametrize("protocol", Protocol)
def test_file_arrives(tmp_path: Path, protocol: Protocol) -> None:
    receiver = LocalShell(tmp_path / "receiver")
    transfer(protocol, LocalShell(tmp_path / "sender"), receiver)
    assert (receiver.home / FOLDER / "recv.bag").read_bytes() == b"x" * 20_000
    assert not (tmp_path / "medium.txt").exists(), "there is no oracle, so there are no delays"


def _parts(n: int) -> DelayParts:
    return DelayParts(packets=n, processing_ns=2 * n, transmission_ns=3 * n, propagation_ns=4 * n, queuing_ns=5 * n)


@pytest.mark.parametrize("packets", [0, 215])
def test_delays_of_the_oracle_are_stored(tmp_path: Path, packets: int) -> None:
    delays = _parts(1000), _parts(1000 + packets)
    transfer(Protocol.TCP, LocalShell(tmp_path / "sender"), LocalShell(tmp_path / "receiver"), delays)
    assert oracle_delays.read_air_delay(tmp_path / "medium.txt") == _parts(packets)


@pytest.mark.parametrize(
    ("protocol", "reason"),
    [(Protocol.UDP, "the listener exits after 1 s of silence"), (Protocol.TCP, "the listener was stopped after 2 s")],
)
def test_sender_that_starts_after_end_of_listener_is_an_error(
    tmp_path: Path, protocol: Protocol, reason: str
) -> None:
    sender, receiver = LateShell(tmp_path / "sender"), LocalShell(tmp_path / "receiver")
    sender.until = receiver.home / FOLDER / ".jobs" / "listen" / "exit"
    with pytest.raises(RobotError, match=rf"after the listener, but {reason}"):
        transfer(protocol, sender, receiver, idle="1s", limit="2s")
