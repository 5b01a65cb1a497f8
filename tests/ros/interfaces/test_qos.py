"""Qualities of service, compared with the values of rmw/qos_profiles.h and the texts of rmw_zenoh."""

import pytest

from fieldkit.ros.interfaces import qos
from fieldkit.ros.interfaces.qos import PROFILES, Durability, History, Liveliness, QosProfile, Reliability

SECOND_NS = 10**9


@pytest.mark.parametrize(
    ("name", "values"),
    [
        ("default", (Reliability.RELIABLE, History.KEEP_LAST, 10, Durability.VOLATILE)),
        ("sensor_data", (Reliability.BEST_EFFORT, History.KEEP_LAST, 5, Durability.VOLATILE)),
        ("services_default", (Reliability.RELIABLE, History.KEEP_LAST, 10, Durability.VOLATILE)),
        ("parameters", (Reliability.RELIABLE, History.KEEP_LAST, 1000, Durability.VOLATILE)),
        ("parameter_events", (Reliability.RELIABLE, History.KEEP_LAST, 1000, Durability.VOLATILE)),
        ("system_default", (Reliability.SYSTEM_DEFAULT, History.SYSTEM_DEFAULT, 0, Durability.SYSTEM_DEFAULT)),
    ],
)
def test_profiles_have_the_values_of_rmw(name: str, values: tuple[object, ...]) -> None:
    profile = PROFILES[name]
    assert (profile.reliability, profile.history, profile.depth, profile.durability) == values


@pytest.mark.parametrize(
    ("profile", "text"),
    [
        (PROFILES["default"], "::,10:,:,:,,"),
        (PROFILES["sensor_data"], "2::,5:,:,:,,"),
        (PROFILES["system_default"], "::,:,:,:,,"),
        (QosProfile(depth=42), "::,:,:,:,,"),
        (QosProfile(durability=Durability.TRANSIENT_LOCAL, depth=1), ":1:,1:,:,:,,"),
        # This is the example in liveliness_utils.hpp without the default values: deadline 5 s, lifespan 60 s and 3
        # us.
        (QosProfile(deadline_ns=5 * SECOND_NS, lifespan_ns=60 * SECOND_NS + 3000), "::,10:5,0:60,3000:,,"),
        (QosProfile(history=History.KEEP_ALL, liveliness=Liveliness.MANUAL_BY_TOPIC), "::2,10:,:,:3,,"),
    ],
)
def test_rmw_zenoh_omits_default_values(profile: QosProfile, text: str) -> None:
    assert qos.to_zenoh(profile) == text
