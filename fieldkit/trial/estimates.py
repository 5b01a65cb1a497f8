"""Estimates of the duration of repeats, based on finished repeats.

Without finished repeats, they are based on the procedure. The likely duration then assumes a good link, and the upper
bound assumes that no packet arrives.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from statistics import fmean

from fieldkit.core.model import FINAL_STATUSES, Protocol, RepeatId, Status
from fieldkit.core.units import TimeEstimate, format_duration
from fieldkit.trial.journal import JournalEntry
from fieldkit.trial.plan import Plan
from fieldkit.trial.procedure import Procedure


def total(estimates: Iterable[TimeEstimate]) -> TimeEstimate:
    """Return the sum of estimates of consecutive durations."""
    bounds = [(estimate.likely_s, estimate.most_s) for estimate in estimates]
    return TimeEstimate(sum(likely_s for likely_s, _ in bounds), sum(most_s for _, most_s in bounds))


@dataclass(frozen=True)
class FinishedRepeat:
    """A finished repeat and its duration.

    Attributes:
        plan: Plan of the trial.
        protocol: Protocol of the repeat.
        duration_s: Total duration of all attempts at the repeat.
    """

    plan: Plan
    protocol: Protocol
    duration_s: float


def dead_link_s(procedure: Procedure, protocol: Protocol) -> float:
    """Return the duration of an attempt in which no packet arrives, with all timeouts added: an upper bound."""
    # `limit` and `patience` are the timeouts of steps. A step without such a key adds nothing.
    waits_s = (getattr(placed.step, name, 0.0) for placed in procedure.walk() for name in ("limit", "patience"))
    return procedure.expected_s(protocol) + sum(waits_s)


def finished_repeats(plan: Plan, entries: Iterable[JournalEntry]) -> list[FinishedRepeat]:
    """Return the finished repeats of a journal. Their durations do not include interrupted attempts."""
    start_ns: dict[RepeatId, int] = {}
    duration_s: dict[RepeatId, float] = {}
    finished: dict[RepeatId, None] = {}
    for entry in entries:
        if entry.status is Status.RUNNING:
            start_ns[entry.repeat] = entry.utc_ns
        elif entry.status in FINAL_STATUSES and entry.repeat in start_ns and not entry.excused:
            attempt_s = max(entry.utc_ns - start_ns[entry.repeat], 0) / 1e9
            duration_s[entry.repeat] = duration_s.get(entry.repeat, 0.0) + attempt_s
            if entry.status is not Status.VOID:
                finished[entry.repeat] = None
    return [FinishedRepeat(plan, repeat.protocol, duration_s[repeat]) for repeat in finished]


def estimate_trial(plan: Plan, finished: Sequence[FinishedRepeat]) -> TimeEstimate:
    """Return the estimated duration of all repeats of a trial; see `estimate_repeats`."""
    return total(estimate_repeats(plan, protocol, plan.repeats, finished) for protocol in plan.protocols)


def battery_notes(plans: Sequence[Plan]) -> Iterator[str]:
    """Yield a sentence for each robot whose battery is too small for a series of trials, according to its profile."""
    duration = total(estimate_trial(plan, []) for plan in plans)
    for robot in plans[0].cast.values():
        battery_min = robot.profile.limits.battery_min
        if battery_min is not None and duration.likely_s > 60 * battery_min:
            yield (
                f"{robot.name} runs for about {battery_min:g} min on one charge (battery_min of its profile), "
                f"the trial takes {format_duration(duration.likely_s)}"
            )


def estimate_repeats(plan: Plan, protocol: Protocol, count: int, finished: Sequence[FinishedRepeat]) -> TimeEstimate:
    """Return the estimated duration of a number of repeats of a trial.

    The estimate is based on finished repeats at the same distance or, if there are none, at the nearest shorter and
    longer distances; repeats of the same topology are preferred. If no finished repeat was at a longer distance, the
    upper bound assumes that no packet arrives.

    Args:
        plan: The trial.
        protocol: Protocol of the repeats.
        count: Number of repeats.
        finished: Finished repeats of this and of other trials.
    """
    similar = [
        repeat
        for repeat in finished
        if repeat.plan.procedure.name == plan.procedure.name and repeat.protocol is protocol
    ]
    similar = [repeat for repeat in similar if repeat.plan.topology is plan.topology] or similar
    same_distance_s = [repeat.duration_s for repeat in similar if repeat.plan.distance_m == plan.distance_m]
    if same_distance_s:
        return TimeEstimate(count * fmean(same_distance_s), count * max(same_distance_s))
    dead_s = dead_link_s(plan.procedure, protocol)
    if not similar:
        return TimeEstimate(count * plan.procedure.expected_s(protocol), count * dead_s)
    shorter = [repeat for repeat in similar if repeat.plan.distance_m < plan.distance_m]
    longer = [repeat for repeat in similar if repeat.plan.distance_m > plan.distance_m]
    nearest_distances_m = {max(repeat.plan.distance_m for repeat in shorter)} if shorter else set()
    nearest_distances_m |= {min(repeat.plan.distance_m for repeat in longer)} if longer else set()
    nearest_s = [repeat.duration_s for repeat in similar if repeat.plan.distance_m in nearest_distances_m]
    longest_s = max(repeat.duration_s for repeat in similar)
    return TimeEstimate(count * fmean(nearest_s), count * (longest_s if longer else max(longest_s, dead_s)))
