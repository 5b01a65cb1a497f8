"""Periods of a scenario that share a beat with windows, so that a run sees few phases of a window, or one.

What a method does wrong to a packet depends on when in a window it is sent. If b periods are a whole number of
windows, packets meet b phases only, the same ones in every window, and an error is that of these phases, not of the
method.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Final

from sim_backends.cosim.programs.beats import PERIOD_NS
from sim_backends.cosim.scenario.motions import FollowPlan
from sim_backends.cosim.scenario.schema import CosimScenario
from sim_backends.cosim.scenario.traffic import BagTraffic

MOST_PHASES: Final = 10
"""As many evenly spread phases have a mean that is off by a twentieth of a window at most."""
_STEPS_OFF: Final = 100


@dataclass(frozen=True)
class PeriodicEvent:
    """Something periodic.

    Attributes:
        name: What it is.
        period_s: Its period.
        count: How often it happens in a run.
        jitter_s: By how much it varies.
    """

    name: str
    period_s: float
    count: float
    jitter_s: float = 0.0


@dataclass(frozen=True)
class SharedBeat:
    """A beat that meets few phases of a window.

    Attributes:
        beat: The beat.
        window_s: The window.
        phases: How many it meets.
    """

    beat: PeriodicEvent
    window_s: float
    phases: int


def beats(scenario: CosimScenario) -> Iterator[PeriodicEvent]:
    """Yield what is periodic in a scenario and whose phase counts: traffic, and who steers by what it hears."""
    for one in scenario.traffic:
        if one.period_s:
            jitter_s = one.jitter if isinstance(one, BagTraffic) else 0.0
            flows = len(one.flow_ends)
            yield PeriodicEvent(one.title, one.period_s, one.packets(scenario.duration) / flows, jitter_s)
    if any(isinstance(plan.motion, FollowPlan) for plan in scenario.agents.values()):
        period_s = PERIOD_NS / 1e9
        yield PeriodicEvent("the followers' controllers", period_s, scenario.duration / period_s)


def shared_beats(scenario: CosimScenario, windows_s: Sequence[float]) -> list[SharedBeat]:
    """Return the beats that meet few phases of a window in a run of a scenario."""
    return [
        SharedBeat(beat, window_s, phases)
        for window_s in windows_s
        for beat in beats(scenario)
        if (phases := _phases(beat, window_s)) is not None
    ]


def other_window_s(scenario: CosimScenario, window_s: float) -> float | None:
    """Return the nearest window of whole steps that shares no beat with a scenario; None from half of it to twice."""
    step_s = scenario.physics.step
    steps = round(window_s / step_s)
    near = sorted(range(max(steps // 2, 1), min(2 * steps, steps + _STEPS_OFF) + 1), key=lambda one: abs(one - steps))
    return next((one * step_s for one in near if not shared_beats(scenario, [one * step_s])), None)


def _phases(beat: PeriodicEvent, window_s: float) -> int | None:
    """Return how many phases of a window a beat meets; None for enough.

    After b periods it is d windows off the phase that it had; in n periods that moves it by n d / b, and phases are
    1 / b apart: they stay as few if n d < 1.
    """
    if 2 * beat.jitter_s >= window_s:
        return None
    for phases in range(1, min(MOST_PHASES, int(beat.count / 2)) + 1):
        windows = phases * beat.period_s / window_s
        if round(windows) and abs(windows - round(windows)) * beat.count < 1:
            return phases
    return None
