"""What an agent's robot is: its body, and its radio."""

from typing import Final

from fieldkit.config import profiles
from fieldkit.config.locations import names
from sim_backends.cosim.scenario.schema import AgentPlan
from sim_backends.radio.world_channel import Antenna, antenna_of

BODIES: Final = ("duckiedrone", "husky", "iris", "turtlebot3_burger")
"""Kinds of bodies by name; those of them that have a robot profile have a radio too."""


def robots() -> list[str]:
    """Return every name that an agent's `robot` may have: kinds of bodies, and profiles of robots."""
    return sorted({*BODIES, *names("robots")})


def antenna(plan: AgentPlan) -> Antenna | None:
    """Return the antenna of an agent: its own radio's, or its profile's; None where it has no radio."""
    if plan.radio is not None:
        return Antenna(plan.radio.standard, plan.radio.tx_power_dbm, plan.radio.sensitivity_dbm)
    return antenna_of(profiles.load_profile(plan.robot).radio) if plan.robot in names("robots") else None
