"""Finds periods that are commensurate with a window: a few periods are a whole number of windows.

The phase of a packet is the time from the beginning of a window until the packet is sent. The error of a policy
depends on this phase. If b periods are a whole number of windows, packets are sent at b phases only. The measured
error is then the error at these phases, not the error of the policy.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Final

from sim_backends.cosim.programs.way_points import PERIOD_NS
from sim_backends.cosim.scenario.agent_plans import BagTraffic, FollowPlan
from sim_backends.cosim.scenario.schema import CosimScenario

MAX_PHASES: Final = 10
"""Events with more phases are not reported.

The mean over 10 evenly distributed phases has an error of at most a twentieth of a window.
"""
_MAX_STEPS: Final = 100
"""Largest number of physics steps by which a proposed window is longer than the given one."""


@dataclass(frozen=True)
class PeriodicEvent:
    """A periodic event of a scenario.

    Attributes:
        name: Its name, for messages.
        period_s: Its period.
        count: Number of times that it occurs in a run.
        jitter_s: Largest random delay of an occurrence.
    """

    name: str
    period_s: float
    count: float
    jitter_s: float = 0.0


@dataclass(frozen=True)
class CommensurateEvent:
    """A periodic event that occurs at few phases of a window.

    Attributes:
        event: The event.
        window_s: The window.
        phases: Number of phases.
    """

    event: PeriodicEvent
    window_s: float
    phases: int


def periodic_events(scenario: CosimScenario) -> Iterator[PeriodicEvent]:
    """Yield the periodic events of a scenario whose phase affects errors: traffic, and controllers of followers."""
    for traffic in scenario.traffic:
        if traffic.period_s:
            jitter_s = traffic.jitter if isinstance(traffic, BagTraffic) else 0.0
            flows = len(traffic.flow_ends)
            yield PeriodicEvent(traffic.title, traffic.period_s, traffic.packets(scenario.duration) / flows, jitter_s)
    if any(isinstance(plan.motion, FollowPlan) for plan in scenario.agents.values()):
        period_s = PERIOD_NS / 1e9
        yield PeriodicEvent("the followers' controllers", period_s, scenario.duration / period_s)


def commensurate_events(scenario: CosimScenario, windows_s: Sequence[float]) -> list[CommensurateEvent]:
    """Return the events that occur at few phases of one of the windows in a run of a scenario."""
    return [
        CommensurateEvent(event, window_s, phases)
        for window_s in windows_s
        for event in periodic_events(scenario)
        if (phases := _few_phases(event, window_s)) is not None
    ]


def incommensurate_window_s(scenario: CosimScenario, window_s: float) -> float | None:
    """Return the nearest window of whole steps without commensurate events; None if the search finds no such window.

    The search covers half to twice the length of the window, but at most `_MAX_STEPS` steps above it.
    """
    step_s = scenario.physics.step
    steps = round(window_s / step_s)
    counts = sorted(
        range(max(steps // 2, 1), min(2 * steps, steps + _MAX_STEPS) + 1), key=lambda count: abs(count - steps)
    )
    return next((count * step_s for count in counts if not commensurate_events(scenario, [count * step_s])), None)


def _few_phases(event: PeriodicEvent, window_s: float) -> int | None:
    """Return the number of phases of a window at which an event occurs, if there are at most `MAX_PHASES`; else None.

    If the event occurs at b phases, they are 1 / b of a window apart. After b periods the phase has drifted by d
    windows, so in n periods it drifts by n d / b. The number of phases therefore stays b if n d < 1.
    """
    if 2 * event.jitter_s >= window_s:  # the jitter distributes the phases over at least half of a window
        return None
    for phases in range(1, min(MAX_PHASES, int(event.count / 2)) + 1):
        windows = phases * event.period_s / window_s
        if round(windows) and abs(windows - round(windows)) * event.count < 1:
            return phases
    return None
