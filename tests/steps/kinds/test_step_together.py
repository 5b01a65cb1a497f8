"""Simultaneous steps on robots of this machine: all steps start, and the first failure stops the others."""

import threading
from _thread import interrupt_main
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import pytest

from fieldkit.config import schema
from fieldkit.core.deadline import Deadline
from fieldkit.core.errors import ConfigurationError, RobotError
from fieldkit.core.model import Protocol, Role
from fieldkit.remote import evidence, jobs
from fieldkit.remote.jobs import Job
from fieldkit.steps.base import Step, StepEntry
from fieldkit.steps.kinds.together import MAX_PARALLEL, TogetherStep
from fieldkit.steps.kinds.transfer import TransferStep
from fieldkit.steps.nest import Nest
from fieldkit.steps.scene import Announce, Planned, RecordedFile, Scene
from fieldkit.trial.procedure import Procedure
from tests.helpers.casts import CAST
from tests.helpers.idle_testbed import IdleTestbed
from tests.helpers.sshd import free_port, wait_until
from tests.helpers.userlands import LocalShell

FOLDER = jobs.work_folder("trial", "tcp-01-1")
HEAD = "name: x\nsummary: x\nscenario: los\ntopology: master\nprotocols: [tcp]\nrepeats: 1\nsteps:\n"
WAIT = {"wait": {"duration": "60min"}}
RECORD = "  - record: {robot: sender, topics: [/scan], duration: 1s}\n"


class CommandStep(Step):
    """A step that runs a shell command."""

    command: str

    def jobs(self, scene: Scene) -> Iterator[Planned]:
        argv = ("sh", "-c", self.command)
        yield Planned(
            Role.SENDER, Job(scene.folder, self.prefixed_name("says"), argv, limit_s=60, log=self.files()[0]), "sh"
        )

    def run(self, scene: Scene, testbed: IdleTestbed, announce: Announce) -> None:  # type: ignore[override]
        (planned,) = self.jobs(scene)
        announce(self.name, None)
        if code := jobs.run(testbed.shells[Role.SENDER], planned.job):
            raise RobotError(f"{self.name} ended with {code}")

    def roles(self) -> frozenset[Role]:
        return frozenset({Role.SENDER})

    def expected_s(self, protocol: Protocol) -> float:
        return float(len(self.name))

    def exclusive_resources(self) -> tuple[str, ...]:
        return ()

    def files(self) -> tuple[str, ...]:
        return (self.prefixed_name("says.log"),)


class SequenceStep(Nest):
    """Runs steps in order."""

    during: tuple[StepEntry, ...]

    def jobs(self, scene: Scene) -> Iterator[Planned]:
        return self.inside(scene)

    def run(self, scene: Scene, testbed: IdleTestbed, announce: Announce) -> None:  # type: ignore[override]
        for entry in self.during:
            entry.step.run(scene, testbed, announce)

    def roles(self) -> frozenset[Role]:
        return self.roles_inside()

    def expected_s(self, protocol: Protocol) -> float:
        return self.inside_s(protocol)

    def exclusive_resources(self) -> tuple[str, ...]:
        return ()

    def files(self) -> tuple[str, ...]:
        return ()


def together(**commands: str) -> TogetherStep:
    entries = (StepEntry("says", CommandStep(name=name, command=command)) for name, command in commands.items())
    return TogetherStep(during=tuple(entries))


@pytest.fixture
def robots(tmp_path: Path) -> Iterator[IdleTestbed]:
    shells = {role: LocalShell(tmp_path / role) for role in (Role.SENDER, Role.RECEIVER)}
    for role, shell in shells.items():
        shell.home.mkdir()
        jobs.install(shell, Deadline.after(30))
        evidence.begin(shell, FOLDER, role, "lo")
    yield IdleTestbed(shells)
    for shell in shells.values():
        shell.close()


def folder(robots: IdleTestbed, role: Role = Role.SENDER) -> Path:
    shell = robots.shells[role]
    assert isinstance(shell, LocalShell)
    return shell.home / FOLDER


def run(step: Step, robots: IdleTestbed, *recorded_names: str) -> list[str]:
    phases: list[str] = []
    cast = {role: robot.model_copy(update={"address": "127.0.0.1"}) for role, robot in CAST.items()}
    files = {Role.SENDER: tuple(RecordedFile(Role.SENDER, name, 1e4, alias=name[:-4]) for name in recorded_names)}
    scene = Scene(Protocol.TCP, cast, FOLDER, files)
    step.run(scene, robots, lambda name, expected_s: phases.append(name))
    return phases


