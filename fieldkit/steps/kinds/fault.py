"""Do something to a robot on purpose, and watch from outside how long it is gone."""

import time
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import replace
from pathlib import PurePath
from typing import TYPE_CHECKING, Annotated, ClassVar, Final

from fieldkit.backends.protocols import Testbed
from fieldkit.config import schema
from fieldkit.config.schema import Duration, Field
from fieldkit.core import model
from fieldkit.core.columns import Column, Measured, Value, of_fault
from fieldkit.core.deadline import Deadline
from fieldkit.core.errors import EvidenceError, FieldkitError, LinkError, RobotError
from fieldkit.core.model import FaultKind, Protocol, Role
from fieldkit.measure.evidence import recovery
from fieldkit.remote import jobs
from fieldkit.steps.base import Nest, StepEntry, View
from fieldkit.steps.kinds.observer import HEALED_S, Observer, observed_from
from fieldkit.steps.scene import Announce, Planned, Scene

if TYPE_CHECKING:
    from concurrent.futures import Future

# How long an operator may take for what a fault asks of him.
PATIENCE_S: Final = 600.0

_LASTING: Final = frozenset({FaultKind.LINK_DOWN, FaultKind.OUT_OF_RANGE})


class FaultStep(Nest):
    """A fault while other steps run, seen by pings from the other robot; a process that is killed, by a watch of it.

    Steps inside may fail once the fault has begun: they are what is tested.

    Attributes:
        robot: Whom it befalls.
        kind: What.
        lasts: How long (`for`), for `link-down` and `out-of-range`; the others last as long as they do.
        process: Name of the process, for `kill`.
        after: How long the steps inside run before it.
        limit: How long it may take to heal, from when the cause is over.
        during: The steps inside.
    """

    columns = recovery.COLUMNS
    disturbs: ClassVar[bool] = True

    robot: Role
    kind: FaultKind
    lasts: Annotated[Duration, Field(gt=0)] | None = Field(default=None, alias="for")
    process: (
        Annotated[str, schema.shaped(r"^[A-Za-z0-9._-]{1,15}$", "the name of a process, as ps -e -o comm shows it")]
        | None
    ) = None
    after: Duration = 1.0
    limit: Annotated[Duration, Field(gt=0)] = 60.0
    during: tuple[StepEntry, ...] = ()

    @schema.model_validator(mode="after")
    def _fits_its_kind(self) -> "FaultStep":
        for key, given, wanted in (
            ("for", self.lasts is not None, self.kind in _LASTING),
            ("process", self.process is not None, self.kind is FaultKind.KILL),
        ):
            if given != wanted:
                raise schema.complaint(f"a {self.kind} {'needs' if wanted else 'takes no'} {key}:")
        return self

    @property
    def cause(self) -> model.Fault:
        """The fault that the testbed is asked for."""
        return model.Fault(self.kind, self.robot, self.lasts or 0.0, self.process or "")

    def commands(self, scene: Scene) -> Iterator[Planned]:
        """See `Step.commands`."""
        yield self._watch(scene)
        yield from self.inside(scene)
        yield self._observer(scene).heals("SECONDS", self.limit)

    def beside(self, scene: Scene) -> Iterator[str]:
        """See `Step.beside`."""
        lasts = f" for {self.lasts:g} s" if self.lasts else ""
        what = f" of the process {self.process}" if self.process else ""
        yield f"{self.kind}{what} of {scene.robot(self.robot).name}{lasts}, after {self.after:g} s"
        yield from super().beside(scene)

    def _observer(self, scene: Scene) -> Observer:
        return Observer(scene, self.cause, self.prefix)

    def _watch(self, scene: Scene) -> Planned:
        return self._observer(scene).watch(self.after + (self.lasts or 0.0) + PATIENCE_S + self.limit)

    def run(self, scene: Scene, testbed: Testbed, announce: Announce) -> None:
        """See `Step.run`; the testbed acts in this thread, where a person can be asked."""
        from concurrent.futures import ThreadPoolExecutor, wait  # noqa: PLC0415 (with logging, 5 ms)

        watch, observer = self._watch(scene), self._observer(scene)
        shell = testbed.shells[observer.role]
        announce(f"watch {scene.robot(self.robot).name}", None)
        jobs.start(shell, watch.job)
        inner = replace(scene, halt=scene.halt.inside())
        pool = ThreadPoolExecutor(max_workers=1)
        steps = pool.submit(self._steps, inner, testbed, announce)
        try:
            self._lead_in(steps)
            announce(f"{self.kind} of {scene.robot(self.robot).name}", self.lasts)
            lasted_s = testbed.inject(self.cause)
            announce("recovery", None)
            heals = observer.heals("unknown" if lasted_s is None else f"{lasted_s:.3f}", self.limit)
            jobs.run(shell, heals.job)  # whether it healed is for the measures to say
            jobs.stop(shell, watch.job)
            self._outlast(steps, scene, testbed)
        except Exception:
            inner.halt.call()
            with suppress(FieldkitError):
                self.end_inside(scene, testbed)
            wait([steps])
            raise
        finally:
            inner.halt.call()
            pool.shutdown(wait=False)  # after Ctrl-C: whoever catches it ends what the steps wait for

    def _steps(self, scene: Scene, testbed: Testbed, announce: Announce) -> None:
        for entry in self.during:
            if not scene.halt.called:
                entry.step.run(scene, testbed, announce)

    def _lead_in(self, steps: "Future[None]") -> None:
        """Let the steps inside run undisturbed; what they raise now is no work of the fault."""
        from concurrent.futures import wait  # noqa: PLC0415 (as above)

        until = Deadline.after(self.after)
        if wait([steps], timeout=self.after).done:
            steps.result()
            time.sleep(until.remaining_s)

    def _outlast(self, steps: "Future[None]", scene: Scene, testbed: Testbed) -> None:
        """Wait for the steps inside; where the fault made them fail, end what they left running."""
        try:
            steps.result()
        except (RobotError, LinkError) as error:
            if error.ends_trial:
                raise
            self.end_inside(scene, testbed)

    def roles(self) -> frozenset[Role]:
        """See `Step.roles`."""
        return frozenset({self.robot, observed_from(self.cause)}) | self.roles_inside()

    def asks(self) -> bool:
        """See `Step.asks`."""
        return True

    def restarts(self) -> frozenset[Role]:
        """See `Step.restarts`."""
        return frozenset({self.robot}) if self.kind is FaultKind.REBOOT else frozenset()

    def claims(self) -> tuple[str, ...]:
        """See `Step.claims`."""
        return (f"a fault {self.kind}",)

    def files(self) -> tuple[str, ...]:
        """See `Step.files`."""
        of_kind = (recovery.note_file(self.kind), recovery.observed_file(self.kind), recovery.log_file(self.kind))
        return tuple(map(self.own_name, of_kind))

    def problems(self, view: View) -> Iterator[str]:
        """See `Step.problems`: the observer's files are whole, and the fault left a mark in them."""
        try:
            view.evidence.read(recovery.read, "", self.kind, self.prefix)
        except EvidenceError as error:
            yield f"{PurePath(error.where).name}: {error.what}"

    def declared(self) -> tuple[Column, ...]:
        """See `Step.declared`; columns of other kinds of fault are for their steps to fill."""
        return recovery.declared(self.kind)

    def measure(self, view: View) -> Measured:
        """See `Step.measure`."""
        return recovery.measure(self.kind, view.evidence.known(recovery.read, "", self.kind, self.prefix))

    def in_words(self, values: Mapping[str, Value]) -> Iterator[str]:
        """See `Step.in_words`."""
        outage_s, recovered = (values.get(of_fault(self.kind, what)) for what in ("outage_s", "recovered"))
        if recovered is not None:
            gone = f"gone for {outage_s:.1f} s" if isinstance(outage_s, float) else "did not come back"
            yield f"{self.kind}: {gone}"

    def expected_s(self, protocol: Protocol) -> float:
        """See `Step.expected_s`."""
        return max(self.after + (self.lasts or 0.0) + HEALED_S, self.inside_s(protocol)) + 0.3
