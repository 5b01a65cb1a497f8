"""Resume a trial. Code, backend and robots must be the same as when the trial was started."""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Final

from fieldkit.backends.protocols import Backend, Cast, Testbed, simulators_of
from fieldkit.core import permissions, plugins, seeds
from fieldkit.core.errors import ConfigurationError, shell_command
from fieldkit.core.events import Note, Sink
from fieldkit.core.prompts import Operator
from fieldkit.trial import journal, step_packages
from fieldkit.trial.hashes import code_hash
from fieldkit.trial.plan import Plan, simulators_text
from fieldkit.trial.running import radio_settings
from fieldkit.trial.running.opening import opened
from fieldkit.trial.running.runner import Outcome, converting_write_errors, place, run_repeats
from fieldkit.trial.running.stop import Stop
from fieldkit.trial.step_packages import StepPackage
from fieldkit.trial.stored import plans


def resume(
    folder: Path, name: str, backend: Backend, *, failed: bool, sink: Sink, operator: Operator, stop: Stop
) -> Outcome | None:
    """Resume an interrupted trial.

    Args:
        folder: The trial's folder.
        name: Name of the backend.
        backend: The backend.
        failed: True to repeat failed repeats as well.
        sink: Receives events.
        operator: The person who performs actions that the backend cannot perform.
        stop: Request to stop the trial.

    Returns:
        The outcome; None if the operator skipped the trial.

    Raises:
        FieldkitError: The trial was started with other code, on another backend or with other robots; or `opened` or
            `resume_trial` raised the error.
    """
    plan = resumable(folder)
    for change in _step_code_changes(plan.step_packages):
        sink(Note(change))
    require_backend(plan, name, folder)
    require_simulators(plan, simulators_of(backend), folder)
    require_cast(plan, backend.cast(plan.topology))
    seed = seeds.testbed_seed(plan.seed, journal.started_attempts(folder))
    with opened(
        backend, plan.cast, session=plan.session, purpose=plan.trial, seed=seed, sink=sink, operator=operator
    ) as testbed:
        return resume_trial(folder, testbed, sink, stop, failed=failed)


def resume_trial(
    folder: Path, testbed: Testbed, sink: Sink, stop: Stop | None = None, *, failed: bool = False
) -> Outcome | None:
    """Place the robots and resume a trial; None if the operator skipped it.

    Raises the same errors as `place` and `continue_trial`.
    """
    placement = place(resumable(folder), testbed, sink)
    if placement.answer.skip:
        return None
    return continue_trial(folder, testbed, sink, stop or Stop(), failed=failed)


def continue_trial(
    folder: Path, testbed: Testbed, sink: Sink, stop: Stop, *, report_resume: bool = True, failed: bool = False
) -> Outcome:
    """Resume an interrupted trial. Finished repeats are kept; all other repeats are attempted again.

    If the steps of an attempt had ended, its evidence is fetched and checked. Otherwise, the attempt is stored as
    void and is not one of the allowed attempts.

    Args:
        folder: The trial's folder.
        testbed: The robots of the trial, at their places.
        sink: Receives events.
        stop: Request to stop the trial.
        report_resume: True to report the command that resumes this trial if it stops.
        failed: True to repeat failed repeats as well, each with as many attempts as the procedure allows.

    Raises:
        ConfigurationError: `folder` is not a trial, the trial was started with other code, or another process runs
            it.
        EvidenceError: The journal is damaged.
        FieldkitError: For the same reasons as `begin`.
    """
    plan = resumable(folder)
    radio_settings.require_unchanged(plan, testbed.shells)
    with journal.locked(folder), converting_write_errors(folder):
        if failed and not journal.reopen_failed(folder, plan) and report_resume:
            sink(Note("no repeat of this trial failed"))
        return run_repeats(plan, testbed, folder, sink, stop, report_resume=report_resume)