def running_jobs(robots: IdleTestbed) -> Sequence[str]:
    return jobs.list_running(robots.shells[Role.SENDER], Deadline.after(30))


@pytest.mark.emulated
def test_steps_run_at_the_same_time(robots: IdleTestbed) -> None:
    """Each step waits for the files of the other two."""
    wait_for_all = "touch {0}; until [ -e a ] && [ -e b ] && [ -e c ]; do sleep 0.01; done"
    phases = run(together(**{name: wait_for_all.format(name) for name in "abc"}), robots)
    assert sorted(phases) == ["a", "b", "c"]
    assert not running_jobs(robots)


@pytest.mark.emulated
def test_transfers_run_at_the_same_time(robots: IdleTestbed) -> None:
    bags = {"a": b"a" * 20_000, "b": b"b" * 30_000}
    for name, content in bags.items():
        (folder(robots) / f"{name}.bag").write_bytes(content)
    steps = [
        {"transfer": {"from": "sender", "to": "receiver", "name": n, "file": n, "port": free_port()}} for n in bags
    ]
    run(TogetherStep.model_validate({"during": steps}), robots, "a.bag", "b.bag")
    assert {name: (folder(robots, Role.RECEIVER) / f"{name}.recv.bag").read_bytes() for name in bags} == bags


@pytest.mark.emulated
def test_first_failure_stops_the_others_and_is_reported(robots: IdleTestbed) -> None:
    started = "touch {0}; sleep 50; touch {0}.done"
    failing = "until [ -e a ] && [ -e b ]; do sleep 0.01; done; exit 7"
    with pytest.raises(RobotError, match="c ended with 7"):
        run(together(a=started.format("a"), b=started.format("b"), c=failing), robots)
    assert not running_jobs(robots)
    assert not list(folder(robots).glob("*.done"))


@pytest.mark.emulated
@pytest.mark.parametrize("inside", [WAIT, {"together": {"during": [WAIT, WAIT]}}])
def test_first_failure_interrupts_a_wait_and_the_steps_after_it(robots: IdleTestbed, inside: object) -> None:
    """Without the interruption, the wait would take an hour."""
    steps = [
        StepEntry("quiet", SequenceStep.model_validate({"during": [inside, WAIT]})),
        StepEntry("says", CommandStep(name="c", command="exit 7")),
    ]
    threads_before = threading.active_count()
    with pytest.raises(RobotError, match="c ended with 7"):
        run(TogetherStep(during=tuple(steps)), robots)
    wait_until(lambda: threading.active_count() <= threads_before, Deadline.after(30))


@pytest.mark.emulated
def test_started_listener_is_stopped_if_another_step_is_not_ready(robots: IdleTestbed) -> None:
    """The listener of a transfer runs when the other step fails."""
    receiver = robots.shells[Role.RECEIVER]

    class Unready(CommandStep):
        def prepare(self, scene: Scene, testbed: IdleTestbed) -> Callable[[Announce], None]:
            wait_until(lambda: bool(jobs.list_running(receiver, Deadline.after(30))), Deadline.after(30))
            raise RobotError("it is not ready")

    ends = {"from": "sender", "to": "receiver", "port": free_port()}
    entries = (StepEntry("transfer", TransferStep.model_validate(ends)), StepEntry("says", Unready(command="")))
    with pytest.raises(RobotError, match="it is not ready"):
        run(TogetherStep(during=entries), robots, "a.bag")
    assert not jobs.list_running(receiver, Deadline.after(30))


@pytest.mark.quiet
@pytest.mark.emulated
def test_interrupt_does_not_wait_for_steps(robots: IdleTestbed) -> None:
    """Ctrl-C does not wait for the steps; the caller stops the jobs."""

    is_over = threading.Event()

    def interrupt() -> None:
        wait_until(lambda: is_over.is_set() or len(running_jobs(robots)) == 2, Deadline.after(60))
        if not is_over.is_set():  # a later interrupt would terminate the process of the tests
            interrupt_main()

    threads_before = set(threading.enumerate())
    threading.Thread(target=interrupt).start()
    try:
        with pytest.raises(KeyboardInterrupt):
            run(together(a="exec sleep 50", b="exec sleep 50"), robots)
    finally:
        is_over.set()
    evidence.end_jobs(robots.shells[Role.SENDER], FOLDER)
    assert not running_jobs(robots)
    wait_until(lambda: set(threading.enumerate()) <= threads_before, Deadline.after(60))


