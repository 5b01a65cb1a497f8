"""Conformance checks of the motion of a physics federate: signs, axes and units.

Agents need time to accelerate, and wheels slip. The tolerances are therefore wide: for example, a robot that drives
a third of the commanded distance passes.
"""

import json
import math
from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import Any, Final

from sim_backends.federates.conformance.probe import CheckError, FederateProbe, NotDeclaredError, Target
from sim_backends.federates.handshake import Hello
from sim_backends.federates.records import TWIST, VELOCITY
from sim_backends.physics.body import Twist, Velocity
from sim_backends.world.motion import State

_WINDOW_S: Final = 0.05
"""Window of the checks that add up a motion window by window."""
_LONG_WINDOW_S: Final = 0.25
"""Window of the checks that compare only the start and the end of a motion; long windows save time."""
_DRIVE_S: Final = 3.0
"""Time for which robots drive."""
_FLY_S: Final = 5.0
"""Time for which robots fly."""
_YAW_S: Final = 8.0
"""Longest time for a turn to another yaw."""
_SPEED_M_S: Final = 0.2
"""A speed that even small robots reach."""
_TURN_RAD_S: Final = 0.3
"""Commanded turn rate."""
_FLIGHT_M_S: Final = (0.4, 0.0, 0.2)
"""Commanded velocity of robots that fly: east, north, up."""
_HEADING_RAD: Final = 0.25
"""Largest accepted error of a heading that an agent must keep or must have reached."""
_DIRECTION_RAD: Final = 0.6
"""Largest accepted angle between heading and direction of motion; it is above 0 because wheels slip."""


def _hello_with_heading(hello: Hello, heading_rad: float) -> Hello:
    """Return a hello in which all agents start with a heading, in the configuration too."""
    agents = [replace(agent, start=agent.start._replace(heading_rad=heading_rad)) for agent in hello.agents]
    configuration = json.loads(hello.configuration)
    for plan in configuration.get("scenario", {}).get("agents", {}).values():
        plan["heading_deg"] = math.degrees(heading_rad)
    return replace(hello, agents=agents, configuration=json.dumps(configuration).encode())


def _suitable_agents(probe: FederateProbe, command: int) -> list[str]:
    """Return the names of the agents for which a type of command is suitable."""
    kind, verb = ("twist", "drives") if command == TWIST else ("velocity", "flies")
    if command not in probe.welcome.commands:
        raise NotDeclaredError(f"it does not list the command {kind}")
    names = [agent.name for agent in probe.hello.agents if agent.flies == (command == VELOCITY)]
    if not names:
        raise NotDeclaredError(f"the scenario has no agent that {verb}")
    return names


def _states_under_commands(
    probe: FederateProbe, commands: Mapping[str, Any], seconds: float, window_s: float = _LONG_WINDOW_S
) -> Iterator[Mapping[str, State]]:
    """Yield the current states, and the states at the ends of windows after the commands were sent."""
    step_ns = probe.welcome.step_ns
    window_ns = max(round(window_s * 1e9 / step_ns), 1) * step_ns
    begin_ns = probe.last_ns
    yield probe.advance_physics(begin_ns).states
    for window in range(1, math.ceil(seconds * 1e9 / window_ns) + 1):
        yield probe.advance_physics(begin_ns + window * window_ns, commands if window == 1 else None).states


def _displacement_m(before: State, after: State) -> tuple[float, float, float]:
    east_m, north_m, up_m = (
        end_m - start_m for end_m, start_m in zip(after.position_m, before.position_m, strict=True)
    )
    return east_m, north_m, up_m


def _angle_difference_rad(heading_rad: float, other_rad: float) -> float:
    return math.remainder(heading_rad - other_rad, math.tau)


def _vector_text(vector: tuple[float, ...]) -> str:
    return f"({', '.join(f'{part:.3g}' for part in vector)})"


def _check_heading(name: str, state: State, expected_rad: float, when: str) -> None:
    if state.heading_rad is not None and abs(_angle_difference_rad(state.heading_rad, expected_rad)) > _HEADING_RAD:
        raise CheckError(f"the heading of {name} is {state.heading_rad:.3g} rad {when}, not {expected_rad:.3g} rad")


def check_drive_axes(target: Target) -> None:
    """A robot that drives forward moves east at a heading of 0, and north at a heading of pi/2."""
    for heading_rad, axis in ((0.0, "east"), (math.pi / 2, "north")):
        probe = target.open(_hello_with_heading(target.hello, heading_rad))
        commands = dict.fromkeys(_suitable_agents(probe, TWIST), Twist(_SPEED_M_S))
        start, *_, last = _states_under_commands(probe, commands, _DRIVE_S)
        for name in commands:
            _check_heading(name, start[name], heading_rad, "at the start")
            moved_m = _displacement_m(start[name], last[name])
            along_m = moved_m[0] if axis == "east" else moved_m[1]
            aside_m = moved_m[1] if axis == "east" else moved_m[0]
            nominal_m = _SPEED_M_S * _DRIVE_S
            if not 0.3 * nominal_m < along_m < 1.5 * nominal_m or abs(aside_m) > 0.5 * along_m:
                raise CheckError(
                    f"{name} drove forward for {_DRIVE_S:g} s at {_SPEED_M_S:g} m/s and a heading of "
                    f"{heading_rad:.3g} rad, and moved by {_vector_text(moved_m)} m instead of {nominal_m:g} m {axis}"
                )


