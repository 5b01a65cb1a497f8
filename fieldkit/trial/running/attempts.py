"""One attempt at a repeat: run its steps, fetch and judge its evidence, and store it, even if it is interrupted."""

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
from fieldkit.core.events import Note, PhaseStarted, Sink
from fieldkit.core.model import RepeatId, Role, Status
from fieldkit.measure.attempt import AttemptEvidence
from fieldkit.measure.robot_state import exchanges
from fieldkit.steps.motions import STOPPED, Motions
from fieldkit.steps.variants import Variants
from fieldkit.trial import gates, hosts, size, step_errors, store
from fieldkit.trial.gates import EvidenceVerdict
from fieldkit.trial.journal import Attempt
from fieldkit.trial.plan import Plan
from fieldkit.trial.running.ledger import Ledger
from fieldkit.trial.running.robots import Robots
from fieldkit.trial.step_errors import StepError


class Attempts:
    """Makes the attempts of a trial in sequence.

    Args:
        plan: The trial.
        folder: Its folder.
        robots: Its robots.
        ledger: Records the result of each attempt.
        variants: The tools of each robot.
        sink: Receives the start of each phase.
        motions: The robots that move without a person.
        origins: See `Scene.origins`.
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
        origins: object,
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
        """Make another attempt at a repeat, and store it whatever its result is.

        Returns:
            The remedy of a failed step; empty if none failed.

        Raises:
            ConfigurationError: This machine has no space for its evidence.
            FieldkitError: The trial cannot continue; the attempt is stored as one that does not count.
            KeyboardInterrupt: As for `FieldkitError`, but `recover` completes an attempt whose steps have ended.
            OSError: The disk is full or was removed.
        """
        self._robots.check_alive()
        store.require_space(self._folder, size.attempt_bytes(self._plan))
        started = self._ledger.begin(repeat)
        partial = store.open_attempt(self._folder, repeat)
        remote = started.remote(self._plan.trial)
        self._reached = None
        with self._storing_interrupted(started, partial):
            times_ns = self._robots.begin(remote, old=self._last_remote or None)
            (partial / exchanges.FILE).write_text(exchanges.text(times_ns), encoding="ascii")
            failure = self._measure(started, remote, partial)
            reasons = [failure.located] if failure else []
            if reasons:
                self._robots.check_alive()  # fails immediately if a process that the robots need has exited
            else:
                self._ledger.record_measured(started)
                self._reached = Status.MEASURED
            self._sink(PhaseStarted("collect evidence", str(repeat)))
            reasons += self._robots.fetch(remote, partial, ended_normally=not reasons)
            verdict = self._judge(started, partial)
            for note in verdict.notes:
                self._sink(Note(f"{repeat}: {note}"))
            raised = [failure.traceback_text] if isinstance(failure, StepError) else []
            step_errors.store([*raised, *verdict.step_errors], partial)
            has_failed = bool(raised) or (not reasons and verdict.has_failed)
            notes = [step_errors.SEE_LOG] if raised or (not reasons and verdict.step_errors) else []
            reasons = reasons or list(verdict.problems)
            self._last_remote = remote
            if reasons:
                self._robots.check_alive()
                self._robots.require_locks()  # an attempt aborted by another user is not counted
        invalid = Status.FAILED if has_failed or self._ledger.is_last(repeat) else Status.VOID
        reasons = [*hosts.drop_effects_of_reboots(reasons), *notes]
        ended = replace(started, status=invalid if reasons else Status.VALID, reason="; ".join(reasons))
        self._ledger.commit(partial, ended, verdict.measured)
        if has_failed:
            log = step_errors.log_file(store.attempt_folder(self._folder, ended.folder))
            return f"{step_errors.REPORT}, with {log}"
        return failure.remedy if failure else ""

    def recover(self, interrupted_attempt: Attempt) -> None:
        """Complete an attempt during which fieldkit was killed; errors as for `make`."""
        self._sink(PhaseStarted("recover", str(interrupted_attempt.repeat)))
        remote, was_measured = (
            interrupted_attempt.remote(self._plan.trial),
            interrupted_attempt.status is Status.MEASURED,
        )
        committed = store.unjournalled_attempt(self._folder, interrupted_attempt.folders)
        evidence_folder = committed or store.reopen_attempt(self._folder, interrupted_attempt.repeat)
        # Partial evidence of an interrupted attempt is stored like the evidence of any void attempt.
        missing = [] if committed else self._robots.fetch(remote, evidence_folder, ended_normally=was_measured)
        verdict = self._judge(interrupted_attempt, evidence_folder)
        if not committed:
            step_errors.store(verdict.step_errors, evidence_folder)
        if was_measured and missing:
            reasons = ["fieldkit was killed before it had the evidence, which could not be fetched later", *missing]
        else:
            reasons = list(verdict.problems) if was_measured else ["fieldkit was killed during it"]
            reasons += [step_errors.SEE_LOG] if was_measured and verdict.step_errors else []
        has_failed = was_measured and not missing and verdict.has_failed
        status = Status.FAILED if has_failed else Status.VOID if reasons else Status.VALID
        is_excused = bool(reasons) and not has_failed
        ended = replace(interrupted_attempt, status=status, reason="; ".join(reasons), excused=is_excused)
        self._ledger.commit(evidence_folder, ended, verdict.measured)
        self._last_remote = remote

    def _measure(self, started: Attempt, remote: str, laptop_folder: Path) -> FieldkitError | None:
        """Run the steps of an attempt; return the error that makes it void, or None."""
        repeat = started.repeat
        self._reached = Status.RUNNING
        planned = self._plan.scene(repeat, remote, self._variants)
        scene = replace(planned, laptop_folder=laptop_folder, motions=self._motions, origins=self._origins)

        def announce(name: str, expected_s: float | None) -> None:
            self._sink(PhaseStarted(name, str(repeat), expected_s))

        try:
            self._robots.measure(scene, announce)
            self._motions.stop_notes = ()  # a request to stop does not prevent the remaining work
        except (RobotError, LinkError, EvidenceError) as error:
            if error.ends_trial:
                raise
            return error
        return None

    @contextmanager
    def _storing_interrupted(self, started: Attempt, partial: Path) -> Iterator[None]:
        """If the body is interrupted, end its jobs and store the attempt as one that does not count.

        Its measurements stay on the robots, and its reason states this: after a request to stop, nothing is fetched.
        """
        try:
            yield
        except BaseException as error:
            if not isinstance(error, Exception) or isinstance(error, TestbedLostError):
                self._robots.close_connections()  # unblocks threads that wait for an answer
            with suppress(FieldkitError):  # a robot that cannot be reached ends its jobs at their time limits
                self._robots.end_jobs(started.remote(self._plan.trial))
            if isinstance(error, OSError):
                raise  # nothing more can be written; resume continues from the started attempt
            is_fetched_later = self._reached is Status.MEASURED and not self._robots.is_transient
            if is_fetched_later and isinstance(error, KeyboardInterrupt):
                raise  # the attempt is intact: resume fetches the rest of it
            reason = STOPPED if self._motions.is_ordered else _interruption_reason(error)
            if self._reached:
                self._robots.unfetched.mark_all(started.remote(self._plan.trial), partial, reason)
            ended = replace(started, status=Status.VOID, reason=reason, excused=True)
            self._ledger.commit(partial, ended, self._judge(started, partial).measured)
            if isinstance(error, LockLostError) and self._last_remote:
                with suppress(FieldkitError):  # an aborted trial may never be resumed
                    self._robots.delete_remote(self._last_remote)
            raise

    def _judge(self, attempt: Attempt, folder: Path) -> EvidenceVerdict:
        try:
            return gates.judge(self._plan, attempt.repeat, AttemptEvidence(folder))
        except MemoryError:
            return EvidenceVerdict(("this machine has too little memory to measure it",), Measured({}, {}))


def _interruption_reason(error: BaseException) -> str:
    """Return the reason why an attempt was interrupted."""
    match error:
        case FieldkitError():
            return error.located
        case Exception():  # most likely raised by a step kind of another package
            return f"{type(error).__name__}: {error}"
        case _:
            return "interrupted"
