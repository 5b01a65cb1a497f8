"""Conformance checks of a physics federate: times, commands, motion, determinism, forks."""

import json
import math
import struct
from collections.abc import Mapping
from dataclasses import replace
from typing import Final

from sim_backends.federates.conformance.probe import (
    CheckError,
    FederateProbe,
    NotDeclaredError,
    PhysicsAnswer,
    Target,
)
from sim_backends.federates.exchanges import encode_number
from sim_backends.federates.frames import MessageKind, count_bytes
from sim_backends.federates.handshake import AgentStart, FederateCapability
from sim_backends.federates.records import TWIST, VELOCITY
from sim_backends.physics.body import Twist, Velocity
from sim_backends.world.dead_reckoning import extrapolate
from sim_backends.world.motion import State

_START_M: Final = 0.5
"""Largest distance of an agent from its requested start."""
_SAME_M: Final = 1e-6
"""Largest difference between positions that must be equal; rounding depends on the order of additions."""
_MOVED_M: Final = 0.02
"""An agent that has moved by less than this length is regarded as not moving."""
_JUMP_M: Final = 0.05
"""In a step, a body moves at most by this length plus its motion at twice its speed."""
_UNKNOWN_TYPE: Final = 32767
"""A type of command that does not exist."""
_LIMIT_STEPS: Final = 10
"""Number of steps over which positions are extrapolated."""
_COMMANDED_STEPS: Final = 1000
"""Number of steps after a command in which the motion is checked."""
_SPEED_M_S: Final = 0.3
"""Commanded speed."""


def _command(agent: AgentStart) -> Twist | Velocity:
    heading_rad = agent.start.heading_rad or 0.0
    if agent.flies:
        return Velocity((_SPEED_M_S * math.cos(heading_rad), _SPEED_M_S * math.sin(heading_rad), 0.1))
    return Twist(_SPEED_M_S)


def _commands(probe: FederateProbe) -> Mapping[str, Twist | Velocity]:
    """Return commands to all agents that the federate can command."""
    commands = {
        agent.name: _command(agent)
        for agent in probe.hello.agents
        if (VELOCITY if agent.flies else TWIST) in probe.welcome.commands
    }
    if not commands:
        raise NotDeclaredError("it supports no type of command for these agents")
    return commands


def _check_same(first: Mapping[str, State], second: Mapping[str, State], description: str) -> None:
    for name in first:
        distance_m = math.dist(first[name].position_m, second[name].position_m)
        if distance_m > _SAME_M:
            raise CheckError(f"{description}: the positions of {name} differ by {distance_m:.3g} m")


def _check_time(probe: FederateProbe, to_ns: int, answer: PhysicsAnswer) -> None:
    step_ns = probe.welcome.step_ns
    expected_ns = to_ns - to_ns % step_ns
    if answer.at_ns != expected_ns:
        raise CheckError(
            f"it was requested to advance to {to_ns} ns, but returned the states at {answer.at_ns} ns instead of "
            f"{expected_ns} ns, the time of its last step of {step_ns} ns"
        )


def check_start(target: Target) -> None:
    """At time 0 each agent has a state near its requested start."""
    probe = target.open()
    answer = probe.advance_physics(0)
    _check_time(probe, 0, answer)
    for agent in target.hello.agents:
        if agent.name not in answer.states:  # the agent is absent; the probe checks that the federate declares this
            continue
        distance_m = math.dist(answer.states[agent.name].position_m, agent.start.position_m)
        if distance_m > _START_M:
            raise CheckError(f"{agent.name} starts {distance_m:.3g} m away from its requested start")