def check_turn(target: Target) -> None:
    """A positive turn rate increases the heading, in radians, and the robot moves in the direction of its heading."""
    probe = target.open(_hello_with_heading(target.hello, 0.0))
    commands = dict.fromkeys(_suitable_agents(probe, TWIST), Twist(_SPEED_M_S, _TURN_RAD_S))
    before, *later = _states_under_commands(probe, commands, _DRIVE_S, _WINDOW_S)
    turned_rad = dict.fromkeys(commands, 0.0)
    for states in later:
        for name in commands:
            turned_rad[name] += _angle_difference_rad(_heading_rad(states, name), _heading_rad(before, name))
        before = states
    nominal_rad = _TURN_RAD_S * _DRIVE_S
    for name in commands:
        if not 0.25 * nominal_rad < turned_rad[name] < 1.6 * nominal_rad:
            raise CheckError(
                f"{name} turned for {_DRIVE_S:g} s at {_TURN_RAD_S:g} rad/s, and its heading changed by "
                f"{turned_rad[name]:.3g} rad"
            )
        # The direction of motion in the last three windows is compared with the heading near their middle.
        moved_m = _displacement_m(later[-4][name], later[-1][name])
        heading_rad = _heading_rad(later[-2], name)
        if abs(_angle_difference_rad(math.atan2(moved_m[1], moved_m[0]), heading_rad)) > _DIRECTION_RAD:
            raise CheckError(
                f"{name} drives forward at a heading of {heading_rad:.3g} rad, and moved by {_vector_text(moved_m)} m"
            )


def _heading_rad(states: Mapping[str, State], name: str) -> float:
    heading_rad = states[name].heading_rad
    if heading_rad is None:
        raise NotDeclaredError(f"it reports no heading of {name}")
    return heading_rad


def check_velocity(target: Target) -> None:
    """Reported velocities agree with displacements."""
    probe = target.open(_hello_with_heading(target.hello, 0.5))
    commands: dict[str, Twist | Velocity] = {}
    for agent in probe.hello.agents:
        if agent.flies and VELOCITY in probe.welcome.commands:
            commands[agent.name] = Velocity(_FLIGHT_M_S)
        elif not agent.flies and TWIST in probe.welcome.commands:
            commands[agent.name] = Twist(_SPEED_M_S)
    if not commands:
        raise NotDeclaredError("it supports no type of command for these agents")
    before, *later = _states_under_commands(probe, commands, _DRIVE_S, _WINDOW_S)
    start, step_ns = before, probe.welcome.step_ns
    half_window_s = max(round(_WINDOW_S * 1e9 / step_ns), 1) * step_ns / 2e9
    expected_m = {name: [0.0, 0.0, 0.0] for name in commands}
    for states in later:
        for name in commands:
            for axis in range(3):
                speeds_m_s = before[name].velocity_m_s[axis] + states[name].velocity_m_s[axis]
                expected_m[name][axis] += half_window_s * speeds_m_s
        before = states
    for name in commands:
        moved_m = _displacement_m(start[name], before[name])
        if math.dist(expected_m[name], moved_m) > 0.05 + 0.2 * math.hypot(*moved_m):
            raise CheckError(
                f"{name} moved by {_vector_text(moved_m)} m in {_DRIVE_S:g} s, and its reported velocities give "
                f"{_vector_text(tuple(expected_m[name]))} m"
            )


def check_flight_axes(target: Target) -> None:
    """The components of a commanded velocity are east, north and up, also at a heading of pi/2."""
    heading_rad = math.pi / 2
    probe = target.open(_hello_with_heading(target.hello, heading_rad))
    commands = dict.fromkeys(_suitable_agents(probe, VELOCITY), Velocity(_FLIGHT_M_S))
    start, *_, last = _states_under_commands(probe, commands, _FLY_S)
    expected_m = tuple(_FLY_S * speed_m_s for speed_m_s in _FLIGHT_M_S)
    for name in commands:
        _check_heading(name, start[name], heading_rad, "at the start")
        moved_m = _displacement_m(start[name], last[name])
        if math.dist(moved_m, expected_m) > 0.5 * math.hypot(*expected_m):
            raise CheckError(
                f"{name} flew for {_FLY_S:g} s with the command {_vector_text(_FLIGHT_M_S)} m/s at a heading of "
                f"{heading_rad:.3g} rad, and moved by {_vector_text(moved_m)} m"
            )


def check_yaw(target: Target) -> None:
    """A robot that flies turns to the yaw of its command, and keeps its heading if the yaw is NaN."""
    probe = target.open(_hello_with_heading(target.hello, 0.5))
    yaw_rad = 1.5
    names = _suitable_agents(probe, VELOCITY)
    for states in _states_under_commands(probe, dict.fromkeys(names, Velocity(yaw_rad=yaw_rad)), _YAW_S):
        if all(
            abs(_angle_difference_rad(_heading_rad(states, name), yaw_rad)) < 0.5 * _HEADING_RAD for name in names
        ):
            break
    for name in names:
        _check_heading(name, states[name], yaw_rad, f"{_YAW_S:g} s after a command with this yaw")
    *_, last = _states_under_commands(probe, dict.fromkeys(names, Velocity((_SPEED_M_S, 0.0, 0.0))), 2.0)
    for name in names:
        _check_heading(name, last[name], yaw_rad, "2 s after a command without a yaw")
