"""Conformance of every kind of step to the contract, with one example of each kind on emulated robots.

A new kind adds its example to `EXAMPLES`.
"""

import shutil
import threading
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from itertools import count
from pathlib import Path

import pytest

from fieldkit.backends.protocols import Robot
from fieldkit.cli import main
from fieldkit.config import schema
from fieldkit.config.profiles import Limits, RobotProfile
from fieldkit.config.site import load_site
from fieldkit.core import runtime
from fieldkit.core.columns import step_prefixed
from fieldkit.core.deadline import Deadline
from fieldkit.core.events import Event, PhaseStarted
from fieldkit.core.model import Role, Topology, Verdict
from fieldkit.core.prompts import UNATTENDED
from fieldkit.core.units import parse_distance
from fieldkit.measure.attempt import AttemptEvidence
from fieldkit.motion.profile_sections import Mavlink
from fieldkit.remote import jobs
from fieldkit.remote.jobs import Job
from fieldkit.steps import kinds, nest
from fieldkit.steps.capabilities import UsesSpace
from fieldkit.steps.kinds import iperf3, soak
from fieldkit.steps.scene import Planned
from fieldkit.trial import gates, journal, store
from fieldkit.trial.plan import Plan
from fieldkit.trial.procedure import PlacedStep, Procedure
from fieldkit.trial.request import TrialRequest, make_plan
from fieldkit.trial.running import locks, preflight, resumption, runner
from fieldkit.trial.running.locks import Holder
from fieldkit.trial.running.stop import Stop
from sim_backends.emulated.backend import EmulatedBackend
from sim_backends.emulated.testbed import EmulatedTestbed
from tests.helpers.nightly import mark_nightly
from tests.helpers.paths import ROOT
from tests.helpers.texts import site

pytestmark = pytest.mark.emulated

RECORD = "record: {robot: sender, topics: [/imu], duration: 1s}"
SEND = "send: {from: sender, to: receiver, size: 100kB, limit: 20s}"
SMALL = "iperf3: {from: sender, to: receiver, protocol: udp, rate: 300kbit/s, payload_bytes: 200, duration: 1s}"
PING = "ping: {from: sender, to: receiver, count: 5}"


@dataclass(frozen=True)
class Example:
    """An example of a kind of step.

    Attributes:
        steps: The step and the steps that it needs before it, as a YAML list.
        spare: Files other than logs without which the evidence is still complete.
        outlives: Jobs whose end at their limit is a measurement and not an error.
        brief: Jobs that are too short to be killed, so that a second is added.
        absent: The steps with a program that begins with `no-such`; empty if profiles name its programs.
        unmeasured: True if its columns are empty in the lab of these tests, which has fixed links.
    """

    steps: str
    spare: frozenset[str] = frozenset()
    outlives: frozenset[str] = frozenset()
    brief: frozenset[str] = frozenset()
    absent: str = ""
    unmeasured: bool = False