def resumable(folder: Path) -> Plan:
    """Return the plan of a trial that this version of fieldkit can resume.

    Raises:
        ConfigurationError: `folder` is not a trial; the trial was started with other code, so that its rows would be
            measured in two ways; or a program of the lab that it copies to robots has changed or is missing.
    """
    plan = plans.read_plan(folder)
    versions = plan.versions
    # Packages that add steps or a backend are compared by version, fieldkit by its hash, which is more precise.
    packages = {name: version for name, version in plugins.versions().items() if name != "fieldkit"}
    changed = [
        f"{name} {versions[name]}" for name, version in packages.items() if versions.get(name, version) != version
    ]
    if plan.code_sha256 != code_hash():
        changed = [f"fieldkit {versions.get('fieldkit', 'of an unknown version')}, {plan.code_sha256}"]
    if changed:
        raise ConfigurationError(
            f"it was started with other code ({', '.join(changed)})",
            where=str(folder),
            remedy="resume it with that version, or start a new trial; the results of the finished repeats: "
            + shell_command("fieldkit", "rebuild", folder),
        )
    for put in plan.program_copies():
        put.program.content()
    return plan


def require_backend(plan: Plan, name: str, folder: Path) -> None:
    """Raise an error if a trial would be resumed on another backend.

    Args:
        plan: The trial.
        name: Name of the backend on which it would be resumed.
        folder: The trial's folder.

    Raises:
        ConfigurationError: The trial was started on another backend.
    """
    if name != plan.backend:
        raise ConfigurationError(
            f"it was started on backend {plan.backend}, not {name}",
            where=str(folder),
            remedy=shell_command("fieldkit", "resume", folder, "--backend", plan.backend),
        )


_NO_SIMULATORS: Final = "no simulators"


def require_simulators(plan: Plan, simulators: Mapping[str, str], folder: Path) -> None:
    """Raise an error if a trial would be resumed on other simulators, which must not be mixed in one table.

    Args:
        plan: The trial.
        simulators: The simulators on which it would be resumed.
        folder: The trial's folder.

    Raises:
        ConfigurationError: The trial was started on other simulators.
    """
    if simulators != plan.simulators:
        raise ConfigurationError(
            f"it was started on {simulators_text(plan.simulators) or _NO_SIMULATORS}, not on "
            f"{simulators_text(simulators) or _NO_SIMULATORS}",
            where=str(folder),
            remedy="restore physics, network and sync in the site file, or start a new trial",
        )


def require_cast(plan: Plan, cast: Cast) -> None:
    """Raise an error if a trial would be resumed with other robots.

    Raises:
        ConfigurationError: A role has another robot than in the plan.
    """
    for role, robot in plan.cast.items():
        current = cast.get(role)
        is_moved = role in plan.procedure.moved_roles()
        if current and is_moved and robot.abilities - current.abilities:
            options = " ".join(map(permissions.option, permissions.repeated(permissions.installed())))
            raise ConfigurationError(
                f"{robot.name} moves without a person in this trial, which is not permitted now",
                where=plan.trial,
                remedy=f"add {options}, or start a new trial in which a person moves it",
            )
        # In a trial that does not move the robot, its permission to move may differ.
        if current is None or current.model_copy(update={"abilities": robot.abilities}) != robot:
            raise ConfigurationError(
                f"{role} was {robot.name} ({robot.address}, {robot.profile.name}); the site file now differs",
                where=plan.trial,
                remedy="restore the site file and profile to the values in trial.yaml, or start a new trial",
            )


def _step_code_changes(planned: Mapping[str, StepPackage]) -> Iterator[str]:
    """Yield a sentence for each kind of step whose code has changed since the plan, although its version has not."""
    for kind, current in step_packages.packages_of_kinds(planned).items():
        frozen = planned[kind]
        if (frozen.package, frozen.version) == (
            current.package,
            current.version,
        ) and frozen.code_sha256 != current.code_sha256:
            yield (
                f"the code of the step {kind} ({current.package} {current.version}) has changed since the trial "
                "was started: its repeats are measured with different code"
            )
