"""Estimates of the disk space that the evidence of a trial needs."""

from typing import Final

from fieldkit.core.model import Role
from fieldkit.steps.capabilities import ReservesSpace, UsesSpace
from fieldkit.trial.plan import Plan

SPARE: Final = 2.0
"""Factor by which evidence may exceed the estimate, because attempts are repeated and segments are retransmitted."""

RESERVE_BYTES: Final = 100 << 20
"""Bytes that a trial leaves free on every disk for other data."""

FETCHED_BYTES_PER_S: Final = 2.5e6
"""Assumed transfer rate of evidence: 20 Mbit/s, somewhat less than on a good link (`steps.scene.GOOD_BIT_S`)."""

# The states of the host before and after the attempt, logs, and the output of ping take about 20 kB on a robot with
# Wi-Fi; the rest is a margin.
_TEXT_BYTES: Final = 100_000


def evidence_bytes(plan: Plan, role: Role) -> int:
    """Return the estimated number of bytes that one attempt leaves on the robot in `role`, times `SPARE`.

    The result is 0 if no step uses the robot.
    """
    if role not in plan.procedure.roles():
        return 0
    scene = plan.scenes()[0]
    steps = (placed.step for placed in plan.procedure.walk() if isinstance(placed.step, UsesSpace))
    sum_bytes = sum(step.stored_bytes(scene, role) for step in steps)
    return round((_TEXT_BYTES + sum_bytes) * SPARE)


def attempt_bytes(plan: Plan) -> int:
    """Return the estimated number of bytes that one attempt leaves on the laptop.

    It is the evidence of all robots, times `SPARE`, and the maximum that the testbed adds (`Plan.lab_bytes`).
    """
    return sum(evidence_bytes(plan, role) for role in plan.cast) + plan.lab_bytes


def fetch_s(plan: Plan) -> float:
    """Return the estimated time in seconds to fetch the evidence of one attempt over a good link."""
    return sum(evidence_bytes(plan, role) for role in plan.cast) / SPARE / FETCHED_BYTES_PER_S


def reserve_bytes(plan: Plan, role: Role) -> int:
    """Return the number of bytes that must stay free on the robot in `role`."""
    scene = plan.scenes()[0]
    steps = (placed.step for placed in plan.procedure.walk() if isinstance(placed.step, ReservesSpace))
    return max((RESERVE_BYTES, *(step.reserve_bytes(scene, role) for step in steps)))


def trial_bytes(plan: Plan) -> int:
    """Return the estimated number of bytes that the trial leaves on the laptop.

    It is `attempt_bytes` for each repeat of each protocol. `SPARE` covers the attempts that are repeated.
    """
    return attempt_bytes(plan) * plan.repeats * len(plan.protocols)