EXAMPLES: Mapping[str, Example] = {
    "record": Example(f"[{RECORD}]"),
    "capture": Example(f"[capture: {{during: [{SMALL}]}}]"),
    "transfer": Example(
        f"[{RECORD}, transfer: {{from: sender, to: receiver, limit: 20s}}]",
        spare=frozenset({"medium.txt"}),
        outlives=frozenset({"listen", "send"}),
    ),
    "ping": Example(f"[{PING}]"),
    "fault": Example(f"[fault: {{robot: sender, kind: link-down, for: 1s, limit: 4s, during: [{PING}]}}]"),
    "move": Example(f"[move: {{robot: sender, path: [away: 1m], speed: 0.2m/s, during: [{PING}]}}]"),
    "wait": Example("[wait: {duration: 100ms}]"),
    "ask": Example("[ask: {column: wind, question: How strong is the wind, usual: '3'}]"),
    "run": Example(
        "[run: {robot: sender, command: sh -c 'sleep 1; seq 8000; echo U=3', prints: 40kB, "
        "columns: [{name: battery, unit: V, regex: 'U=([0-9])'}]}]",
        absent="[run: {robot: sender, command: no-such-tool}]",
    ),
    "iperf3": Example("[iperf3: {from: sender, to: receiver, rate: 200kbit/s, duration: 1s, limit: 10s}]"),
    "soak": Example(
        f"[capture: {{during: [soak: {{from: receiver, to: sender, rate: 200kbit/s, during: [{PING}]}}]}}]"
    ),
    "roam": Example(f"[roam: {{robot: sender, during: [{PING}]}}]", unmeasured=True),
    "send": Example(
        f"[{SEND}]",
        spare=frozenset({"medium.txt"}),
        outlives=frozenset({"listen", "send"}),
        brief=frozenset({"make"}),
    ),
    "topics": Example("[topics: {from: sender, to: receiver, rate: 50Hz, duration: 1s, patience: 5s}]"),
    "video": Example("[video: {from: sender, to: receiver, rate: 10Hz, size: 128x64, noise: 0 %, duration: 1s}]"),
    "track": Example(f"[track: {{robots: {{sender: {{topic: /odom, facing: away}}}}, during: [{PING}]}}]"),
    "mavlink": Example(
        f"[mavlink: {{robot: sender, at: receiver, rates: {{SYS_STATUS: 5Hz}}, positions: local, facing: away, "
        f"during: [{PING}]}}]"
    ),
    "fly": Example(
        "[fly: {robot: sender, height: 50cm, then: land, during: [ping: {from: sender, to: receiver, count: 2}]}]",
        spare=frozenset({"fly.orders", "guard.orders"}),
    ),
    "together": Example(f"[together: {{during: [{SEND}, {PING}]}}]"),
}
KINDS = sorted(EXAMPLES.keys() & kinds.shipped_names())
TEXT_BYTES = 10_000

SITE = site(emulated="ros: builtin, late_bound: 5s, radio: {loss: 0%, rate: 500kbit/s}")
"""The rate is so low that the transfer of a bag takes more than a second and can be interrupted. A busy machine may
deliver packets late, because no delay is measured.
"""

# Kills the program of a job as soon as it runs: the last child of the job's leader; the first one enforces the limit.
KILL = """
until [ -s "$1/pid" ]; do sleep 0.02; done
read -r leader _ <"$1/pid"
until [ "$children" -ge 2 ]; do
    sleep 0.05
    children=0 last=0
    for process in /proc/[0-9]*; do
        read -r line <"$process/stat" || continue
        rest=${line##*) }; rest=${rest#* }
        [ "${rest%% *}" = "$leader" ] || continue
        children=$((children + 1))
        [ "$last" -gt "${process#/proc/}" ] || last=${process#/proc/}
    done 2>/dev/null
done 2>/dev/null
kill -9 "$last"
"""


def procedure(kind: str, steps: str = "") -> Procedure:
    head = f"name: {kind}\nsummary: x\nscenario: los\ntopology: masterless\nprotocols: [tcp]\nrepeats: 1\n"
    text = f"{head}attempts: 1\nsteps: {steps or EXAMPLES[kind].steps}\n"
    return schema.validate(schema.parse(text, source=f"{kind}.yaml"), Procedure)


def of_kind(kind: str, plan: Plan) -> PlacedStep:
    """Return the step of this kind."""
    return next(placed for placed in plan.procedure.walk() if placed.kind == kind)


def own_jobs(kind: str, plan: Plan) -> list[Planned]:
    return list(nest.own_jobs(of_kind(kind, plan).step, plan.scene(next(plan.repeats_in_order()), "check")))


