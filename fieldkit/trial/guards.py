"""Guards of drones during an attempt: a program on each that brings it down where the attempt is cut short.

It runs on the drone's own computer for as long as the steps do, whoever flies the drone meanwhile. It ends by itself,
and leaves the drone alone, where the steps were done; it brings the drone down where somebody ends the attempt's jobs
(Ctrl-C, an error, `fieldkit abort`), and where the laptop has not been heard for `LEASE_S`.
"""

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from typing import Final

from fieldkit.agent.flight import LEAVE, FlightPlan
from fieldkit.core.model import Role, in_order
from fieldkit.steps import piloting
from fieldkit.steps.scene import Planned, Scene, Shells
from fieldkit.trial.plan import Plan

NAME: Final = "guard"
_ENDS_S: Final = 10.0
_LIMIT_S: Final = 86_400.0


def guard(scene: Scene, role: Role) -> Planned:
    """Return the job of the guard of a drone."""
    connection = piloting.connection(scene.robot(role))
    name = f"{role}-{NAME}"
    plan = FlightPlan(
        connection, piloting.orders_file(name), piloting.abort_of(scene, role).value, lease_s=piloting.LEASE_S
    )
    return piloting.planned(scene, role, name, plan, _LIMIT_S)


@contextmanager
def guarded(plan: Plan, scene: Scene, shells: Shells) -> Iterator[None]:
    """Have every drone of `on_abort` guarded while the body runs.

    Raises:
        LinkError: A robot did not answer.
        RobotError: A guard did not come up: the autopilot is silent, for example.
    """
    with ExitStack() as stack:
        leashes = [
            stack.enter_context(
                piloting.leashed(
                    scene,
                    shells[role],
                    guard(scene, role),
                    body_s=plan.procedure.expected_s(scene.protocol),
                    ends_s=_ENDS_S,
                )
            )
            for role in in_order(plan.procedure.on_abort)
        ]
        yield
        for leash in leashes:
            leash.order(LEAVE)
