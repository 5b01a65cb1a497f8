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
_PARTS: Final = 6

Kind = TypeVar("Kind", bound=Policy)


def adapted(profile: QosProfile) -> QosProfile:
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


def to_zenoh(profile: QosProfile) -> str:
    """Return a profile as the last part of a liveliness token: `2::,5:,:,:,,` of sensor data."""
    own = adapted(profile)
    kinds = (own.reliability, own.durability, own.history, own.liveliness)
    usual = (_ZENOH.reliability, _ZENOH.durability, _ZENOH.history, _ZENOH.liveliness)
    reliability, durability, history, liveliness = (
        "" if kind is other else str(kind.value) for kind, other in zip(kinds, usual, strict=True)
    )
    depth = "" if own.depth == _ZENOH.depth else str(own.depth)
    deadline, lifespan, lease = (_duration(one) for one in (own.deadline_ns, own.lifespan_ns, own.lease_ns))
    return f"{reliability}:{durability}:{history},{depth}:{deadline}:{lifespan}:{liveliness},{lease}"


def _duration(time_ns: int | None) -> str:
    if time_ns is None:
        return ","
    # Each half is left out where it equals that of the usual duration.
    return ",".join(
        "" if own == usual else str(own)
        for own, usual in zip(divmod(time_ns, _SECOND_NS), divmod(_INFINITE_NS, _SECOND_NS), strict=True)
    )


def from_zenoh(text: str) -> QosProfile:
    """Return the profile that the last part of a liveliness token tells.

    Raises:
        ValueError: It is none.
    """
    parts = text.split(":")
    if len(parts) < _PARTS:
        raise ValueError(f"{text!r} is no quality of service of rmw_zenoh")
    history, depth = parts[2].split(",")
    liveliness, *lease = parts[5].split(",")
    return QosProfile(
        reliability=_kind(Reliability, parts[0], _ZENOH.reliability),
        history=_kind(History, history, _ZENOH.history),
        depth=int(depth) if depth else _ZENOH.depth,
        durability=_kind(Durability, parts[1], _ZENOH.durability),
        deadline_ns=_time_ns(parts[3].split(",")),
        lifespan_ns=_time_ns(parts[4].split(",")),
        liveliness=_kind(Liveliness, liveliness, _ZENOH.liveliness),
        lease_ns=_time_ns(lease),
    )


def _kind(kind: type[Kind], text: str, usual: Kind) -> Kind:
    return kind(int(text)) if text else usual


def _time_ns(parts: list[str]) -> int | None:
    usual_s, usual_ns = divmod(_INFINITE_NS, _SECOND_NS)
    seconds, nanoseconds = parts
    time_ns = (int(seconds) if seconds else usual_s) * _SECOND_NS + (int(nanoseconds) if nanoseconds else usual_ns)
    return None if time_ns >= _INFINITE_NS else time_ns
