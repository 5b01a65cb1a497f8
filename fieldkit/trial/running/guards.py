"""Guards of drones that other programs fly: each brings its drone down where the attempt is cut short (`on_abort`).

A guard runs on the drone's own computer for as long as the steps do. It ends by itself, and leaves the drone as it
is, when the steps are done. It brings the drone down where the attempt's jobs are ended (Ctrl-C, an error, `fieldkit
abort`), and where the laptop has not been heard for `piloting.LEASE_S`; not while a person or a failsafe has the
drone (`fieldkit.agent.flying.guard`). A step `fly` has a guard of its own.
"""

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager

from fieldkit.core.model import in_order
from fieldkit.steps import piloting
from fieldkit.steps.scene import Scene, Shells
from fieldkit.trial.plan import Plan


@contextmanager
def guarded(plan: Plan, scene: Scene, shells: Shells) -> Iterator[None]:
    """Have every drone of `on_abort` guarded that no step flies, while the body runs.

    Raises:
        LinkError: A robot did not answer.
        RobotError: A guard did not come up: the autopilot is silent, for example.
    """
    with ExitStack() as stack:
        for role in in_order(set(plan.procedure.on_abort) - plan.procedure.moved()):
            job = piloting.guard(scene, role, f"{role}-guard")
            body_s = plan.procedure.expected_s(scene.protocol)
            stack.enter_context(piloting.guarding(scene, shells[role], job, body_s=body_s))
        yield
