"""Expectations that a plan cannot decide, for example with too few repeats."""

from collections.abc import Iterator

from fieldkit.analysis import sample_size
from fieldkit.trial.plan import Plan


def of_plan(plan: Plan) -> Iterator[str]:
    """Yield a sentence for each expectation of a plan that it cannot decide."""
    return sample_size.unmet_requirements(plan.procedure.expectations, plan.procedure.figures, plan.repeats)
