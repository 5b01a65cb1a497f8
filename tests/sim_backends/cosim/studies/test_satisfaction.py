"""The paper's satisfaction loop: it changes the window and with it the error, but never the losses of the radio."""

import pytest

from sim_backends.cosim.comparison import lost_share
from sim_backends.cosim.policies.window_policies import EventDriven, VelocityAware, VelocityAwareRaw
from sim_backends.cosim.studies.satisfaction import satisfy
from tests.helpers.moving_pair import PERIOD_NS, SPEED_M_S, moving_run

REFERENCE = lost_share(moving_run(EventDriven()))


def test_a_loss_that_is_accepted_immediately_takes_one_round() -> None:
    result = satisfy(moving_run, VelocityAwareRaw, threshold=0.9, window_s=0.1)
    assert (result.is_satisfied, len(result.rounds), result.reason) == (True, 1, "")
    assert result.reference_loss == REFERENCE
    assert result.exchanges == result.rounds[0].exchanges == pytest.approx(10 / (0.1 + SPEED_M_S / 1000), abs=1)


def test_each_round_begins_with_the_window_of_the_previous_one_and_all_rounds_add_to_the_cost() -> None:
    """The publisher is faster, so the paper's rule lengthens the window by 1.7 ms in each round."""
    result = satisfy(moving_run, VelocityAwareRaw, threshold=0.0, window_s=0.1, max_rounds=3)
    assert not result.is_satisfied
    assert "3 rounds" in result.reason
    assert [round_.window_s for round_ in result.rounds] == pytest.approx([0.1, 0.1017, 0.1034], rel=0.003)
    assert result.exchanges == sum(round_.exchanges for round_ in result.rounds)


def test_an_accepted_loss_is_an_error_relative_to_the_reference() -> None:
    """The loop ends when a window hides some losses by chance; the reference loses more of the same packets."""
    threshold = REFERENCE - 3 * PERIOD_NS / 10e9
    result = satisfy(moving_run, lambda window_s: VelocityAware(window_s, 10.0), threshold=threshold, window_s=0.3)
    assert result.is_satisfied
    last_round = result.rounds[-1]
    assert last_round.loss <= threshold < result.reference_loss
    assert last_round.errors.fate_disagreement >= result.reference_loss - last_round.loss


def test_a_rule_that_does_not_change_the_window_ends_the_loop() -> None:
    result = satisfy(moving_run, lambda window_s: VelocityAware(window_s, 0.1), threshold=0.0, window_s=0.1)
    assert (len(result.rounds), result.is_satisfied) == (1, False)
    assert "does not change the window" in result.reason