@pytest.mark.quiet
@pytest.mark.emulated
def test_interrupt_stops_waits_in_other_threads(robots: IdleTestbed) -> None:
    started = threading.Event()

    def interrupt() -> None:
        started.wait()
        interrupt_main()

    def announce(name: str, expected_s: float | None) -> None:
        if name == "wait":
            started.set()

    waiting_step = TogetherStep.model_validate({"during": [WAIT, WAIT]})
    threads_before = threading.active_count()
    threading.Thread(target=interrupt, daemon=True).start()
    with pytest.raises(KeyboardInterrupt):
        waiting_step.run(Scene(Protocol.TCP, CAST, FOLDER), robots, announce)
    wait_until(lambda: threading.active_count() == threads_before, Deadline.after(30))


def test_the_expected_duration_is_that_of_the_longest_step() -> None:
    step = together(a="", long="", longest="")
    assert step.expected_s(Protocol.TCP) == len("longest")
    assert list(step.dry_run_notes(Scene(Protocol.TCP, CAST, FOLDER))) == [
        "at the same time: says a, says long, says longest"
    ]
    assert step.roles() == {Role.SENDER}


FLOW = "from: sender, to: receiver"
SAME_PORT = """\
  - together:
      during:
        - transfer: {FLOW, name: a}
        - transfer: {FLOW, name: b}
"""
IN_ONE_CAPTURE = SAME_PORT.replace("together", "capture")
FAULT_INSIDE = """\
  - together:
      during:
        - ping: {FLOW}
        - fault: {robot: sender, kind: reboot}
"""
MOVE_INSIDE = """\
  - together:
      during:
        - ping: {FLOW}
        - capture:
            during:
              - move: {robot: sender, speed: 1m/s, path: [away: 1m], during: [ping: {FLOW, name: b}]}
"""
SIMULTANEOUS_RECORDING = """\
  - together:
      during:
        - record: {robot: sender, topics: [/a], duration: 1s, name: a}
        - transfer: {FLOW, file: a}
"""
TWO_IPERF3 = """\
  - together:
      during:
        - iperf3: {FLOW, name: a, port: 5201}
        - iperf3: {FLOW, name: b, port: PORT}
"""
TWO_SENDS = """\
  - together:
      during:
        - send: {FLOW, name: a, size: 1kB}
        - send: {FLOW, name: b, size: 1kB, port: PORT}
"""
IPERF3_IN_SOAK = """\
  - soak: {FLOW, during: [
      iperf3: {FLOW, port: PORT}]}
"""
TWO_CLIENTS = """\
  - together:
      during:
        - iperf3: {FLOW, name: a}
        - iperf3: {from: relay, to: receiver, name: b}
"""
OPPOSITE_CLIENTS = TWO_CLIENTS.replace("from: relay, to: receiver", "from: receiver, to: sender")
BOTH_DIRECTIONS = """\
  - capture:
      during:
        - iperf3: {FLOW, name: a}
        - iperf3: {FLOW, name: b, reverse: true}
        - iperf3: {from: receiver, to: sender, name: c}
        - iperf3: {from: relay, to: receiver, name: d}
"""
SAME_DIRECTION = BOTH_DIRECTIONS.replace("reverse: true", "streams: 2")
WITH_A_TRANSFER = BOTH_DIRECTIONS.replace("iperf3: {FLOW, name: a}", "send: {FLOW, size: 1kB, port: 5201}")
FOR_EACH = """\
  - capture:
      during:
        - for:
            each: {n: [a, b]}
            during:
              - iperf3: {FLOW, name: "{n}"}
"""
SEQUENTIAL = """\
  - for:
      each: {n: [a, b]}
      during:
        - together: {during: [iperf3: {FLOW, name: "{n}"}, send: {FLOW, size: 1kB, name: "{n}"}]}
"""
SWEEP = """\
  - for:
      each: {a: [1, 2, 3, 4]}
      during:
        - together: {during: [for: {each: {b: VALUES}, during: [ping: {FLOW, name: "p{a}_{b}"}]}]}
"""


