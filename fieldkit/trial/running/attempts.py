"""Make attempts at a repeat: run the steps, fetch and check the evidence, and store the attempt.

An interrupted attempt is stored as well.
"""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path

from fieldkit.core.columns import Measured
from fieldkit.core.errors import EvidenceError, FieldkitError, LinkError, LockLostError, RobotError, TestbedLostError
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
    """Makes the attempts of a trial, one after the other.

    Args:
        plan: The trial.
        folder: Folder of the trial.
        robots: Robots of the trial.
        ledger: Records the result of each attempt.
        variants: Variants of the tools of each robot.
        sink: Receives the start of each phase.
        motions: The robots that move automatically.
        origins: Origins of the robots' motions; see `Scene.origins`.
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
        """Remote folder of the previous attempt, which is deleted when the next attempt begins."""
        self._progress: Status | None = None
        """State of the current attempt: None before its steps, then `running` and `measured`."""

    def make(self, repeat: RepeatId) -> str:
        """Make another attempt at a repeat, and store it with any result.

        Returns:
            The remedy of a failed step, or of an exception in the code of a step; empty if there is no such error.

        Raises:
            ConfigurationError: This machine has no space for the evidence.
            FieldkitError: The trial cannot continue. The attempt is stored, but does not count as one of the
                allowed attempts.
            KeyboardInterrupt: The user pressed Ctrl-C. The attempt is stored, but does not count as one of the
                allowed attempts. If its steps have ended on robots that remain, it is not stored, and `recover`
                completes it when the trial is resumed.
            OSError: The disk is full or was removed.
        """
        self._robots.check_alive()
        store.require_space(self._folder, size.attempt_bytes(self._plan))
        running_attempt = self._ledger.begin(repeat)
        partial_folder = store.open_attempt(self._folder, repeat)
        remote_folder = running_attempt.remote_folder(self._plan.trial)
        self._progress = None
        with self._storing_interrupted(running_attempt, partial_folder):
            times_ns = self._robots.begin(remote_folder, old=self._last_remote or None)
            (partial_folder / exchanges.FILE).write_text(exchanges.text(times_ns), encoding="ascii")
            failure = self._run_steps(running_attempt, remote_folder, partial_folder)
            reasons = [failure.located] if failure else []
            if reasons:
                self._robots.check_alive()  # raises if a process that the robots need has exited
            else:
                self._ledger.record_measured(running_attempt)
                self._progress = Status.MEASURED
            self._sink(PhaseStarted("collect evidence", str(repeat)))
            reasons += self._robots.fetch(remote_folder, partial_folder, ended_normally=not reasons)
            verdict = self._judge(running_attempt, partial_folder)
            for note in verdict.notes:
                self._sink(Note(f"{repeat}: {note}"))
            tracebacks = [failure.traceback_text] if isinstance(failure, StepError) else []
            step_errors.store([*tracebacks, *verdict.step_errors], partial_folder)
            has_failed = bool(tracebacks) or (not reasons and verdict.has_failed)
            notes = [step_errors.SEE_LOG] if tracebacks or (not reasons and verdict.step_errors) else []
            reasons = reasons or list(verdict.problems)
            self._last_remote = remote_folder
            if reasons:
                self._robots.check_alive()
                self._robots.require_locks()  # an attempt that another user aborted does not use an allowed attempt
        status = Status.FAILED if has_failed or self._ledger.is_last(repeat) else Status.VOID
        reasons = [*hosts.drop_effects_of_reboots(reasons), *notes]
        ended_attempt = replace(
            running_attempt, status=status if reasons else Status.VALID, reason="; ".join(reasons)
        )
        self._ledger.commit(partial_folder, ended_attempt, verdict.measured)
        if has_failed:
            log = step_errors.log_file(store.attempt_folder(self._folder, ended_attempt.folder))
            return f"{step_errors.REPORT}, with {log}"
        return failure.remedy if failure else ""

    def recover(self, interrupted_attempt: Attempt) -> None:
        """Complete an attempt during which fieldkit was killed. Raises the same errors as `make`."""
        self._sink(PhaseStarted("recover", str(interrupted_attempt.repeat)))
        remote_folder, was_measured = (
            interrupted_attempt.remote_folder(self._plan.trial),
            interrupted_attempt.status is Status.MEASURED,
        )
        committed_folder = store.find_committed_attempt(self._folder, interrupted_attempt.folders)
        evidence_folder = committed_folder or store.reopen_attempt(self._folder, interrupted_attempt.repeat)
        # Partial evidence of an interrupted attempt is stored like the evidence of any void attempt.
        fetch_problems = (
            []
            if committed_folder
            else self._robots.fetch(remote_folder, evidence_folder, ended_normally=was_measured)
        )
        verdict = self._judge(interrupted_attempt, evidence_folder)
        if not committed_folder:
            step_errors.store(verdict.step_errors, evidence_folder)
        if was_measured and fetch_problems:
            reason = "fieldkit was killed before it had fetched the evidence, which could not be fetched later"
            reasons = [reason, *fetch_problems]
        else:
            reasons = list(verdict.problems) if was_measured else ["fieldkit was killed during the attempt"]
            reasons += [step_errors.SEE_LOG] if was_measured and verdict.step_errors else []
        has_failed = was_measured and not fetch_problems and verdict.has_failed
        status = Status.FAILED if has_failed else Status.VOID if reasons else Status.VALID
        is_excused = bool(reasons) and not has_failed
        ended_attempt = replace(interrupted_attempt, status=status, reason="; ".join(reasons), excused=is_excused)
        self._ledger.commit(evidence_folder, ended_attempt, verdict.measured)
        self._last_remote = remote_folder

    def _run_steps(self, running_attempt: Attempt, remote_folder: str, laptop_folder: Path) -> FieldkitError | None:
        """Run the steps of an attempt. Return the error that makes the attempt void, or None."""
        repeat = running_attempt.repeat
        self._progress = Status.RUNNING
        planned = self._plan.scene(repeat, remote_folder, self._variants)
        scene = replace(planned, laptop_folder=laptop_folder, motions=self._motions, origins=self._origins)

        def announce(name: str, expected_s: float | None) -> None:
            self._sink(PhaseStarted(name, str(repeat), expected_s))

        try:
            self._robots.measure(scene, announce)
            self._motions.stop_notes = ()  # from now on, a request to stop waits for the end of the attempt
        except (RobotError, LinkError, EvidenceError) as error:
            if error.ends_trial:
                raise
            return error
        return None

    @contextmanager
    def _storing_interrupted(self, running_attempt: Attempt, partial_folder: Path) -> Iterator[None]:
        """If the body is interrupted, stop its jobs and store the attempt as void, without using an allowed attempt.

        Nothing more is fetched. The evidence stays on the robots, which `ROLE-unfetched.txt` records. The attempt is
        not stored if the disk fails, or if its steps had ended and `resume` can fetch the evidence.
        """
        try:
            yield
        except BaseException as error:
            if not isinstance(error, Exception) or isinstance(error, TestbedLostError):
                self._robots.close_connections()  # unblocks threads that wait for an answer
            with suppress(FieldkitError):  # on a robot that cannot be reached, jobs are stopped at their time limits
                self._robots.stop_jobs(running_attempt.remote_folder(self._plan.trial))
            if isinstance(error, OSError):
                raise  # nothing can be written; `resume` continues from the started attempt
            is_fetched_later = self._progress is Status.MEASURED and not self._robots.is_transient
            if is_fetched_later and isinstance(error, KeyboardInterrupt):
                raise  # the attempt is complete: `resume` fetches the evidence
            reason = STOPPED if self._motions.stop_ordered else _interruption_reason(error)
            if self._progress:
                self._robots.unfetched.mark_all(
                    running_attempt.remote_folder(self._plan.trial), partial_folder, reason
                )
            ended_attempt = replace(running_attempt, status=Status.VOID, reason=reason, excused=True)
            self._ledger.commit(partial_folder, ended_attempt, self._judge(running_attempt, partial_folder).measured)
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
        case Exception():  # probably raised by a step kind of another package
            return f"{type(error).__name__}: {error}"
        case _:
            return "interrupted"