@dataclass
class Bench:
    """Emulated robots that are shared by all tests, and trials on them."""

    testbed: EmulatedTestbed
    backend: EmulatedBackend
    out: Path
    numbers: Iterator[int] = field(default_factory=count)

    def plan(
        self,
        kind: str,
        profile: Callable[[RobotProfile], RobotProfile] = lambda unchanged: unchanged,
        steps: str = "",
    ) -> Plan:
        cast = cast_of(self.backend)
        cast = {role: robot.model_copy(update={"profile": profile(robot.profile)}) for role, robot in cast.items()}
        now = datetime.fromtimestamp(1_700_000_000 + next(self.numbers), tz=UTC)
        request = TrialRequest(procedure=procedure(kind, steps), distance=parse_distance("5m"))
        return make_plan(request, backend="emulated", cast=cast, now=now, lab_bytes=self.backend.lab_bytes)

    def run(self, plan: Plan, sink: Callable[[Event], None] = lambda event: None) -> tuple[str, str, Path]:
        """Run a trial of one attempt; return its status, the reason, and the folder of its evidence."""
        self.testbed.place(plan.placement)
        with locks.locked_exclusively(
            self.testbed.shells, Holder(plan.session, runtime.user_at_host(), plan.trial), sink=sink
        ):
            runner.begin(plan, self.testbed, self.out, sink, Stop())
        return self.last_attempt(plan)

    def resume(self, plan: Plan) -> tuple[str, str, Path]:
        with locks.locked_exclusively(
            self.testbed.shells, Holder(plan.session, runtime.user_at_host(), plan.trial), sink=lambda event: None
        ):
            resumption.continue_trial(self.out / plan.trial, self.testbed, lambda event: None, Stop())
        return self.last_attempt(plan)

    def last_attempt(self, plan: Plan) -> tuple[str, str, Path]:
        folder = self.out / plan.trial
        attempt = journal.ended_attempts(journal.read(folder))[-1]
        return attempt.status, attempt.reason, store.attempt_folder(folder, attempt.folder)

    def running_jobs(self) -> list[str]:
        """Return the jobs that still run on the robots."""
        return [
            line for shell in self.testbed.shells.values() for line in jobs.list_running(shell, Deadline.after(30))
        ]


FLYING = {
    "mavlink": Mavlink(port=14_550),
    "limits": Limits(max_speed_m_s=1.0, max_height_m=2.0, fence_m=30.0),
}


def cast_of(backend: EmulatedBackend) -> dict[Role, Robot]:
    """Return a cast of robots that fly but do not drive, because they use the built-in ROS."""
    cast = backend.cast(Topology.MASTERLESS)
    return {
        role: robot.model_copy(
            update={"abilities": frozenset({"mavlink"}), "profile": robot.profile.model_copy(update=FLYING)}
        )
        for role, robot in cast.items()
    }


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Bench]:
    out = tmp_path_factory.mktemp("conformance")
    (out / "fieldkit.yaml").write_text(SITE, encoding="utf-8")
    (out / "robots").mkdir()
    profile = (ROOT / "robots" / "turtlebot3_burger.yaml").read_text(encoding="utf-8")
    profile = profile.replace("max_speed_m_s: 0.22", "max_speed_m_s: 1.0\n  max_height_m: 2.0")
    (out / "robots" / "turtlebot3_burger.yaml").write_text(f"{profile}\nmavlink: {{port: 14550}}\n", encoding="utf-8")
    backend = EmulatedBackend(*load_site(out / "fieldkit.yaml"))
    with backend.open(cast_of(backend), seed=1, sink=lambda _: None, operator=UNATTENDED) as testbed:
        assert isinstance(testbed, EmulatedTestbed)
        yield Bench(testbed, backend, out)


@dataclass(frozen=True)
class Valid:
    """A valid attempt of a kind, its plan and its evidence."""

    kind: str
    plan: Plan
    evidence: Path