def check_remainders(target: Target) -> None:
    """In windows of 1.1 steps, the states are always the states at the last complete step."""
    probe = target.open()
    step_ns = probe.welcome.step_ns
    window_ns = step_ns + max(step_ns // 10, 1)
    for window in range(200):
        to_ns = window * window_ns
        _check_time(probe, to_ns, probe.advance_physics(to_ns))


def check_drift(target: Target) -> None:
    """Many windows of 1.1 steps give the same motion as one window; --windows sets their number."""
    probe = target.open()
    step_ns = probe.welcome.step_ns
    window_ns = step_ns + max(step_ns // 10, 1)
    commands = _commands(probe)
    answer = probe.advance_physics(0)
    for window in range(1, target.windows + 1):
        to_ns = window * window_ns
        answer = probe.advance_physics(to_ns, commands if window == 1 else None)
        _check_time(probe, to_ns, answer)
    if not probe.has(FederateCapability.DETERMINISTIC):
        raise NotDeclaredError("it does not declare DETERMINISTIC; only the times were compared")
    single_window_probe = target.open()
    single_window_probe.advance_physics(0)
    single_window_answer = single_window_probe.advance_physics(target.windows * window_ns, commands)
    _check_same(answer.states, single_window_answer.states, f"{target.windows} windows instead of one")


def check_repeated_time(target: Target) -> None:
    """A second request for the same time returns the same states."""
    probe = target.open()
    probe.advance_physics(0)
    to_ns = 20 * probe.welcome.step_ns
    first = probe.advance_physics(to_ns, _commands(probe))
    second = probe.advance_physics(to_ns)
    if first.states != second.states:
        raise CheckError(f"a second request for {to_ns} ns gave other states")


def check_motion(target: Target) -> None:
    """Commanded agents move, without jumps, and continue without a new command."""
    probe = target.open()
    before = start = probe.advance_physics(0).states
    step_ns, commands = probe.welcome.step_ns, _commands(probe)
    for step in range(1, _COMMANDED_STEPS + 1):
        answer = probe.advance_physics(step * step_ns, commands if step == 1 else None)
        for name, state in answer.states.items():
            moved_m = math.dist(state.position_m, before[name].position_m)
            speed_m_s = max(math.hypot(*state.velocity_m_s), math.hypot(*before[name].velocity_m_s))
            if moved_m > _JUMP_M + 2 * speed_m_s * step_ns / 1e9:
                raise CheckError(f"{name} moved by {moved_m:.3g} m in a step, at a speed of {speed_m_s:.3g} m/s")
        before = answer.states
    for name in commands:
        moved_m = math.dist(before[name].position_m, start[name].position_m)
        if moved_m < min(_MOVED_M, 0.1 * _SPEED_M_S * _COMMANDED_STEPS * step_ns / 1e9):
            raise CheckError(f"{name} moved by {moved_m:.3g} m in {_COMMANDED_STEPS} steps under {commands[name]}")


def check_limits(target: Target) -> None:
    """A position that is extrapolated for a time t has an error of at most a t^2 / 2; a is the returned limit."""
    probe = target.open()
    before = probe.advance_physics(0)
    step_ns, commands = probe.welcome.step_ns, _commands(probe)
    window_s = _LIMIT_STEPS * step_ns / 1e9
    # A simulator may move a body in each step at the velocity at the end of the step (semi-implicit Euler). Its error
    # is larger by a t h, where h is the step.
    per_limit_s2 = window_s**2 / 2 + window_s * step_ns / 1e9
    for window in range(1, 40):
        answer = probe.advance_physics(window * _LIMIT_STEPS * step_ns, commands if window == 1 else None)
        for name, state in before.states.items():
            expected = extrapolate(state, window_s).position_m
            error_m = math.dist(answer.states[name].position_m, expected)
            if error_m > before.limits_m_s2[name] * per_limit_s2 + _SAME_M:
                raise CheckError(
                    f"{name} was {error_m:.3g} m away from its extrapolated position after {window_s:g} s; its limit "
                    f"of {before.limits_m_s2[name]:.3g} m/s^2 allows {before.limits_m_s2[name] * per_limit_s2:.3g} m"
                )
        before = answer


def check_command_time(target: Target) -> None:
    """A command applies from `from_ns`, even if no earlier request advanced the federate to this time."""
    exact_probe = target.open()
    exact_probe.require(FederateCapability.DETERMINISTIC)
    step_ns, commands = exact_probe.welcome.step_ns, _commands(exact_probe)
    middle_ns, end_ns = 100 * step_ns, 300 * step_ns
    exact_probe.advance_physics(0)
    exact_probe.advance_physics(middle_ns)
    expected = exact_probe.advance_physics(end_ns, commands)
    late_probe = target.open()
    late_probe.advance_physics(0)
    _check_same(
        expected.states,
        late_probe.advance_physics(end_ns, commands, from_ns=middle_ns).states,
        f"a command that applies from {middle_ns} ns",
    )


def check_unknown_command(target: Target) -> None:
    """A command of an unknown type is refused with an error."""
    probe = target.open()
    probe.advance_physics(0)
    command = struct.pack("<IHH8x", 0, _UNKNOWN_TYPE, 8)
    body = encode_number(probe.welcome.step_ns) + encode_number(0) + count_bytes(1) + command
    probe.expect_error(MessageKind.ADVANCE_PHYSICS, body, MessageKind.STATES, "a command of an unknown type")


def check_determinism(target: Target) -> None:
    """Equal requests give identical answers, if the federate declares this."""
    answers = []
    for _ in range(2):
        probe = target.open()
        probe.require(FederateCapability.DETERMINISTIC)
        window_ns, commands = 7 * probe.welcome.step_ns, _commands(probe)
        answers.append(
            [
                probe.advance_physics(number * window_ns, commands if number == 3 else None).body
                for number in range(100)
            ]
        )
    for number, (first, second) in enumerate(zip(*answers, strict=True)):
        if first != second:
            raise CheckError(f"equal requests up to {number * window_ns} ns gave different answers")


def check_lifetimes(target: Target) -> None:
    """An agent has states only from its appearance until its disappearance, if the federate removes agents."""
    appears_steps, disappears_steps = 100, 300
    name = target.hello.agents[0].name
    step_ns = target.hello.step_ns
    configuration = json.loads(target.hello.configuration)
    plans = configuration.setdefault("scenario", {}).setdefault("agents", {})
    plans[name] = plans.get(name, {}) | {
        "appears": f"{appears_steps * step_ns / 1e9:.9f}s",
        "disappears": f"{disappears_steps * step_ns / 1e9:.9f}s",
    }
    probe = target.open(replace(target.hello, configuration=json.dumps(configuration).encode()))
    probe.require(FederateCapability.AGENTS_DISAPPEAR)
    if probe.welcome.step_ns != step_ns:
        raise NotDeclaredError(f"its step of {probe.welcome.step_ns} ns differs from the scenario's step")
    if name in probe.advance_physics(0).states:
        raise NotDeclaredError("it moves agents before they appear, and the coordinator ignores their states")
    for step in (appears_steps - 1, appears_steps, disappears_steps - 1, disappears_steps, 2 * disappears_steps):
        states = probe.advance_physics(step * step_ns).states
        if (name in states) != (appears_steps <= step < disappears_steps):
            raise CheckError(
                f"{name}, which appears at {appears_steps * step_ns} ns and disappears at "
                f"{disappears_steps * step_ns} ns, has {'a' if name in states else 'no'} state at {step * step_ns} ns"
            )
        for agent in target.hello.agents[1:]:
            if agent.name not in states:
                raise CheckError(f"{agent.name}, which is always present, has no state at {step * step_ns} ns")
        if step == appears_steps:
            distance_m = math.dist(states[name].position_m, target.hello.agents[0].start.position_m)
            if distance_m > _START_M:
                raise CheckError(f"{name} appears {distance_m:.3g} m away from its requested start")


def check_fork(target: Target) -> None:
    """A copy continues like the original, and neither changes the other."""
    probe = target.open()
    probe.require(FederateCapability.FORK)
    step_ns, commands = probe.welcome.step_ns, _commands(probe)
    probe.advance_physics(0)
    middle_ns, end_ns = 100 * step_ns, 400 * step_ns
    answer_at_fork = probe.advance_physics(middle_ns, commands)
    probe.fork(1)
    copy_answer = probe.advance_physics(end_ns, from_ns=middle_ns, copy=1)
    repeated_answer = probe.advance_physics(middle_ns, from_ns=middle_ns)
    _check_same(answer_at_fork.states, repeated_answer.states, "the original, after its copy has advanced")
    _check_same(
        copy_answer.states, probe.advance_physics(end_ns, from_ns=middle_ns).states, "the original and its copy"
    )
