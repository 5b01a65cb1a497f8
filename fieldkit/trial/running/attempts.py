"""One attempt at a repeat: its steps run, its evidence fetched, judged and kept, whatever cuts it short."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path

from fieldkit.core.columns import Measured
from fieldkit.core.errors import (
    EvidenceError,
    FieldkitError,
    LinkError,
    LockLostError,
    RobotError,
    TestbedLostError,
)
from fieldkit.core.events import PhaseStarted, Sink
from fieldkit.core.model import RepeatId, Role, Status
from fieldkit.measure.attempt import AttemptEvidence
from fieldkit.steps.motions import STOPPED, Motions
from fieldkit.steps.origins import Origins
from fieldkit.steps.variants import Variants
from fieldkit.trial import gates, hosts, size, store
from fieldkit.trial.gates import Judged
from fieldkit.trial.journal import Attempt
from fieldkit.trial.plan import Plan
from fieldkit.trial.running.ledger import Ledger
from fieldkit.trial.running.robots import Robots


class Attempts:
    """Makes the attempts of a trial, one after the other.

    Args:
        plan: The trial.
        folder: Its folder.
        robots: Its robots.
        ledger: Told what becomes of each attempt.
        variants: The tools of each robot.
        sink: Told of each phase.
        motions: The robots that move by themselves.
        origins: Origins of the robots that move by themselves.
    """

    def __init__(
        self,
        plan: Plan,
        folder: Path,
        robots: Robots,
        ledger: Ledger,
        *,
        variants: Mapping[Role, Variants],
        sink: Sink,
        motions: Motions,
        origins: Origins,
    ) -> None:
        self._plan = plan
        self._folder = folder
        self._robots = robots
        self._ledger = ledger
        self._variants = variants
        self._sink = sink
        self._motions = motions
        self._origins = origins
        self._last_remote = ""
        self._reached: Status | None = None

    def make(self, repeat: RepeatId) -> str:
        """Make another attempt at a repeat and keep it, whatever it came to; return what to do where a step failed.

        Raises:
            ConfigurationError: This machine has no room for its evidence.
            FieldkitError: The trial cannot go on; the attempt is kept as one that does not count.
            KeyboardInterrupt: Likewise; one whose steps are done is left to `recover`.
            OSError: The disk is full or gone.
        """
        self._robots.demand_up()
        store.demand_space(self._folder, size.attempt_bytes(self._plan))
        begun = self._ledger.begin(repeat)
        partial = store.open_attempt(self._folder, repeat)
        remote = begun.remote(self._plan.trial)
        self._reached = None
        with self._cut_short(begun, partial):
            self._robots.begin(remote, old=self._last_remote or None)
            failure = self._measure(begun, remote, partial)
            reasons = [failure.located] if failure else []
            if reasons:
                self._robots.demand_up()  # nobody waits for robots that have ended
            else:
                self._ledger.measured(begun)
                self._reached = Status.MEASURED
            self._sink(PhaseStarted("collect evidence", str(repeat)))
            reasons += self._robots.fetch(remote, partial, clean=not reasons)
            judged = self._judged(begun, partial)
            reasons = reasons or list(judged.problems)
            self._last_remote = remote
            if reasons:
                self._robots.demand_up()
                self._robots.demand_held()  # whose jobs somebody else ended, it counts for none of those allowed
        bad = Status.FAILED if self._ledger.is_last(repeat) else Status.VOID
        why = "; ".join(hosts.without_effects(reasons))
        self._ledger.keep(
            partial, replace(begun, status=bad if reasons else Status.VALID, reason=why), judged.measured
        )
        return failure.remedy if failure else ""

    def recover(self, cut: Attempt) -> None:
        """Settle an attempt that fieldkit was killed in; errors as `make`."""
        self._sink(PhaseStarted("recover", str(cut.repeat)))
        remote, was_measured = cut.remote(self._plan.trial), cut.status is Status.MEASURED
        found = store.unjournalled_attempt(self._folder, cut.folders)
        evidence_folder = found or store.reopen_attempt(self._folder, cut.repeat)
        # Of an attempt that was cut in its midst what there is, is evidence as that of any void one.
        missing = [] if found else self._robots.fetch(remote, evidence_folder, clean=was_measured)
        judged = self._judged(cut, evidence_folder)
        if was_measured and missing:
            reasons = ["fieldkit was killed before it had the evidence, which was not to be had later", *missing]
        else:
            reasons = list(judged.problems) if was_measured else ["fieldkit was killed during it"]
        status = Status.VOID if reasons else Status.VALID
        ended = replace(cut, status=status, reason="; ".join(reasons), excused=bool(reasons))
        self._ledger.keep(evidence_folder, ended, judged.measured)
        self._last_remote = remote

    def _measure(self, begun: Attempt, remote: str, here: Path) -> FieldkitError | None:
        """Run the steps of an attempt; return why it is not whole."""
        repeat = begun.repeat
        self._reached = Status.RUNNING
        planned = self._plan.scene(repeat, remote, self._variants)
        scene = replace(planned, here=here, motions=self._motions, origins=self._origins)

        def announce(name: str, expected_s: float | None) -> None:
            self._sink(PhaseStarted(name, str(repeat), expected_s))

        try:
            self._robots.measure(scene, announce)
            self._motions.ahead = ()  # what is left to do may be finished
        except (RobotError, LinkError, EvidenceError) as error:
            if error.ends_trial:
                raise
            return error
        return None

    @contextmanager
    def _cut_short(self, begun: Attempt, partial: Path) -> Iterator[None]:
        """Whatever cuts the body short, end its jobs and keep the attempt as one that does not count.

        What it measured stays on the robots, and is told: nobody waits for it who wants to stop now.
        """
        try:
            yield
        except BaseException as error:
            if not isinstance(error, Exception) or isinstance(error, TestbedLostError):
                self._robots.hang_up()  # ends what other threads still wait for
            with suppress(FieldkitError):  # a robot that cannot be reached ends its jobs at their own limits
                self._robots.end_jobs(begun.remote(self._plan.trial))
            if isinstance(error, OSError):
                raise  # nothing more can be written; the journal says that it began, and resume goes on from there
            is_fetched_later = self._reached is Status.MEASURED and not self._robots.transient
            if is_fetched_later and isinstance(error, KeyboardInterrupt):
                raise  # nothing is wrong with it: resume fetches it, and what has come of it stays
            reason = STOPPED if self._motions.called else _why_cut(error)
            if self._reached:
                self._robots.leave(begun.remote(self._plan.trial), partial, reason)
            ended = replace(begun, status=Status.VOID, reason=reason, excused=True)
            self._ledger.keep(partial, ended, self._judged(begun, partial).measured)
            if isinstance(error, LockLostError) and self._last_remote:
                with suppress(FieldkitError):  # nobody may come back to a trial that was aborted
                    self._robots.discard(self._last_remote)
            raise

    def _judged(self, attempt: Attempt, folder: Path) -> Judged:
        try:
            return gates.judge(self._plan, attempt.repeat, AttemptEvidence(folder))
        except MemoryError:
            return Judged(("this machine has too little memory to measure it",), Measured({}, {}))


def _why_cut(error: BaseException) -> str:
    """Return in words what cut an attempt short."""
    match error:
        case FieldkitError():
            return error.located
        case Exception():  # of a kind of step, most likely, that is another package's
            return f"{type(error).__name__}: {error}"
        case _:
            return "interrupted"
