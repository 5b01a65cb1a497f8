"""Cause a fault of a robot, and measure the time for which the robot does not answer."""

import time
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import replace
from pathlib import PurePath
from typing import TYPE_CHECKING, Annotated, ClassVar, Final

from typing_extensions import override

from fieldkit.backends.protocols import Testbed
from fieldkit.config import schema
from fieldkit.config.profiles import LinkName
from fieldkit.config.schema import Duration, Field
from fieldkit.core import model
from fieldkit.core.columns import Column, Measured, Value, fault_column_name
from fieldkit.core.crosschecks import CrossCheck
from fieldkit.core.deadline import Deadline
from fieldkit.core.errors import EvidenceError, FieldkitError, LinkError, RobotError
from fieldkit.core.model import FaultKind, Protocol, Role
from fieldkit.core.threads import is_bug, run_parallel
from fieldkit.measure.attempt import AttemptEvidence
from fieldkit.measure.evidence import outage, outage_columns
from fieldkit.measure.robot_clock import Offset, offset
from fieldkit.measure.transfers import recoveries
from fieldkit.measure.transfers.recoveries import FaultTimes
from fieldkit.remote import jobs
from fieldkit.steps import across, clocks
from fieldkit.steps.base import StepEntry
from fieldkit.steps.capabilities import AsksOperator, DescribesActions, Restarts, Summarizes
from fieldkit.steps.kinds.observer import RECOVERED_S, Observer, observer_role
from fieldkit.steps.nest import Nest, end_inside
from fieldkit.steps.scene import Announce, Planned, Scene
from fieldkit.steps.view import View

if TYPE_CHECKING:
    from concurrent.futures import Future

PATIENCE_S: Final = 600.0
"""Time allowed for the operator to cause a fault."""

_CLOCK_TIMEOUT_S: Final = 5.0
"""Timeout of a time query."""

_START_S: Final = 0.3
"""Approximate time in which the observer starts and stops."""

_KINDS_WITH_DURATION: Final = frozenset({FaultKind.LINK_DOWN, FaultKind.OUT_OF_RANGE})


