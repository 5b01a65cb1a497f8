"""Find expectations that the repeats of a plan cannot decide, for example because there are too few repeats."""

from collections.abc import Iterator

from fieldkit.analysis import sample_size
from fieldkit.trial.plan import Plan


def undecidable_expectations(plan: Plan) -> Iterator[str]:
    """Yield a sentence for each expectation of a plan that its repeats cannot decide."""
    return sample_size.unmet_requirements(plan.procedure.expectations, plan.procedure.figures, plan.repeats)
