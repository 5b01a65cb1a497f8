"""The outcome of a trial of the fault matrix, and its differences from the expectation of its cell."""

import json
from dataclasses import asdict, dataclass
from typing import Self

from tests.helpers.motion_cells import (
    ALARM_S,
    DRIVE_LEASE_S,
    FENCE_M,
    FLIGHT_LEASE_S,
    OPERATOR_S,
    Expectation,
    MotionCell,
    expected,
)
from tests.helpers.motion_parties import Party


@dataclass(frozen=True)
class MotionOutcome:
    """The observations of a trial of a cell.

    Attributes:
        cell: Name of the cell.
        seed: Seed of the time of the fault.
        begins_s: Time from the fault to a stationary ground robot, or to a descending drone; None if never.
        ends_s: Time from the fault to a drone on the ground; None if never.
        again_m: Distance that the robot moved after it had stopped or landed.
        farthest_m: Largest horizontal distance from the start position.
        disarmed: True if the motors of a drone were stopped at the end; None for a ground robot.
        attempts: Number of times the robot was set in motion.
        code: Exit code of fieldkit; None if it was killed or did not exit.
        alarm_s: Time from the fault to an alarm of fieldkit in capitals; None if there was none.
        programs_s: Time from the fault until no program of fieldkit ran on the robot; None if it was not observed.
        link_lost: True if the programs on a drone lost the link to the autopilot after the fault; None for a fault
            that does not affect the link.
        scheduling_s: Time for which the command of the operator, which runs on the same machine, waited for a
            processor.
        message: The last line that fieldkit printed.
        problems: Differences from the expectation of the cell.
        load: Load average of the machine over one minute.
        took_s: Duration of the trial including the restoration of the lab.
    """

    cell: str
    seed: int
    begins_s: float | None = None
    ends_s: float | None = None
    again_m: float = 0.0
    farthest_m: float = 0.0
    disarmed: bool | None = None
    attempts: int = 1
    code: int | None = None
    alarm_s: float | None = None
    programs_s: float | None = None
    link_lost: bool | None = None
    scheduling_s: float = 0.0
    message: str = ""
    problems: tuple[str, ...] = ()
    load: float = 0.0
    took_s: float = 0.0

    def line(self) -> str:
        """The outcome as a line of JSON."""
        return json.dumps(asdict(self))

    @classmethod
    def of(cls, line: str) -> Self:
        """The outcome from the result of `line`."""
        values = json.loads(line)
        return cls(**values | {"problems": tuple(values["problems"])})


def problems(cell: MotionCell, outcome: MotionOutcome) -> list[str]:
    """The differences of an outcome from the expectation of its cell."""
    expectation, result = expected(cell), []
    if outcome.farthest_m > FENCE_M[cell.craft] + 1.0:
        result.append(f"{outcome.farthest_m:.1f} m from its start, beyond its fence of {FENCE_M[cell.craft]:g} m")
    if cell.cuts_link and not outcome.link_lost:
        result.append("the link to the autopilot was not lost: the fault had no effect")
    if not expectation.judged:
        return [*result, *_alarm_problems(expectation, outcome), *_program_problems(expectation, outcome)]
    name, scheduling_s = "descends" if cell.craft.flies else "stops", outcome.scheduling_s
    if Party.FIELDKIT in cell.parties:  # fieldkit does not renew the lease, so the robot stops without the command
        scheduling_s = min(scheduling_s, (FLIGHT_LEASE_S if cell.craft.flies else DRIVE_LEASE_S) - OPERATOR_S)
    result += _time_problems(name, expectation.begins_s, outcome.begins_s, scheduling_s)
    result += _time_problems("on the ground", expectation.ends_s, outcome.ends_s, scheduling_s)
    if expectation.begins_s is not None and outcome.again_m > 0:
        result.append(f"moves again, by {outcome.again_m:.2f} m")
    if expectation.begins_s is not None and outcome.attempts > 1:
        result.append(f"set in motion {outcome.attempts} times")
    if outcome.disarmed is False:
        result.append("still armed")
    return [*result, *_alarm_problems(expectation, outcome)]


def _time_problems(name: str, bound_s: float | None, value_s: float | None, scheduling_s: float) -> list[str]:
    """Problems with the time of an event; `bound_s` is the bound on a machine with a free processor."""
    if bound_s is None:
        return []
    if value_s is None:
        return [f"{name}: never, bound {bound_s:.1f} s"]
    if value_s <= bound_s + scheduling_s:
        return []
    scheduling_text = f" and {scheduling_s:.1f} s without a processor" if scheduling_s else ""
    return [f"{name} after {value_s:.1f} s, bound {bound_s:.1f} s{scheduling_text}"]


def _program_problems(expectation: Expectation, outcome: MotionOutcome) -> list[str]:
    """Problems with the end of the programs on the robot."""
    if expectation.programs_s is None or outcome.programs_s is not None:
        return []
    return [f"programs still run after {expectation.programs_s:.1f} s"]


def _alarm_problems(expectation: Expectation, outcome: MotionOutcome) -> list[str]:
    """Problems with the alarm, if one is expected."""
    bound_s = expectation.alarm_s
    if bound_s is None and expectation.alarm and not outcome.disarmed:
        bound_s = ALARM_S
    if bound_s is None:
        return []
    if outcome.alarm_s is None:
        return ["no alarm in capitals"]
    return [f"alarm after {outcome.alarm_s:.1f} s, bound {bound_s:.1f} s"] if outcome.alarm_s > bound_s else []
