"""The paper's satisfaction loop: a round is run again with another window until the loss that it gives is accepted.

The paper (section III, below algorithm 1): the network's loss is compared with a threshold; while it is above, the
window is changed by algorithm 1, and the same round is run again, until a result "is deemed to be satisfactory". The
window of a round is what the rule made of the one before.

A synchronizer does not change what the radio loses. So each round is told beside the exact reference of the same
scenario and seed, whose loss no window changes: what the loop chooses is an error, and what it costs is every round.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from sim_backends.cosim.comparison import Errors, errors, lost_share
from sim_backends.cosim.policies.base import PolicyError, SyncPolicy
from sim_backends.cosim.policies.event_driven import EventDriven
from sim_backends.cosim.run import Run


@dataclass(frozen=True)
class Round:
    """One round.

    Attributes:
        window_s: The w that it began with.
        median_window_s: What the rule made of it: the median of its windows.
        loss: Share of packets lost, of those whose fate is known.
        errors: Beside the reference.
        exchanges: Its windows.
    """

    window_s: float
    median_window_s: float
    loss: float
    errors: Errors
    exchanges: int


@dataclass(frozen=True)
class Satisfaction:
    """What the loop came to.

    Attributes:
        rounds: All rounds.
        satisfied: Whether the last one's loss was accepted.
        reference_loss: What the exact reference loses.
        reference_exchanges: Its windows.
        reason: Why it ended without; empty if it was satisfied.
    """

    rounds: Sequence[Round]
    satisfied: bool
    reference_loss: float
    reference_exchanges: int
    reason: str

    @property
    def exchanges(self) -> int:
        """What all rounds cost."""
        return sum(one.exchanges for one in self.rounds)


def satisfy(
    run: Callable[[SyncPolicy], Run],
    rule: Callable[[float], SyncPolicy],
    *,
    threshold: float,
    window_s: float = 0.001,
    most_rounds: int = 20,
) -> Satisfaction:
    """Run rounds until one is satisfactory, or none will be.

    Args:
        run: Runs a round, always the same, by a policy.
        rule: Makes the policy of a round from its w: `VelocityAwareRaw`, or `VelocityAware`.
        threshold: Loss that is accepted.
        window_s: w of the first round.
        most_rounds: After how many it gives up.
    """
    reference = run(EventDriven())
    rounds: list[Round] = []
    reason = f"{most_rounds} rounds were not enough"
    for _ in range(most_rounds):
        try:
            found = run(rule(window_s))
        except PolicyError as error:
            reason = str(error)
            break
        median_s = float(np.median(np.diff(found.windows_ns, prepend=0))) / 1e9
        loss = lost_share(found)
        rounds.append(Round(window_s, median_s, loss, errors(reference, found), len(found.windows_ns)))
        if loss <= threshold:
            reason = ""
            break
        if median_s == window_s:
            reason = "the rule leaves the window as it is, and another round would be the same"
            break
        window_s = median_s
    return Satisfaction(rounds, not reason, lost_share(reference), len(reference.windows_ns), reason)
