"""The estimated size of a trial's evidence compared with real sizes."""

from fieldkit.core.model import FIXED_ROLES, Protocol, Role
from fieldkit.trial import size
from tests.helpers.casts import los_plan


def test_a_laser_s_bag_is_estimated_at_its_real_size() -> None:
    # 15 s of the TurtleBot's laser are 230,695 bytes (design, section 5).
    plan = los_plan(protocols=(Protocol.TCP,))
    sender = size.evidence_bytes(plan, Role.SENDER)
    assert size.SPARE * 230_695 < sender < 2 * size.SPARE * 230_695


def test_a_longer_recording_leaves_more_on_both_ends_and_nothing_on_the_relay() -> None:
    short, long = los_plan(record_s=15), los_plan(record_s=150)
    for role in (Role.SENDER, Role.RECEIVER):
        grown = size.evidence_bytes(long, role) - size.evidence_bytes(short, role)
        assert grown > 9 * size.SPARE * 224_000, "135 s more at 15 kB/s are 9 * 224 kB"
    assert size.evidence_bytes(long, Role.RELAY) == 0


def test_the_laptop_stores_every_attempt() -> None:
    plan = los_plan(repeats=7)
    per_attempt = sum(size.evidence_bytes(plan, role) for role in FIXED_ROLES)
    assert size.trial_bytes(plan) == 7 * 2 * per_attempt


def test_files_of_the_lab_are_only_on_the_laptop() -> None:
    plan, recorded = los_plan(repeats=7), los_plan(repeats=7).model_copy(update={"lab_bytes": 1000})
    assert size.attempt_bytes(recorded) == size.attempt_bytes(plan) + 1000
    assert size.trial_bytes(recorded) == size.trial_bytes(plan) + 7 * 2 * 1000
    for role in FIXED_ROLES:
        assert size.evidence_bytes(recorded, role) == size.evidence_bytes(plan, role)
