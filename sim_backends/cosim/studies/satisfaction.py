"""The paper's satisfaction loop: a round is repeated with another window until its loss is accepted.

In the paper (cited in docs/index.md; section III, below algorithm 1), the network's loss is compared with a
threshold. While the loss is above the threshold, algorithm 1 changes the window, and the same round is run again,
until a result "is deemed to be satisfactory". The window of a round is the result of the rule in the previous round.

A sync policy does not change the losses of the radio. Each round is therefore compared with the exact reference of
the same scenario and seed, whose loss does not depend on a window. The loop only changes the error of the result, and
every round adds to its cost.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from fieldkit.core.units import format_count
from sim_backends.cosim.comparison import Errors, compare_runs, lost_share
from sim_backends.cosim.policies.sync_policy import PolicyError, SyncPolicy
from sim_backends.cosim.policies.window_policies import EventDriven
from sim_backends.cosim.run_record import Run


@dataclass(frozen=True)
class Round:
    """One round.

    Attributes:
        window_s: The parameter w of its policy.
        median_window_s: Median of the windows that the rule computed from w.
        loss: Share of lost packets among the packets whose fate is decided; nan without such packets.
        errors: Errors relative to the reference.
        exchanges: Number of windows.
    """

    window_s: float
    median_window_s: float
    loss: float
    errors: Errors
    exchanges: int


@dataclass(frozen=True)
class Satisfaction:
    """The result of the loop.

    Attributes:
        rounds: All rounds.
        is_satisfied: True if the loss of the last round was accepted.
        reference_loss: Loss of the exact reference.
        reference_exchanges: Number of windows of the exact reference.
        reason: The reason why the loop ended without an accepted round; empty if a round was accepted.
    """

    rounds: Sequence[Round]
    is_satisfied: bool
    reference_loss: float
    reference_exchanges: int
    reason: str

    @property
    def exchanges(self) -> int:
        """Number of windows of all rounds."""
        return sum(round_.exchanges for round_ in self.rounds)


def satisfy(
    run: Callable[[SyncPolicy], Run],
    rule: Callable[[float], SyncPolicy],
    *,
    threshold: float,
    window_s: float = 0.001,
    max_rounds: int = 20,
) -> Satisfaction:
    """Run rounds until a round is satisfactory, the rule fails or does not change the window, or all rounds were run.

    Args:
        run: Runs the same scenario and seed with a policy.
        rule: Returns the policy of a round for its parameter w.
        threshold: Accepted loss.
        window_s: w of the first round.
        max_rounds: Largest number of rounds.
    """
    reference = run(EventDriven())
    rounds: list[Round] = []
    reason = f"no loss was accepted in {format_count(max_rounds, 'round')}"
    for _ in range(max_rounds):
        try:
            result = run(rule(window_s))
        except PolicyError as error:
            reason = str(error)
            break
        median_s = float(np.median(np.diff(result.windows_ns, prepend=0))) / 1e9
        loss = lost_share(result)
        rounds.append(Round(window_s, median_s, loss, compare_runs(reference, result), len(result.windows_ns)))
        if loss <= threshold:
            reason = ""
            break
        if median_s == window_s:
            reason = "the rule does not change the window, so another round would be the same"
            break
        window_s = median_s
    return Satisfaction(rounds, not reason, lost_share(reference), len(reference.windows_ns), reason)
