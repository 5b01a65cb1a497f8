"""Estimate the room that the evidence of a trial takes, before it is there."""

from typing import Final

from fieldkit.core.model import Role
from fieldkit.trial.plan import Plan

SPARE: Final = 2.0
"""Evidence may be so many times as large as estimated: repeats are redone, segments sent again."""

RESERVE_BYTES: Final = 100 << 20
"""Room that a trial leaves on every disk, for what is neither evidence nor fieldkit's."""

FETCHED_BYTES_PER_S: Final = 2.5e6
"""How fast evidence comes: TCP over a good link of 802.11n, with one stream in 20 MHz, carries some 20 Mbit/s."""

# Host state before and after, logs, ping's lines; about 20 kB on a robot with Wi-Fi.
_TEXT_BYTES: Final = 100_000


def evidence_bytes(plan: Plan, role: Role) -> int:
    """Return about how many bytes one attempt leaves on the robot in `role`, with `SPARE`; 0 if no step is there."""
    if role not in plan.procedure.roles():
        return 0
    scene = plan.scenes()[0]
    left = sum(placed.step.bytes_left(scene, role) for placed in plan.procedure.walk())
    return round((_TEXT_BYTES + left) * SPARE)


def attempt_bytes(plan: Plan) -> int:
    """Return about how many bytes one attempt leaves on the laptop, with `SPARE`."""
    return sum(evidence_bytes(plan, role) for role in plan.cast) + plan.lab_bytes


def fetch_s(plan: Plan) -> float:
    """Return about how many seconds the evidence of one attempt takes to the laptop, over a good link."""
    return sum(evidence_bytes(plan, role) for role in plan.cast) / SPARE / FETCHED_BYTES_PER_S


def reserve_bytes(plan: Plan, role: Role) -> int:
    """Return how many bytes must stay free on the robot in `role`."""
    scene = plan.scenes()[0]
    return max(RESERVE_BYTES, *(placed.step.reserve_bytes(scene, role) for placed in plan.procedure.walk()))


def trial_bytes(plan: Plan) -> int:
    """Return about how many bytes the whole trial leaves on the laptop, with `SPARE`."""
    return attempt_bytes(plan) * plan.repeats * len(plan.protocols)
