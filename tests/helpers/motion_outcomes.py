"""Outcome of a trial of the fault matrix, and what of it contradicts the expectation of its cell."""

import json
from dataclasses import asdict, dataclass
from typing import Self

from tests.helpers.motion_cells import ALARM_S, FENCE_M, Expectation, MotionCell, expected


@dataclass(frozen=True)
class MotionOutcome:
    """What was observed of a trial of a cell.

    Attributes:
        cell: Name of the cell.
        seed: Seed of the moment of the fault.
        begins_s: Time from the fault to a stationary ground robot, or to a drone that descends; None for never.
        ends_s: Time from the fault to a drone on the ground; None for never.
        again_m: How far the robot went after it had stopped or landed.
        farthest_m: Farthest distance from its place at the start, over the ground.
        disarmed: Whether the motors of a drone were stopped at the end; None of a ground robot.
        attempts: How often the robot was set in motion.
        code: Exit code of fieldkit; None where it was killed, or did not end.
        alarm_s: Time from the fault to an alarm of fieldkit in capitals; None where there was none.
        programs_s: Time from the fault until no program of fieldkit ran on the robot; None where not observed.
        link_lost: Whether the programs on a drone lost their link to its autopilot after the fault; None of a fault
            that leaves it.
        message: The last line that fieldkit printed.
        problems: What contradicts the expectation of the cell.
        load: Load average of the machine over a minute.
        took_s: How long the trial took, with all that was put back.
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
    message: str = ""
    problems: tuple[str, ...] = ()
    load: float = 0.0
    took_s: float = 0.0

    def line(self) -> str:
        """Return it as a line of JSON."""
        return json.dumps(asdict(self))

    @classmethod
    def of(cls, line: str) -> Self:
        """Return what `line` returned."""
        values = json.loads(line)
        return cls(**values | {"problems": tuple(values["problems"])})


def problems(cell: MotionCell, seen: MotionOutcome) -> list[str]:
    """Return what of an outcome contradicts the expectation of its cell."""
    wants, found = expected(cell), []
    if seen.farthest_m > FENCE_M[cell.craft] + 1.0:
        found.append(f"{seen.farthest_m:.1f} m from its start, beyond its fence of {FENCE_M[cell.craft]:g} m")
    if cell.cuts_link and not seen.link_lost:
        found.append("the link to the autopilot was not lost: the fault had no effect")
    if not wants.judged:
        return [*found, *_alarms(wants, seen), *_programs(wants, seen)]
    for name, bound_s, value_s in (
        ("descends" if cell.craft.flies else "stops", wants.begins_s, seen.begins_s),
        ("on the ground", wants.ends_s, seen.ends_s),
    ):
        if bound_s is not None and value_s is None:
            found.append(f"{name}: never, bound {bound_s:.1f} s")
        elif bound_s is not None and value_s is not None and value_s > bound_s:
            found.append(f"{name} after {value_s:.1f} s, bound {bound_s:.1f} s")
    if wants.begins_s is not None and seen.again_m > 0:
        found.append(f"moves again, by {seen.again_m:.2f} m")
    if wants.begins_s is not None and seen.attempts > 1:
        found.append(f"set in motion {seen.attempts} times")
    if seen.disarmed is False:
        found.append("still armed")
    return [*found, *_alarms(wants, seen)]


def _programs(wants: Expectation, seen: MotionOutcome) -> list[str]:
    """Return what is wrong with the end of the programs on the robot."""
    if wants.programs_s is None or seen.programs_s is not None:
        return []
    return [f"programs still run after {wants.programs_s:.1f} s"]


def _alarms(wants: Expectation, seen: MotionOutcome) -> list[str]:
    """Return what is wrong with the alarm, where the drone may be in the air and fieldkit can know."""
    bound_s = wants.alarm_s
    if bound_s is None and wants.alarm and not seen.disarmed:
        bound_s = ALARM_S
    if bound_s is None:
        return []
    if seen.alarm_s is None:
        return ["no alarm in capitals"]
    return [f"alarm after {seen.alarm_s:.1f} s, bound {bound_s:.1f} s"] if seen.alarm_s > bound_s else []
