"""Refuse to go on with a trial that stopped: by another fieldkit, backend or robots than it began with."""

from pathlib import Path

from fieldkit.backends.protocols import Cast
from fieldkit.core import plugins
from fieldkit.core.errors import ConfigurationError, typed
from fieldkit.trial import store
from fieldkit.trial.hashes import code_hash
from fieldkit.trial.plan import Plan


def resumable(folder: Path) -> Plan:
    """Return the plan of a trial that this fieldkit can go on with.

    Raises:
        ConfigurationError: `folder` is no trial, or other code began it: its rows would mix two ways to measure. Or a
            program of the lab that it copies to robots has changed, or is missing.
    """
    plan = store.read_plan(folder)
    was = plan.versions
    # Packages that add steps or a backend have no hash here, and fieldkit's own says more than its version.
    added = {name: now for name, now in plugins.versions().items() if name != "fieldkit"}
    others = [f"{name} {was[name]}" for name, now in added.items() if was.get(name, now) != now]
    if plan.code_sha256 != code_hash():
        others = [f"fieldkit {was.get('fieldkit', 'of no version')}, {plan.code_sha256}"]
    if others:
        raise ConfigurationError(
            f"it was begun by other code ({', '.join(others)})",
            where=str(folder),
            remedy="go on with that version, or start a new trial; what had ended is complete: "
            + typed("fieldkit", "rebuild", folder),
        )
    for put in plan.puts():
        put.program.content()
    return plan


def demand_backend(plan: Plan, name: str, folder: Path) -> None:
    """Stop before robots of another backend go on with a trial.

    Args:
        plan: The trial.
        name: Name of the backend that would go on with it.
        folder: The trial's folder.

    Raises:
        ConfigurationError: It was begun on another backend.
    """
    if name != plan.backend:
        raise ConfigurationError(
            f"it was begun on backend {plan.backend}, not {name}",
            where=str(folder),
            remedy=typed("fieldkit", "resume", folder, "--backend", plan.backend),
        )


def demand_cast(plan: Plan, cast: Cast) -> None:
    """Stop before robots go on with a trial that others began.

    Raises:
        ConfigurationError: A role is not played by the robot that the plan names.
    """
    for role, robot in plan.cast.items():
        found = cast.get(role)
        moved = role in plan.procedure.moved()
        if found and moved and (robot.drives > found.drives or robot.flies > found.flies):
            raise ConfigurationError(
                f"{robot.name} moved by itself in this trial, and may not now",
                where=plan.trial,
                remedy="give --allow-motion again, or start a new trial in which somebody moves it",
            )
        # What the lab would let it do is no matter to a trial in which nothing moves it.
        if found is None or found.model_copy(update={"drives": robot.drives, "flies": robot.flies}) != robot:
            raise ConfigurationError(
                f"{role} was {robot.name} ({robot.address}, {robot.profile.name}); the site file now says otherwise",
                where=plan.trial,
                remedy="let site file and profile say again what trial.yaml says, or start a new trial",
            )
