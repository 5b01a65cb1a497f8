"""Quality-of-service (QoS) profiles of ROS 2, and their encoding in liveliness tokens of rmw_zenoh.

Names and values: rmw/qos_profiles.h and rmw/types.h of ROS 2 (the same from Foxy to Jazzy).
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from enum import Enum
from types import MappingProxyType
from typing import Final, TypeVar


class Policy(Enum):
    """Base class of the policies of a profile. The values are the numbers in rmw/types.h."""


class Reliability(Policy):
    """Whether lost samples are sent again."""

    SYSTEM_DEFAULT = 0
    RELIABLE = 1
    BEST_EFFORT = 2


class History(Policy):
    """Number of samples that are kept for readers that have not received them."""

    SYSTEM_DEFAULT = 0
    KEEP_LAST = 1
    KEEP_ALL = 2


class Durability(Policy):
    """Whether late-joining readers receive earlier samples."""

    SYSTEM_DEFAULT = 0
    TRANSIENT_LOCAL = 1
    VOLATILE = 2


class Liveliness(Policy):
    """Method by which a publisher asserts that it is alive."""

    SYSTEM_DEFAULT = 0
    AUTOMATIC = 1
    MANUAL_BY_TOPIC = 3


@dataclass(frozen=True)
class QosProfile:
    """A QoS profile.

    Attributes:
        reliability: Whether lost samples are sent again.
        history: Whether the last samples or all samples are kept.
        depth: Number of kept samples with `KEEP_LAST`; 0 for the middleware's default.
        durability: Whether late-joining readers receive earlier samples.
        deadline_ns: Maximum expected time between two samples; None for no deadline.
        lifespan_ns: Time after which a sample expires; None for no limit.
        liveliness: Method by which a publisher asserts that it is alive.
        lease_ns: Maximum time between two assertions; None for no limit.
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
"""The profiles of ROS 2 by name: `rmw_qos_profile_NAME`."""

_ZENOH: Final = QosProfile(depth=42, liveliness=Liveliness.AUTOMATIC)
"""Default profile of rmw_zenoh (its qos.cpp). A token omits values that are equal to these."""

_SECOND_NS: Final = 10**9
_INFINITE_NS: Final = 2**63 - 1  # RMW_DURATION_INFINITE

Kind = TypeVar("Kind", bound=Policy)


def to_zenoh(profile: QosProfile) -> str:
    """Return a profile as the last part of a liveliness token, for example `2::,5:,:,:,,` for sensor data."""
    resolved_profile = _with_zenoh_defaults(profile)
    kinds = (
        resolved_profile.reliability,
        resolved_profile.durability,
        resolved_profile.history,
        resolved_profile.liveliness,
    )
    defaults = (_ZENOH.reliability, _ZENOH.durability, _ZENOH.history, _ZENOH.liveliness)
    reliability, durability, history, liveliness = (
        "" if kind is default else str(kind.value) for kind, default in zip(kinds, defaults, strict=True)
    )
    depth = "" if resolved_profile.depth == _ZENOH.depth else str(resolved_profile.depth)
    deadline, lifespan, lease = (
        _duration(time_ns)
        for time_ns in (resolved_profile.deadline_ns, resolved_profile.lifespan_ns, resolved_profile.lease_ns)
    )
    return f"{reliability}:{durability}:{history},{depth}:{deadline}:{lifespan}:{liveliness},{lease}"


def _with_zenoh_defaults(profile: QosProfile) -> QosProfile:
    """Return a profile in which system defaults are replaced by the defaults of rmw_zenoh."""
    return replace(
        profile,
        reliability=_resolve(profile.reliability, _ZENOH.reliability),
        history=_resolve(profile.history, _ZENOH.history),
        depth=profile.depth or _ZENOH.depth,
        durability=_resolve(profile.durability, _ZENOH.durability),
        liveliness=_resolve(profile.liveliness, _ZENOH.liveliness),
    )


def _resolve(policy: Kind, default: Kind) -> Kind:
    return policy if policy.value else default


def _duration(time_ns: int | None) -> str:
    if time_ns is None:
        return ","
    # The default is an infinite duration. Seconds are omitted if they are equal to its seconds, and nanoseconds if
    # they are equal to its nanoseconds.
    return ",".join(
        "" if part == default else str(part)
        for part, default in zip(divmod(time_ns, _SECOND_NS), divmod(_INFINITE_NS, _SECOND_NS), strict=True)
    )