@pytest.mark.parametrize(
    "steps",
    [
        *(
            TWO_IPERF3.replace("PORT", "5202"),
            TWO_SENDS.replace("PORT", "1235"),
            IPERF3_IN_SOAK.replace("PORT", "5201"),
            SEQUENTIAL,
        ),
        *(OPPOSITE_CLIENTS, BOTH_DIRECTIONS, TWO_CLIENTS.replace("together", "capture")),
        IPERF3_IN_SOAK.replace("iperf3: {FLOW, port: PORT}", "iperf3: {from: receiver, to: sender, port: 5202}"),
    ],
)
def test_distinguishable_loads_are_accepted(steps: str) -> None:
    assert load(steps)


def load(steps: str) -> Procedure:
    text = HEAD + RECORD + steps.replace("FLOW", FLOW)
    return schema.validate(schema.parse(text, source="x.yaml"), Procedure)


@pytest.mark.parametrize(
    ("steps", "message", "line"),
    [
        ("  - together: {during: [ping: {FLOW}]}", "at least 2 items", 1),
        (SAME_PORT, "port 1234 is used twice at the same time on receiver; change the port of one of them", 4),
        (
            IN_ONE_CAPTURE,
            "port 1234 is used twice in one capture, from sender to receiver; change the port of one of them",
            4,
        ),
        (TWO_IPERF3.replace("PORT", "5201"), "port 5201 is used twice at the same time", 4),
        (TWO_SENDS.replace("PORT", "1234"), "port 1234 is used twice", 4),
        (FOR_EACH, "port 5201 is used twice in one capture", 6),
        (IPERF3_IN_SOAK.replace("PORT", "5202"), "port 5202 is used twice at the same time", 2),
        (TWO_CLIENTS, "port 5201 is used twice at the same time", 4),
        (SAME_DIRECTION, "port 5201 is used twice in one capture, from sender to receiver", 4),
        (WITH_A_TRANSFER, "port 5201 is used twice in one capture", 4),
        (FAULT_INSIDE, "fault may prompt the operator, so no step may run at the same time", 4),
        (
            FAULT_INSIDE.replace("fault: {robot: sender, kind: reboot}", "wait: {until: say so}"),
            "wait may prompt the operator",
            4,
        ),
        (
            FAULT_INSIDE.replace("fault: {robot: sender, kind: reboot}", "ask: {column: a, question: b}"),
            "ask may prompt the operator",
            4,
        ),
        pytest.param(
            MOVE_INSIDE,
            "move may prompt the operator, so no step may run at the same time",
            6,
            marks=pytest.mark.motion,
        ),
        (SIMULTANEOUS_RECORDING, "sends a, but no recording of that name is made on sender before it", 4),
        (
            SWEEP.replace("VALUES", "[1, 2, 3, 4, 5, 6, 7, 8, 9]"),
            f"9 steps at the same time are more than {MAX_PARALLEL}",
            4,
        ),
    ],
)
def test_steps_that_cannot_run_simultaneously_are_rejected_with_their_line(
    steps: str, message: str, line: int
) -> None:
    with pytest.raises(ConfigurationError) as caught:
        load(steps)
    assert message in caught.value.what
    assert caught.value.where == f"x.yaml:{(HEAD + RECORD).count(chr(10)) + line}"


@pytest.mark.parametrize(
    "steps",
    [
        SAME_PORT.replace("name: b", "name: b, port: 99"),
        IN_ONE_CAPTURE.replace("name: b", "name: b, port: 99"),
        # The transfers run in sequence, each in a separate capture.
        "  - for: {each: {a: [x, y]}, during: [capture: {name: '{a}', during: [transfer: {FLOW, name: '{a}'}]}]}",
        SWEEP.replace("VALUES", "[1, 2, 3]"),
    ],
)
def test_distinguishable_transfers_are_accepted(steps: str) -> None:
    assert load(steps)


def test_transfer_cannot_send_a_simultaneous_recording() -> None:
    recording = "  - together: {during: [record: {robot: relay, topics: [/a], duration: 1s, name: a}, STEP]}"
    with pytest.raises(ConfigurationError, match="no step before it records on relay"):
        load(recording.replace("STEP", "transfer: {from: relay, to: sender}"))