class FaultStep(Nest, DescribesActions, Restarts, AsksOperator, Summarizes):
    """Causes a fault of a robot while the steps in `during` run. Losses in these steps are a result, not an error.

    The backend of simulated robots causes the fault. In the field the operator is asked to cause it; with `--yes` no
    operator is asked, and the attempts are void.

    - `link-down`: the interface of the radio, or of `link`, is down for the time `for`, then up again.
    - `out-of-range`: no other robot receives packets of the robot for the time `for`. If the robot is the relay, no
      robot receives packets of another robot.
    - `reboot`: every process ends at the same moment, data in memory is lost, and the robot boots.
    - `kill`: every process named `process` ends at the same moment.

    An observer records when the robot answers. It starts before the fault, and ends when the robot has answered again
    for a second. It sends a ping every 100 ms (200 ms if an old iputils requires it) from the sender, or from the
    receiver if the sender has the fault; for `kill` it polls the robot's processes. Writes `fault-KIND-ping.txt` or
    `fault-kill-watch.txt`, `fault-KIND.txt` (duration of the fault, and interval of the pings or polls), and
    `fault-KIND-times.txt` (start and end of the fault, see [recovery](method-delay.md#recovery)).

    Attributes:
        robot: Role of the robot with the fault.
        kind: `link-down`, `out-of-range`, `reboot` or `kill`.
        lasts: Duration; required by `link-down` and `out-of-range`, not allowed for the others.
        process: Name of the process, as `ps -e -o comm` shows it, up to 15 letters; required by `kill`, not allowed
            for the others.
        link: Link that is down, by its name in [the profile](links.md); only for `link-down`. Without it, the radio
            under test.
        after: Time for which the steps inside run before the fault.
        limit: Maximum time between the end of the fault and the recovery of the robot.
        during: Steps during which the fault occurs.
    """

    columns = outage_columns.COLUMNS
    cross_checks = (
        CrossCheck(
            quantity="outage and recovery",
            columns=("*_outage_s", "*_recovery_s", "*_recovery_at_least_s", "*_recovered"),
            source="`fault-KIND-ping.txt`, `fault-KIND-watch.txt`",
            against=("`fault-KIND.txt`: duration of the cause", "termination of the observer's job"),
            tolerance="durations may differ by two ping intervals of the observer",
        ),
        *recoveries.CROSS_CHECKS,
    )
    disturbs: ClassVar[bool] = True

    robot: Role
    kind: FaultKind
    lasts: Annotated[Duration, Field(gt=0)] | None = Field(default=None, alias="for")
    process: (
        Annotated[
            str, schema.pattern_field(r"^[A-Za-z0-9._-]{1,15}$", "the name of a process, as ps -e -o comm shows it")
        ]
        | None
    ) = None
    link: LinkName = Field(default="", exclude_if=schema.is_empty)
    after: Duration = 1.0
    limit: Annotated[Duration, Field(gt=0)] = 60.0
    during: tuple[StepEntry, ...] = ()

    @schema.model_validator(mode="after")
    def _has_the_keys_of_its_kind(self) -> "FaultStep":
        for key, is_given, is_required in (
            ("for", self.lasts is not None, self.kind in _KINDS_WITH_DURATION),
            ("process", self.process is not None, self.kind is FaultKind.KILL),
        ):
            if is_given != is_required:
                verb = "needs" if is_required else "does not allow"
                raise schema.validation_error(f"a fault of the kind {self.kind} {verb} the key {key}:")
        if self.link and self.kind is not FaultKind.LINK_DOWN:
            raise schema.validation_error(f"a fault of the kind {self.kind} does not allow the key link:", "link")
        return self

    @property
    def cause(self) -> model.Fault:
        """The fault in the form for the testbed."""
        return model.Fault(self.kind, self.robot, self.lasts or 0.0, self.process or "", self.link)

    @override
    def jobs(self, scene: Scene) -> Iterator[Planned]:
        yield self._watch(scene)
        yield from self.inside(scene)
        yield self._observer(scene).await_recovery("SECONDS", self.limit)

    @override
    def dry_run_notes(self, scene: Scene) -> Iterator[str]:
        duration_text = f" for {self.lasts:g} s" if self.lasts else ""
        process_text = f" of the process {self.process}" if self.process else ""
        link_text = f" of link {self.link}" if self.link else ""
        target = f"{process_text}{link_text} of {scene.robot(self.robot).name}"
        yield f"{self.kind}{target}{duration_text}, after {self.after:g} s"

    def _observer(self, scene: Scene) -> Observer:
        return Observer(scene, self.cause, self.prefix)

    def _watch(self, scene: Scene) -> Planned:
        return self._observer(scene).watch(self.after + (self.lasts or 0.0) + PATIENCE_S + self.limit)

    @override
    def run(self, scene: Scene, testbed: Testbed, announce: Announce) -> None:
        """Cause the fault in this thread, in which the operator can be prompted; the steps inside run in another."""
        from concurrent.futures import ThreadPoolExecutor, wait  # noqa: PLC0415 (it imports logging, which takes 5 ms)

        watch, observer = self._watch(scene), self._observer(scene)
        shell = testbed.shells[observer.role]
        announce(f"watch {scene.robot(self.robot).name}", None)
        jobs.start(shell, watch.job)
        clock_offsets = {} if scene.laptop_folder is None else self._query_clock_offsets(testbed)
        inner_scene = replace(scene, halt=scene.halt.child())
        pool = ThreadPoolExecutor(max_workers=1)
        steps = pool.submit(self._run_inside, inner_scene, testbed, announce)
        try:
            self._wait_until_fault(steps)
            announce(f"{self.kind} of {scene.robot(self.robot).name}", self.lasts)
            request_ns = time.time_ns()
            duration_s = testbed.inject(self.cause)
            self._record_times(scene, request_ns, duration_s, clock_offsets)
            announce("recovery", None)
            recovery = observer.await_recovery("unknown" if duration_s is None else f"{duration_s:.3f}", self.limit)
            jobs.run(shell, recovery.job)  # `measure` evaluates whether the robot recovered
            jobs.stop(shell, watch.job)
            self._wait_for_steps(steps, scene, testbed)
        except Exception as error:
            inner_scene.halt.set()
            with suppress(FieldkitError):
                end_inside(self, scene, testbed)
            wait([steps])
            inner_error = steps.exception()
            if inner_error is not None and inner_error is not error and is_bug(inner_error):
                raise inner_error from error
            raise
        finally:
            inner_scene.halt.set()
            pool.shutdown(wait=False)  # after Ctrl-C the signal handler stops the jobs for which the steps wait

    def _query_clock_offsets(self, testbed: Testbed) -> dict[Role, Offset]:
        """Return the offset of each robot's clock.

        A robot that does not answer is omitted; its columns on the recovery of flows are then empty.
        """

        def query(role: Role) -> Offset | None:
            with suppress(LinkError):
                if exchanges := clocks.exchanges(testbed.shells[role], _CLOCK_TIMEOUT_S):
                    return offset(exchanges)
            return None

        roles = list(testbed.shells)
        return {
            role: clock_offset
            for role, clock_offset in zip(roles, run_parallel(query, roles), strict=True)
            if clock_offset is not None
        }

    def _record_times(
        self, scene: Scene, request_ns: int, duration_s: float | None, clock_offsets: Mapping[Role, Offset]
    ) -> None:
        """Record the times of the fault by the laptop's clock; called when the fault itself has ended."""
        if scene.laptop_folder is None:
            return
        now_ns = time.time_ns()
        # A fault with a known duration above 0 started `duration_s` ago. Another one started at the request.
        start_ns = now_ns - round(1e9 * duration_s) if duration_s else request_ns
        times = FaultTimes(start_ns, None if duration_s is None else now_ns, clock_offsets)
        path = scene.laptop_folder / self.prefixed_name(recoveries.fault_times_file(self.kind))
        path.write_text(recoveries.fault_times_text(times), encoding="ascii")

    def times(self, evidence: AttemptEvidence) -> FaultTimes | None:
        """Return the recorded times of the fault; see `CausesFault.times`."""
        return evidence.read_or_none(
            recoveries.read_fault_times, self.prefixed_name(recoveries.fault_times_file(self.kind))
        )

    def _run_inside(self, scene: Scene, testbed: Testbed, announce: Announce) -> None:
        for entry in self.during:
            if not scene.halt.is_set:
                entry.step.run(scene, testbed, announce)

    def _wait_until_fault(self, steps: "Future[None]") -> None:
        """Wait until it is time for the fault.

        If a step inside fails before that time, its error is raised, because the fault is not the cause.
        """
        from concurrent.futures import wait  # noqa: PLC0415 (as above)

        deadline = Deadline.after(self.after)
        if wait([steps], timeout=self.after).done:
            steps.result()
            time.sleep(deadline.remaining_s)

    def _wait_for_steps(self, steps: "Future[None]", scene: Scene, testbed: Testbed) -> None:
        """Wait for the steps inside; if they failed because of the fault, stop their jobs."""
        try:
            steps.result()
        except (RobotError, LinkError) as error:
            if error.ends_trial:
                raise
            end_inside(self, scene, testbed)

    @override
    def roles(self) -> frozenset[Role]:
        return frozenset({self.robot, observer_role(self.cause)}) | self.roles_inside()

    @override
    def may_prompt(self) -> bool:
        return True

    @override
    def restarts(self) -> frozenset[Role]:
        return frozenset({self.robot}) if self.kind is FaultKind.REBOOT else frozenset()

    @override
    def exclusive_resources(self) -> tuple[str, ...]:
        return (f"a fault {self.kind}",)

    @override
    def files(self) -> tuple[str, ...]:
        names = (outage.note_file, outage.observed_file, outage.log_file)
        return tuple(self.prefixed_name(name(self.kind)) for name in names)

    @override
    def check(self, view: View) -> Iterator[str]:
        """Yield a reason if the observer's files are incomplete or do not show the fault."""
        try:
            view.evidence.read(outage.read, "", self.kind, self.prefix)  # "": the folder of the attempt
        except EvidenceError as error:
            yield f"{PurePath(error.where).name}: {error.what}"

    @override
    def output_columns(self) -> tuple[Column, ...]:
        """Return the columns of this kind of fault, and of the recoveries of the flows inside."""
        return (*outage_columns.fault_columns(self.kind), *across.recovery_columns(self))

    @override
    def measure(self, view: View) -> Measured:
        outage_result = view.evidence.read_or_none(outage.read, "", self.kind, self.prefix)
        return outage.measure(self.kind, outage_result) | across.measure(self, view)

    @override
    def summary(self, values: Mapping[str, Value]) -> Iterator[str]:
        outage_s, has_recovered = (
            values.get(fault_column_name(self.kind, name)) for name in ("outage_s", "recovered")
        )
        if has_recovered is not None:
            result = f"no answer for {outage_s:.1f} s" if isinstance(outage_s, float) else "did not recover"
            yield f"{self.kind}: {result}"

    @override
    def expected_s(self, protocol: Protocol) -> float:
        return max(self.after + (self.lasts or 0.0) + RECOVERED_S, self.inside_s(protocol)) + _START_S