@pytest.fixture(scope="module", params=KINDS)
def valid(request: pytest.FixtureRequest, bench: Bench) -> Valid:
    """Make one valid attempt of each kind for all tests."""
    plan = bench.plan(request.param)
    status, reason, evidence = bench.run(plan)
    assert (status, reason) == ("valid", "")
    return Valid(request.param, plan, evidence)


def test_every_builtin_kind_has_an_example() -> None:
    assert kinds.shipped_names() <= EXAMPLES.keys()


@pytest.mark.parametrize("kind", KINDS)
def test_dry_run_prints_every_job(
    kind: str, bench: Bench, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (bench.out / "procedures").mkdir(exist_ok=True)
    (bench.out / "procedures" / f"{kind}.yaml").write_text(schema.dump(procedure(kind)), encoding="utf-8")
    monkeypatch.chdir(bench.out)
    assert main(["trial", kind, "5m", "--dry-run"]) == 0
    output = capsys.readouterr().out
    names = [planned.job.name for planned in own_jobs(kind, bench.plan(kind))]
    assert [name for name in names if f" {name}: " not in output] == []


def test_attempt_without_a_file_is_void(valid: Valid, tmp_path: Path) -> None:
    plan, evidence = valid.plan, valid.evidence
    step = of_kind(valid.kind, plan).step
    spare = {step_prefixed(step.prefix, name) for name in EXAMPLES[valid.kind].spare}
    repeat = next(plan.repeats_in_order())
    for name in step.files():
        if name.endswith(".log") or name in spare or not (evidence / name).exists():
            continue
        copy = tmp_path / name
        shutil.copytree(evidence, copy)
        (copy / name).unlink()
        assert gates.judge(plan, repeat, AttemptEvidence(copy)).problems, name


def test_every_column_has_a_value_or_a_reason(valid: Valid) -> None:
    step = of_kind(valid.kind, valid.plan).step
    measured = gates.judge(valid.plan, next(valid.plan.repeats_in_order()), AttemptEvidence(valid.evidence)).measured
    for column in step.output_columns():
        name = step_prefixed(step.prefix, column.name)
        assert name in measured.values or measured.missing[name]
    names = {step_prefixed(step.prefix, column.name) for column in step.output_columns()}
    is_measured = bool(measured.values.keys() & names)
    assert is_measured == (bool(names) and not EXAMPLES[valid.kind].unmeasured)


def test_size_estimate_is_within_a_factor_of_two(valid: Valid) -> None:
    """Small text files do not count."""
    step, scene = of_kind(valid.kind, valid.plan).step, valid.plan.scenes()[0]
    estimate = sum(step.stored_bytes(scene, role) for role in valid.plan.cast) if isinstance(step, UsesSpace) else 0.0
    actual = sum((valid.evidence / name).stat().st_size for name in step.files() if (valid.evidence / name).is_file())
    if max(estimate, actual) > TEXT_BYTES:
        assert estimate / 2 <= actual <= 2 * estimate


@pytest.mark.parametrize("kind", KINDS)
def test_check_finds_missing_program(
    kind: str, bench: Bench, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for module in (iperf3, soak):
        monkeypatch.setattr(module, "PROGRAM", "no-such-iperf3")
    plan = bench.plan(kind, _without_tools, EXAMPLES[kind].absent)
    findings = preflight.check(plan, bench.testbed.shells, tmp_path, all_checks=False).findings
    failed = {(finding.robot, finding.check) for finding in findings if finding.status is Verdict.FAIL}
    programs = {(planned.role, planned.program) for planned in own_jobs(kind, plan)}
    expected = {(plan.cast[role].name, program) for role, program in programs if program.startswith("no-such")}
    assert expected <= failed
    assert expected or not own_jobs(kind, plan)


def _without_tools(profile: RobotProfile) -> RobotProfile:
    """Return a profile with nonexistent programs as tools."""
    names = {
        name: f"no-such-{name}"
        for name, value in vars(profile.tools).items()
        if isinstance(value, str) and name != "capture_right"
    }
    tools = profile.tools.model_copy(update=names)
    assert profile.ros is not None
    command = profile.ros.command.model_copy(update={"record": ("no-such-recorder", *profile.ros.command.record[1:])})
    variants = dict.fromkeys(profile.ros.variants, command)
    return profile.model_copy(update={"tools": tools, "ros": profile.ros.model_copy(update={"variants": variants})})


def change(monkeypatch: pytest.MonkeyPatch, name: str, changed: Callable[[Job], Job]) -> None:
    """Replace the job of this name on the robots."""
    real = jobs.command
    monkeypatch.setattr(jobs, "command", lambda verb, job: real(verb, changed(job) if job.name == name else job))


KILLED_ELSEWHERE = ("fly",)
"""CI kills the pilot and the guard of a drone in `tests/motion/steps/test_step_fly_ends.py`."""


@pytest.mark.parametrize("kind", mark_nightly(KINDS, in_ci=[kind for kind in KINDS if kind not in KILLED_ELSEWHERE]))
def test_killed_tool_makes_attempt_void(kind: str, bench: Bench) -> None:
    for planned in own_jobs(kind, bench.plan(kind))[:1]:
        with pytest.MonkeyPatch.context() as monkeypatch:
            kill_tool(kind, planned.role, planned.job.name, bench, monkeypatch)


@pytest.mark.nightly
@pytest.mark.parametrize("kind", KINDS)
def test_killed_later_tool_makes_attempt_void(kind: str, bench: Bench) -> None:
    for planned in own_jobs(kind, bench.plan(kind))[1:]:
        with pytest.MonkeyPatch.context() as monkeypatch:
            kill_tool(kind, planned.role, planned.job.name, bench, monkeypatch)


def kill_tool(kind: str, role: Role, name: str, bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    """Run a trial in which the program of a job is killed."""
    plan = bench.plan(kind)
    if name in EXAMPLES[kind].brief:
        slow = ("sh", "-c", 'sleep 1; exec "$@"', "sh")
        change(monkeypatch, name, lambda original: replace(original, argv=(*slow, *original.argv)))
    folder = jobs.work_folder(plan.trial, f"{next(plan.repeats_in_order())}-1")
    shell = bench.testbed.shells[role]
    argv = ("sh", "-c", KILL, "sh", f"{folder}/.jobs/{name}")
    session = shell.begin(argv, deadline=Deadline.after(30))
    status, reason, _ = bench.run(plan)
    session.end(deadline=Deadline.after(30))
    assert status == "failed", name
    assert reason
    assert not bench.running_jobs()


@pytest.mark.parametrize("kind", mark_nightly(KINDS, in_ci=("capture", "together")))
def test_interrupted_trial_is_resumed(kind: str, bench: Bench) -> None:
    plan, started = bench.plan(kind), threading.Event()

    def interrupt(event: Event) -> None:
        if isinstance(event, PhaseStarted) and event.repeat and not started.is_set():
            started.set()
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        bench.run(plan, interrupt)
    assert started.is_set()
    assert not bench.running_jobs()
    assert bench.resume(plan)[:2] == ("valid", "")


@pytest.mark.parametrize("kind", mark_nightly(KINDS, in_ci=("capture", "fly", "ping", "record", "transfer")))
def test_hanging_tool_is_stopped_at_its_limit(kind: str, bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    plan = bench.plan(kind)
    if not (kind_jobs := own_jobs(kind, plan)):
        return  # this kind starts no program
    hanging = kind_jobs[0].job.name
    # A program that hangs is never ready.
    change(monkeypatch, hanging, lambda original: replace(original, argv=("sleep", "600"), limit_s=1.0, ready_s=2))
    status, reason, _ = bench.run(plan)
    if hanging not in EXAMPLES[kind].outlives:
        assert (status, bool(reason)) == ("failed", True)
    assert not bench.running_jobs()
