"""Texts of judgements: expectation, measured value, interval, ruling."""

from fieldkit.analysis import wording
from fieldkit.analysis.cells import Estimate
from fieldkit.analysis.expectations import Scope
from fieldkit.analysis.judgements import Judgement


def judgement_texts(judgement: Judgement) -> tuple[str, str, str, str, str]:
    """Return the texts of a judgement: expectation, protocol, measured value, interval, and ruling."""
    expectation = judgement.expectation
    protocol = str((judgement.cell and judgement.cell.key.get("protocol")) or expectation.protocol or "").upper()
    ruling = f"{judgement.ruling}: {judgement.why}" if judgement.why else str(judgement.ruling)
    if judgement.estimate is None:
        return expectation.text, protocol, "nothing", "", ruling
    value, bounds = _measured(judgement, judgement.estimate)
    note = wording.incomplete(judgement.estimate)
    return expectation.text, protocol, f"{value} ({note})" if note else value, bounds, ruling


def _measured(judgement: Judgement, estimate: Estimate) -> tuple[str, str]:
    """Return the measured value of a judgement, and its interval or one-sided bound; empty if the scope has none."""
    expectation = judgement.expectation
    value_scale = wording.scale_of(estimate.quantity, [estimate.value])
    if expectation.scope is Scope.EVERY:
        worst = estimate.maximum if expectation.is_below else estimate.minimum
        worst_scale = wording.scale_of(estimate.quantity, [worst])
        return f"{wording.at_least(expectation.is_below and estimate.n_censored > 0)}{worst_scale.amount(worst)}", ""
    if expectation.scope is Scope.SHARE and judgement.met is not None and judgement.limit is not None:
        return (
            f"{judgement.met} of {estimate.n} repeats",
            f"{wording.Scale(100.0, '%').amount(judgement.limit)} or more",
        )
    if expectation.scope is Scope.PACKETS and judgement.limit is not None:
        return value_scale.amount(estimate.value), f"{value_scale.amount(judgement.limit)} or less"
    return wording.amount(value_scale, estimate), wording.interval(value_scale, estimate)
