"""Guards of drones that other programs fly: each lands its drone if the attempt is aborted (`on_abort`).

A guard runs on the drone's computer while the steps run, and exits without an action when they are done. It lands the
drone or lets it return if the attempt's jobs are stopped (Ctrl-C, an error, `fieldkit abort`), or if no order arrives
from the laptop for its lease (`piloting.leased_program`). It does nothing while a person or a failsafe controls the
drone (`fieldkit.agent.flying.guard`). The step `fly` starts a separate guard for its drone.
"""

from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager

from fieldkit.core.model import Role, sort_roles
from fieldkit.motion.steps import piloting
from fieldkit.steps.scene import Scene, Shells
from fieldkit.trial.procedure_section import TrialOutline


@contextmanager
def guard_drones(actions: Mapping[Role, str], plan: TrialOutline, scene: Scene, shells: Shells) -> Iterator[None]:
    """While the body runs, guard drones that no step flies.

    Args:
        actions: Action of each drone if the attempt is aborted, a value of `OnAbort`.
        plan: The trial.
        scene: The attempt.
        shells: Connections to the robots.

    Raises:
        LinkError: A robot did not answer.
        RobotError: A guard did not start, for example because the autopilot does not answer, or it failed.
    """
    with ExitStack() as stack:
        for role in sort_roles(actions):
            job = piloting.guard_job(scene, role, f"{role}-guard", abort=actions[role])
            body_s = plan.procedure.expected_s(scene.protocol)
            stack.enter_context(piloting.guarding(scene, shells[role], job, body_s=body_s))
        yield
