"""Guards of drones during an attempt: a program on each that brings it down where the attempt is cut short.

It runs on the drone's own computer for as long as the steps do, whoever flies the drone meanwhile. It ends by itself,
and leaves the drone alone, where the steps were done; it brings the drone down where somebody ends the attempt's jobs
(Ctrl-C, an error, `fieldkit abort`), and where the laptop has not been heard for `piloting.LEASE_S`.
"""

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from typing import Final

from fieldkit.core.model import in_order
from fieldkit.steps import piloting
from fieldkit.steps.scene import Scene, Shells
from fieldkit.trial.plan import Plan

_ENDS_S: Final = 10.0


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
                    piloting.guard(scene, role),
                    body_s=plan.procedure.expected_s(scene.protocol),
                    ends_s=_ENDS_S,
                )
            )
            for role in in_order(plan.procedure.on_abort)
        ]
        yield
        for leash in leashes:
            leash.let_go()
