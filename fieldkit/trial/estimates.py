"""Time that repeats take: what the procedure expects of a good link, then what repeats of this trial really took."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from statistics import fmean

from fieldkit.core.model import ENDED, Protocol, RepeatId, Status
from fieldkit.core.units import TimeEstimate
from fieldkit.trial.journal import JournalEntry
from fieldkit.trial.plan import Plan
from fieldkit.trial.procedure import Procedure


def total(estimates: Iterable[TimeEstimate]) -> TimeEstimate:
    """Return the estimate of durations that follow each other."""
    both = [(one.likely_s, one.most_s) for one in estimates]
    return TimeEstimate(sum(likely_s for likely_s, _ in both), sum(most_s for _, most_s in both))


@dataclass(frozen=True)
class Taken:
    """A repeat that is over.

    Attributes:
        plan: Its trial.
        protocol: Its protocol.
        took_s: How long all attempts at it took together.
    """

    plan: Plan
    protocol: Protocol
    took_s: float


def dead_link_s(procedure: Procedure, protocol: Protocol) -> float:
    """Return how many seconds one attempt may take where no packet arrives: steps then wait for their limits."""
    waits_s = (getattr(placed.step, name, 0.0) for placed in procedure.walk() for name in ("limit", "patience"))
    return procedure.expected_s(protocol) + sum(waits_s)


def taken(plan: Plan, entries: Iterable[JournalEntry]) -> list[Taken]:
    """Return what the repeats took that are over by a journal; attempts that were cut short do not count."""
    began_ns: dict[RepeatId, int] = {}
    took_s: dict[RepeatId, float] = {}
    over: dict[RepeatId, None] = {}
    for entry in entries:
        if entry.status is Status.RUNNING:
            began_ns[entry.repeat] = entry.utc_ns
        elif entry.status in ENDED and entry.repeat in began_ns and not entry.excused:
            lasted_s = max(entry.utc_ns - began_ns[entry.repeat], 0) / 1e9
            took_s[entry.repeat] = took_s.get(entry.repeat, 0.0) + lasted_s
            over |= {entry.repeat: None} if entry.status is not Status.VOID else {}
    return [Taken(plan, repeat.protocol, took_s[repeat]) for repeat in over]


def of_trial(plan: Plan, known: Sequence[Taken]) -> TimeEstimate:
    """TimeEstimate how long all repeats of a trial take; see `of_repeats`."""
    return total(of_repeats(plan, protocol, plan.repeats, known) for protocol in plan.protocols)


def of_repeats(plan: Plan, protocol: Protocol, count: int, known: Sequence[Taken]) -> TimeEstimate:
    """TimeEstimate how long so many repeats of a trial take.

    Repeats of the same trial say it best. Otherwise those of the nearest shorter and longer distance do, of the same
    topology if there are any: where none was longer, links may be dead here.

    Args:
        plan: The trial.
        protocol: The repeats' protocol.
        count: How many they are.
        known: Repeats that are over, of this and of other trials.
    """
    alike = [one for one in known if one.plan.procedure.name == plan.procedure.name and one.protocol is protocol]
    alike = [one for one in alike if one.plan.topology is plan.topology] or alike
    here = [one.took_s for one in alike if one.plan.distance_m == plan.distance_m]
    if here:
        return TimeEstimate(count * fmean(here), count * max(here))
    dead_s = dead_link_s(plan.procedure, protocol)
    if not alike:
        return TimeEstimate(count * plan.procedure.expected_s(protocol), count * dead_s)
    shorter = [one for one in alike if one.plan.distance_m < plan.distance_m]
    longer = [one for one in alike if one.plan.distance_m > plan.distance_m]
    edges_m = {max(one.plan.distance_m for one in shorter)} if shorter else set()
    edges_m |= {min(one.plan.distance_m for one in longer)} if longer else set()
    nearest_s = [one.took_s for one in alike if one.plan.distance_m in edges_m]
    longest_s = max(one.took_s for one in alike)
    return TimeEstimate(count * fmean(nearest_s), count * (longest_s if longer else max(longest_s, dead_s)))
