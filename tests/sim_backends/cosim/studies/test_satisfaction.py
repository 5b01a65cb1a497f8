"""The paper's satisfaction loop: what it changes is the window, and with it the error; never what the radio loses."""

import pytest

from sim_backends.cosim.comparison import lost_share
from sim_backends.cosim.policies.event_driven import EventDriven
from sim_backends.cosim.policies.velocity_aware import VelocityAware
from sim_backends.cosim.policies.velocity_aware_raw import VelocityAwareRaw
from sim_backends.cosim.studies.satisfaction import satisfy
from tests.helpers.moving_pair import PERIOD_NS, SPEED_M_S, moving_run

REFERENCE = lost_share(moving_run(EventDriven()))


def test_a_loss_that_is_accepted_at_once_takes_one_round() -> None:
    found = satisfy(moving_run, VelocityAwareRaw, threshold=0.9, window_s=0.1)
    assert (found.satisfied, len(found.rounds), found.reason) == (True, 1, "")
    assert found.reference_loss == REFERENCE
    assert found.exchanges == found.rounds[0].exchanges == pytest.approx(10 / (0.1 + SPEED_M_S / 1000), abs=1)


def test_each_round_begins_with_the_window_of_the_one_before_and_the_rounds_are_what_it_costs() -> None:
    """The publisher is faster, so the paper's rule lengthens the window by 1.7 ms in each round."""
    found = satisfy(moving_run, VelocityAwareRaw, threshold=0.0, window_s=0.1, most_rounds=3)
    assert not found.satisfied
    assert "3 rounds" in found.reason
    assert [one.window_s for one in found.rounds] == pytest.approx([0.1, 0.1017, 0.1034], rel=0.003)
    assert found.exchanges == sum(one.exchanges for one in found.rounds)


def test_the_loss_that_it_accepts_is_an_error_beside_the_reference() -> None:
    """It ends where a window happens to hide some packets' loss; the reference of the same packets loses more."""
    threshold = REFERENCE - 3 * PERIOD_NS / 10e9
    found = satisfy(moving_run, lambda window_s: VelocityAware(window_s, 10.0), threshold=threshold, window_s=0.3)
    assert found.satisfied
    last = found.rounds[-1]
    assert last.loss <= threshold < found.reference_loss
    assert last.errors.fate_disagreement >= found.reference_loss - last.loss


def test_a_rule_that_changes_nothing_ends_it_and_one_that_stops_time_too() -> None:
    unchanged = satisfy(moving_run, lambda window_s: VelocityAware(window_s, 0.1), threshold=0.0, window_s=0.1)
    assert (len(unchanged.rounds), unchanged.satisfied) == (1, False)
    assert "as it is" in unchanged.reason
