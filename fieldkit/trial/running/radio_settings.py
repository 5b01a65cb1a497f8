"""Channel and regulatory domain of the robots' radios, which must not change during a trial."""

from collections.abc import Mapping
from typing import Final

from fieldkit.core.deadline import Deadline
from fieldkit.core.errors import RobotError
from fieldkit.core.model import Role
from fieldkit.core.threads import run_parallel
from fieldkit.measure.robot_state.snapshots import SourceOutput
from fieldkit.remote.shell import Shell
from fieldkit.steps.scene import Shells
from fieldkit.trial import gates
from fieldkit.trial.plan import Plan

_READ_TIMEOUT_S: Final = 10.0
_SEPARATOR: Final = "=="

# Only the kernel is queried, so no packet is sent. In a session without a terminal, PATH often lacks the folder of
# `iw`.
_SCRIPT: Final = f"""
PATH=$PATH:/usr/local/sbin:/usr/sbin:/sbin
export LC_ALL=C
command -v iw >/dev/null || exit 0
iw dev "$1" info && echo {_SEPARATOR} && iw reg get
"""


def read(plan: Plan, shells: Shells) -> dict[Role, dict[str, str]]:
    """Return the settings of the radios, by the names in `neighbourhood.SETTINGS`.

    Robots without `iw` and robots that roam are missing, as are settings that a radio does not report.

    Raises:
        LinkError: A robot did not answer.
    """

    def read_robot(role: Role) -> Mapping[str, str]:
        return _read_robot(shells[role], plan.cast[role].profile.radio.interface)

    roles = sorted(shells.keys() - gates.roaming_roles(plan.procedure))
    settings = zip(roles, run_parallel(read_robot, roles), strict=True)
    return {role: dict(robot_settings) for role, robot_settings in settings if robot_settings}


def _read_robot(shell: Shell, interface: str) -> Mapping[str, str]:
    completed = shell.run(
        ("sh", "-s", interface), stdin=_SCRIPT.encode(), deadline=Deadline.after(_READ_TIMEOUT_S), check=False
    )
    info, _, domain = completed.stdout.decode(errors="replace").partition(f"{_SEPARATOR}\n")
    if not info:
        return {}
    from fieldkit.measure.robot_state import neighbourhood  # noqa: PLC0415 (few robots have iw)

    sources = {neighbourhood.INFO_NAME: info, neighbourhood.REGULATORY_NAME: domain}
    return neighbourhood.parse({name: SourceOutput(text, 0) for name, text in sources.items()}).settings


def require_unchanged(plan: Plan, shells: Shells) -> None:
    """Raise an error if a trial would be resumed with other settings of the radios.

    Raises:
        LinkError: A robot did not answer.
        RobotError: A setting differs from its value at the start of the trial.
    """
    if not plan.radios:
        return
    current = read(plan, shells)
    for role, at_start in plan.radios.items():
        for name, value in current.get(role, {}).items():
            if value != at_start.get(name, value):
                raise RobotError(
                    f"{plan.cast[role].name}: {name.replace('_', ' ')} {value}, but {at_start[name]} at the start",
                    where=plan.trial,
                    remedy="restore it, or start a new trial",
                )
