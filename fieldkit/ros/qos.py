"""Qualities of service as ROS 2 names them, and as rmw_zenoh writes them into liveliness tokens.

Names and values: rmw/qos_profiles.h and rmw/types.h of ROS 2 (the same from Foxy to Jazzy).
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from enum import Enum
from types import MappingProxyType
from typing import Final, TypeVar


class Policy(Enum):
    """A policy with the numbers of rmw/types.h."""


class Reliability(Policy):
    """Whether what is lost is sent again."""

    SYSTEM_DEFAULT = 0
    RELIABLE = 1
    BEST_EFFORT = 2


class History(Policy):
    """How many samples are kept for who has not got them."""

    SYSTEM_DEFAULT = 0
    KEEP_LAST = 1
    KEEP_ALL = 2


class Durability(Policy):
    """Whether who comes late gets what was sent before."""

    SYSTEM_DEFAULT = 0
    TRANSIENT_LOCAL = 1
    VOLATILE = 2


class Liveliness(Policy):
    """Who says that a publisher is alive."""

    SYSTEM_DEFAULT = 0
    AUTOMATIC = 1
    MANUAL_BY_TOPIC = 3


@dataclass(frozen=True)
class QosProfile:
    """A quality of service.

    Attributes:
        reliability: Whether what is lost is sent again.
        history: How many samples are kept.
        depth: That number, with `KEEP_LAST`; 0 leaves it to the middleware.
        durability: Whether who comes late gets what was sent before.
        deadline_ns: A sample is expected at least so often; None for never.
        lifespan_ns: A sample is worth nothing after this time; None for always.
        liveliness: Who says that a publisher is alive.
        lease_ns: How often it must; None for never.
    """

    reliability: Reliability = Reliability.RELIABLE
    history: History = History.KEEP_LAST
    depth: int = 10
    durability: Durability = Durability.VOLATILE
    deadline_ns: int | None = None
    lifespan_ns: int | None = None
    liveliness: Liveliness = Liveliness.SYSTEM_DEFAULT
    lease_ns: int | None = None


PROFILES: Final[Mapping[str, QosProfile]] = MappingProxyType(
    {
        "default": QosProfile(),
        "sensor_data": QosProfile(reliability=Reliability.BEST_EFFORT, depth=5),
        "services_default": QosProfile(),
        "parameters": QosProfile(depth=1000),
        "parameter_events": QosProfile(depth=1000),
        "system_default": QosProfile(
            Reliability.SYSTEM_DEFAULT, History.SYSTEM_DEFAULT, 0, Durability.SYSTEM_DEFAULT
        ),
    }
)
"""The profiles that ROS 2 names, `rmw_qos_profile_NAME`."""

_ZENOH: Final = QosProfile(depth=42, liveliness=Liveliness.AUTOMATIC)
"""What rmw_zenoh takes where nothing is said (its qos.cpp); a token leaves out what equals it."""

_SECOND_NS: Final = 10**9
_INFINITE_NS: Final = 2**63 - 1  # RMW_DURATION_INFINITE

Kind = TypeVar("Kind", bound=Policy)


def to_zenoh(profile: QosProfile) -> str:
    """Return a profile as the last part of a liveliness token: `2::,5:,:,:,,` of sensor data."""
    own = _adapted(profile)
    kinds = (own.reliability, own.durability, own.history, own.liveliness)
    usual = (_ZENOH.reliability, _ZENOH.durability, _ZENOH.history, _ZENOH.liveliness)
    reliability, durability, history, liveliness = (
        "" if kind is other else str(kind.value) for kind, other in zip(kinds, usual, strict=True)
    )
    depth = "" if own.depth == _ZENOH.depth else str(own.depth)
    deadline, lifespan, lease = (_duration(time_ns) for time_ns in (own.deadline_ns, own.lifespan_ns, own.lease_ns))
    return f"{reliability}:{durability}:{history},{depth}:{deadline}:{lifespan}:{liveliness},{lease}"


def _adapted(profile: QosProfile) -> QosProfile:
    """Return what rmw_zenoh makes of a profile: what is left to the middleware has its values."""
    return replace(
        profile,
        reliability=_chosen(profile.reliability, _ZENOH.reliability),
        history=_chosen(profile.history, _ZENOH.history),
        depth=profile.depth or _ZENOH.depth,
        durability=_chosen(profile.durability, _ZENOH.durability),
        liveliness=_chosen(profile.liveliness, _ZENOH.liveliness),
    )


def _chosen(policy: Kind, otherwise: Kind) -> Kind:
    return policy if policy.value else otherwise


def _duration(time_ns: int | None) -> str:
    if time_ns is None:
        return ","
    # Each half is left out where it equals that of the usual duration.
    return ",".join(
        "" if own == usual else str(own)
        for own, usual in zip(divmod(time_ns, _SECOND_NS), divmod(_INFINITE_NS, _SECOND_NS), strict=True)
    )
