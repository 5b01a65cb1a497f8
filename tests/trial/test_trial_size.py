"""Comparison of the estimated size of the evidence of a trial with real sizes."""

from fieldkit.core.model import FIXED_ROLES, Protocol, Role
from fieldkit.trial import size
from tests.helpers.casts import los_plan


def test_the_estimated_size_of_a_laser_s_bag_is_close_to_its_real_size() -> None:
    # 15 s of the TurtleBot's laser are 230,695 bytes (design, section 5).
    plan = los_plan(protocols=(Protocol.TCP,))
    sender = size.evidence_bytes(plan, Role.SENDER)
    assert size.SPARE * 230_695 < sender < 2 * size.SPARE * 230_695


def test_a_longer_recording_needs_more_space_on_both_ends_and_none_on_the_relay() -> None:
    short, long = los_plan(record_s=15), los_plan(record_s=150)
    for role in (Role.SENDER, Role.RECEIVER):
        additional_bytes = size.evidence_bytes(long, role) - size.evidence_bytes(short, role)
        assert additional_bytes > 9 * size.SPARE * 224_000, "135 s more at 15 kB/s are 9 * 224 kB"
    assert size.evidence_bytes(long, Role.RELAY) == 0


def test_the_laptop_stores_every_attempt() -> None:
    plan = los_plan(repeats=7)
    attempt_bytes = sum(size.evidence_bytes(plan, role) for role in FIXED_ROLES)
    assert size.trial_bytes(plan) == 7 * 2 * attempt_bytes


def test_files_of_the_lab_are_only_on_the_laptop() -> None:
    plan, with_lab_files = los_plan(repeats=7), los_plan(repeats=7).model_copy(update={"lab_bytes": 1000})
    assert size.attempt_bytes(with_lab_files) == size.attempt_bytes(plan) + 1000
    assert size.trial_bytes(with_lab_files) == size.trial_bytes(plan) + 7 * 2 * 1000
    for role in FIXED_ROLES:
        assert size.evidence_bytes(with_lab_files, role) == size.evidence_bytes(plan, role)
