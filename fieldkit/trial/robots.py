"""The robots of a trial during one attempt: make the folders, run the steps, fetch the evidence, clean up."""

import time
from collections.abc import Callable
from pathlib import Path

from fieldkit.backends.protocols import Testbed
from fieldkit.core.deadline import Deadline
from fieldkit.core.errors import EvidenceError, LinkError, RobotError
from fieldkit.core.model import Role
from fieldkit.core.threads import together
from fieldkit.measure.evidence import lateness, track
from fieldkit.remote import evidence, jobs
from fieldkit.steps.scene import Announce, Scene, Shells
from fieldkit.trial import size
from fieldkit.trial.plan import Plan


class Robots:
    """The robots that take part in a trial, all served at once.

    Args:
        plan: The trial.
        testbed: Where they are.
    """

    def __init__(self, plan: Plan, testbed: Testbed) -> None:
        self._plan = plan
        self._testbed = testbed
        self._roles = sorted(plan.procedure.roles())

    @property
    def shells(self) -> Shells:
        """The control connection of each robot of the cast."""
        return self._testbed.shells

    def begin(self, remote: str, *, old: str | None) -> None:
        """Make an attempt's folder `remote` on each robot, and remove the folder `old`.

        Raises:
            FieldkitError: As `evidence.begin`.
        """
        plan = self._plan

        def make(role: Role) -> None:
            evidence.begin(
                self.shells[role],
                remote,
                role,
                self._interface(role),
                old=old,
                token=plan.session,
                need_kib=(size.evidence_bytes(plan, role) + size.reserve_bytes(plan, role)) // 1024,
            )

        self._everywhere(make)

    def measure(self, scene: Scene, announce: Announce) -> None:
        """Run every step, and write down what the oracle knows of it, where there is one; errors as `Step.run`."""
        oracle = self._testbed.oracle
        if oracle is None:
            self._run_steps(scene, announce)
            return
        before, since_ns = oracle.lateness(), time.time_ns()
        oracle.record_air(scene.here)
        try:
            self._run_steps(scene, announce)
        finally:
            oracle.record_air(None)
        after, where = oracle.lateness(), oracle.track(since_ns)
        if scene.here is not None:
            (scene.here / track.FILE).write_text(track.text(where), encoding="ascii")
            (scene.here / lateness.FILE).write_text(lateness.text(before, after), encoding="ascii")

    def _run_steps(self, scene: Scene, announce: Announce) -> None:
        for entry in self._plan.procedure.steps:
            entry.step.run(scene, self._testbed, announce)

    def fetch(self, remote: str, into: Path, *, clean: bool) -> list[str]:
        """Collect an attempt's evidence, after ending its jobs where it did not end cleanly.

        Returns:
            What went wrong, in sentences.
        """

        def collect(role: Role) -> str:
            try:
                if not clean:
                    evidence.end_jobs(self.shells[role], remote)
                evidence.fetch(self.shells[role], remote, role, self._interface(role), into)
            except (RobotError, LinkError, EvidenceError) as error:
                return error.located
            return ""

        return [reason for reason in self._everywhere(collect) if reason]

    def end_jobs(self, remote: str) -> None:
        """End every job of an attempt; errors as `evidence.end_jobs`."""
        self._everywhere(lambda role: evidence.end_jobs(self.shells[role], remote))

    def end_left(self) -> None:
        """End every job that a fieldkit which was killed left of this trial; errors as `evidence.end_all`."""

        def end(role: Role) -> None:
            jobs.install(self.shells[role], Deadline.after(jobs.REPLY_S))
            evidence.end_all(self.shells[role], self._plan.trial)

        self._everywhere(end)

    def hang_up(self) -> None:
        """Break every control connection; the next command makes a new one."""
        for shell in self.shells.values():
            shell.close()

    def discard(self) -> None:
        """Remove everything of the trial from the robots; errors as `evidence.discard`."""
        self._everywhere(lambda role: evidence.discard(self.shells[role], self._plan.trial))

    def _interface(self, role: Role) -> str:
        return self._plan.cast[role].profile.radio.interface

    def _everywhere(self, call: Callable[[Role], str | None]) -> list[str | None]:
        return together(call, self._roles, hang_up=self.hang_up)
