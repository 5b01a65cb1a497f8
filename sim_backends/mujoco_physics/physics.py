"""The physics federate that simulates robots with MuJoCo; no other module imports MuJoCo."""

import copy
import json
import math
import re
from collections.abc import Iterator, KeysView, Mapping, Sequence
from dataclasses import replace
from typing import Any, Final, NamedTuple

import mujoco
from typing_extensions import override

from fieldkit.core.errors import ConfigurationError, did_you_mean
from fieldkit.core.model import Vector
from sim_backends.federates.answering import FederateService
from sim_backends.federates.handshake import Hello
from sim_backends.federates.protocols import FederateError, seconds_text
from sim_backends.mujoco_physics.agent_models import agent_limits, agent_model
from sim_backends.mujoco_physics.chassis import Chassis
from sim_backends.mujoco_physics.controllers import (
    TICK_NS,
    Controller,
    FlightController,
    Registers,
    WheelController,
)
from sim_backends.mujoco_physics.mjcf import SENSED_NUMBERS, RobotModel, model_xml
from sim_backends.physics.body import Twist, Velocity
from sim_backends.physics.quadrotor import FlightStatus
from sim_backends.physics.robot_limits import DriveLimits, QuadrotorLimits
from sim_backends.world.motion import Lifetime, State, TiltedState
from sim_backends.world.world import World

_LONGEST_STEP_NS: Final = 1_000_000
"""Longest step of MuJoCo; with longer steps, tires that slide sideways would hop."""


_MIN_SUPPORT_NORMAL: Final = 0.5
"""Minimum vertical component of the normal of a contact that supports a robot."""
_PARKED_M: Final = 10_000.0
"""Distance east and north at which absent agents are parked; the rounding error there is at most 1 um."""
_PARKED_APART_M: Final = 10.0
"""Distance between parked agents."""
_PARKED_UP_M: Final = 0.0
"""Height of parked agents, which are on the ground."""


class SensedStates(Mapping[str, State]):
    """The states of the present agents at a step, each created on request.

    Args:
        rows: Index of each present agent in the order of the sensors.
        numbers: The values of all sensors, `SENSED_NUMBERS` for each agent, also for absent agents.
    """

    def __init__(self, rows: Mapping[str, int], numbers: Sequence[float]) -> None:
        self._rows = rows
        self._numbers = numbers
        self._cache: dict[str, State] = {}

    def __getitem__(self, name: str) -> State:
        state = self._cache.get(name)
        if state is None:
            first = self._rows[name] * SENSED_NUMBERS
            e, n, u, v_e, v_n, v_u, x_e, x_n, x_u, _, _, y_u = self._numbers[first : first + SENSED_NUMBERS]
            level = math.hypot(x_e, x_n)
            # Rounding may give a sine above 1.
            tilt_rad = math.asin(max(-1.0, min(y_u / (level or 1.0), 1.0))), math.atan2(-x_u, level)
            heading_rad = math.atan2(x_n, x_e)
            state = self._cache[name] = TiltedState.of((e, n, u), (v_e, v_n, v_u), heading_rad, tilt_rad)
        return state

    def __deepcopy__(self, memo: dict[int, Any]) -> "SensedStates":
        return self  # it is immutable

    @override
    def keys(self) -> KeysView[str]:
        return self._rows.keys()

    def __iter__(self) -> Iterator[str]:
        return iter(self._rows)

    def __len__(self) -> int:
        return len(self._rows)


class MujocoPhysics:
    """Moves the agents of a run in MuJoCo.

    Its time is a number of steps. A command applies from the first step at or after the time of the command. The
    result does not depend on how the time is divided into calls. Absent agents are parked far away from the others.

    Args:
        hello: The run: agents, step, and configuration with `world` and `robots`, both optional.

    Attributes:
        step_ns: Time step; MuJoCo divides it if it is longer than 1 ms.
        limits_m_s2: Maximum acceleration of each agent: infinity, because a contact may change a velocity within a
            step.
        model: The model, for example for MuJoCo's viewer.
        data: The current state of the model.

    Raises:
        ConfigurationError: The step is not positive, or a robot's body is invalid.
    """

    def __init__(self, hello: Hello) -> None:
        if hello.step_ns <= 0:
            raise ConfigurationError(
                f"a step of {hello.step_ns} ns is not positive", remedy="use for example 1000000"
            )
        self.step_ns = hello.step_ns
        self.limits_m_s2: Mapping[str, float] = {agent.name: math.inf for agent in hello.agents}
        self._rows = {agent.name: row for row, agent in enumerate(hello.agents)}
        self._substeps = -(-hello.step_ns // _LONGEST_STEP_NS)  # rounded up
        self._tick_steps = max(round(TICK_NS / hello.step_ns), 1)
        configuration = json.loads(hello.configuration)
        world = World.model_validate(configuration["world"]) if "world" in configuration else None
        bodies = configuration.get("robots", {})
        limits = [agent_limits(agent, bodies.get(agent.name, {}).get("body")) for agent in hello.agents]
        self._agents, self._limits, self._world = hello.agents, limits, world
        robots = [agent_model(agent, limit, world) for agent, limit in zip(hello.agents, limits, strict=True)]
        text = model_xml(robots, world, hello.step_ns / self._substeps / 1e9)
        self.model = mujoco.MjModel.from_xml_string(text)
        self._controllers = [
            self._controller(row, robot, limit) for row, (robot, limit) in enumerate(zip(robots, limits, strict=True))
        ]
        self._stops = [Velocity() if isinstance(limit, QuadrotorLimits) else Twist() for limit in limits]
        # Rows of the agents whose controllers run at every tick, and of those whose controllers also run at the next
        # step, because of a new command or position.
        self._active = set(range(len(robots)))
        self._due: set[int] = set()
        self._last_tick_steps = [-self._tick_steps] * len(robots)
        self._use_data(mujoco.MjData(self.model))
        lifetimes = {self._rows[name]: lifetime for name, lifetime in hello.lifetimes.items() if name in self._rows}
        self._absent = {row for row, lifetime in lifetimes.items() if lifetime.appears_ns >= self.step_ns}
        self._changes = sorted(_changes(lifetimes, self.step_ns), reverse=True)
        for row in self._absent:
            self._place(row, is_parked=True)
        mujoco.mj_step1(self.model, self.data)
        self._pending_commands: dict[str, Any] = {}
        self._commands_step = 0
        self._last_to_ns = 0
        self._step = 0
        self._states = SensedStates(self._present_rows(), self._sensors.tolist())

    def advance(self, to_ns: int, commands: Mapping[str, Any]) -> Mapping[str, State]:
        """Implement `PhysicsFederate.advance`.

        Raises:
            ConfigurationError: A command is for an unknown agent, or for another kind of robot.
            FederateError: The simulation has become unstable.
        """
        if commands:
            self._pending_commands |= commands
            # The first step at or after the time of the commands; the two minus signs round up.
            self._commands_step = -(-self._last_to_ns // self.step_ns)
        self._last_to_ns = to_ns
        step = to_ns // self.step_ns
        if self._pending_commands and self._commands_step <= step:
            self._advance_steps(self._commands_step)
            self._apply_commands()
        if step != self._step:
            self._advance_steps(step)
        return self._states

    def _present_rows(self) -> Mapping[str, int]:
        """Return the row of each agent that is present, by its name."""
        if not self._absent:
            return self._rows
        return {name: row for name, row in self._rows.items() if row not in self._absent}

    def _place(self, row: int, *, is_parked: bool) -> None:
        """Place an agent at its start, or far away on flat ground, at rest."""
        first = int(self.model.jnt_qposadr[self.model.body(f"a{row}").jntadr[0]])
        pose = self.model.qpos0[first : first + 7].copy()
        if is_parked:
            pose[:3] = (_PARKED_M + _PARKED_APART_M * row, _PARKED_M, _PARKED_UP_M)
        self._set_pose(row, pose)

    def _set_pose(self, row: int, pose: Sequence[float]) -> None:
        """Set position and quaternion of an agent, and stop it."""
        model, data = self.model, self.data
        body = model.body(f"a{row}")
        first = int(model.jnt_qposadr[body.jntadr[0]])
        data.qpos[first : first + 7] = pose
        data.qvel[model.body_rootid[model.dof_bodyid] == body.id] = 0.0

    def _change_presence(self) -> None:
        """Place the agents that appear at the current step, and park those that disappear."""
        while self._changes and self._changes[-1].step <= self._step:
            _, row, appears = self._changes.pop()
            self._place(row, is_parked=not appears)
            if appears:
                self._absent.discard(row)
                continue
            self._absent.add(row)
            self._controllers[row].command(self._stops[row])
            self._active.add(row)
            self._due.add(row)
        mujoco.mj_step1(self.model, self.data)

    def put(self, name: str, place_m: Vector, heading_rad: float) -> None:
        """Put an agent at a position, at rest and without a command. Overlaps with other bodies are not checked.

        Args:
            name: The agent.
            place_m: Position of its lowest point, metres east, north, up.
            heading_rad: Its heading, from east towards north.
        """
        row, model, data = self._rows[name], self.model, self.data
        agent = self._agents[row]
        e, n, u = place_m
        start = State((e, n, u + agent.antenna_m), heading_rad=heading_rad)
        robot = agent_model(replace(agent, start=start), self._limits[row], self._world)
        self._set_pose(row, (*robot.place_m, *robot.quaternion))
        self._pending_commands.pop(name, None)
        self._controllers[row] = self._controller(row, robot, self._limits[row])
        if isinstance(robot.body, Chassis):
            motor = model.actuator(f"a{row}l0").id
            data.ctrl[motor : motor + 2 * len(robot.body.wheels.axles_m)] = 0.0
        self._active.add(row)
        self._due.add(row)
        mujoco.mj_step1(model, data)
        self._states = SensedStates(self._present_rows(), self._sensors.tolist())

    def flight_status(self, name: str) -> FlightStatus:
        """Return attitude and support of a quadrotor."""
        model, data = self.model, self.data
        body = model.body(f"a{self._rows[name]}")
        first = int(model.jnt_qposadr[body.jntadr[0]])
        x_e, _, z_e, x_n, _, z_n, _, _, z_u = self._registers.xmat[9 * body.id : 9 * body.id + 9]
        e, n, u = data.qpos[first : first + 3].tolist()
        heading = math.hypot(x_e, x_n) or 1.0
        cos, sin = x_e / heading, x_n / heading
        return FlightStatus(
            (e, n, u),
            math.asin(max(-1.0, min(z_e * sin - z_n * cos, 1.0))),
            math.atan2(z_e * cos + z_n * sin, z_u),
            self._is_supported(int(body.geomadr[0])),
        )

    def _is_supported(self, shape: int) -> bool:
        """Return True if a contact of a shape pushes it up."""
        contacts = self.data.contact
        for (first, second), frame in zip(contacts.geom.tolist(), contacts.frame.tolist(), strict=True):
            # The normal is the first axis of the frame, and points from the first shape to the second.
            if (second == shape and frame[2] > _MIN_SUPPORT_NORMAL) or (
                first == shape and frame[2] < -_MIN_SUPPORT_NORMAL
            ):
                return True
        return False

    def run_controllers(self) -> None:
        """Run the controllers that are due at the current step; they set their motors."""
        step = self._step
        rows = self._due if step % self._tick_steps else self._active
        if not rows:
            return
        self._due = set()
        for row in tuple(rows):
            elapsed_steps = min(step - self._last_tick_steps[row], self._tick_steps)
            self._last_tick_steps[row] = step
            if not self._controllers[row].tick(self._registers, elapsed_steps * self.step_ns / 1e9):
                self._active.discard(row)

    def __deepcopy__(self, memo: dict[int, Any]) -> "MujocoPhysics":
        other = object.__new__(type(self))
        memo[id(self)] = other
        members = {name: value for name, value in vars(self).items() if name not in _MUJOCO_MEMBERS}
        vars(other).update(copy.deepcopy(members, memo), model=self.model)
        data = mujoco.MjData(self.model)
        mujoco.mj_copyData(data, self.model, self.data)
        other._use_data(data)
        return other

    def _use_data(self, data: Any) -> None:  # noqa: ANN401 (MuJoCo has no type annotations)
        """Set the simulation's state, and create views of its arrays; reading its attributes each time is slow."""
        self.data = data
        self._sensors = memoryview(data.sensordata)
        arrays = data.ctrl, data.qvel, data.xmat, data.xquat, data.mocap_quat, data.xfrc_applied
        views: list[Any] = [memoryview(array.reshape(-1)) for array in arrays]
        self._registers = Registers(*views)

    def _controller(self, row: int, robot: RobotModel, limits: DriveLimits | QuadrotorLimits) -> Controller:
        """Return a new controller of a robot, which has no command yet."""
        model = self.model
        if isinstance(limits, DriveLimits):
            assert isinstance(robot.body, Chassis)
            first = model.actuator(f"a{row}l0").id
            count = 2 * len(robot.body.wheels.axles_m)
            return WheelController(limits, robot.body.wheels, range(first, first + count))
        body, target = model.body(f"a{row}"), model.body(f"a{row}t")
        velocity = int(model.jnt_dofadr[body.jntadr[0]])
        return FlightController(limits, body.id, int(target.mocapid[0]), velocity, model.actuator(f"a{row}").id)

    def _apply_commands(self) -> None:
        """Pass the pending commands to the controllers; commands to absent agents are ignored."""
        commands, self._pending_commands = self._pending_commands, {}
        for name, command in commands.items():
            if name not in self._rows:
                remedy = did_you_mean(name, self._rows, f"agents: {', '.join(self._rows)}")
                raise ConfigurationError(f"a command is for {name}, which is not an agent", remedy=remedy)
            row = self._rows[name]
            if row in self._absent:
                continue
            self._controllers[row].command(command)
            self._active.add(row)
            self._due.add(row)

    def _advance_steps(self, step: int) -> None:
        """Advance to a step; controllers run at multiples of their period, and when they receive a command."""
        if self._step >= step:
            return
        while self._step < step:
            self.run_controllers()
            next_step = min(step, self._changes[-1].step) if self._changes else step
            if self._active:
                next_step = min(next_step, (self._step // self._tick_steps + 1) * self._tick_steps)
            self._integrate((next_step - self._step) * self._substeps)
            self._step = next_step
            if self._changes and self._changes[-1].step <= next_step:
                self._change_presence()
        numbers = self._sensors.tolist()
        if _WARNINGS or not math.isfinite(sum(numbers)):
            self._raise_unstable(numbers)
        self._states = SensedStates(self._present_rows(), numbers)

    def _integrate(self, count: int) -> None:
        """Make `count` steps of MuJoCo, and compute the derived quantities of the new state."""
        model, data = self.model, self.data
        mujoco.mj_step2(model, data)
        if count > 1:
            mujoco.mj_step(model, data, nstep=count - 1)
        mujoco.mj_step1(model, data)

    def _raise_unstable(self, numbers: Sequence[float]) -> None:
        """Raise the error for an unstable simulation, with the time and the agent."""
        text = _WARNINGS[0] if _WARNINGS else "a state is not finite"
        _WARNINGS.clear()
        name = next(
            (
                name
                for name, row in self._rows.items()
                if not math.isfinite(sum(numbers[SENSED_NUMBERS * row :][:SENSED_NUMBERS]))
            ),
            "",
        )
        if joint := re.search(r"DOF (\d+)", text):
            root = self.model.body_rootid[self.model.dof_bodyid[int(joint.group(1))]]
            name = next(name for name, row in self._rows.items() if self.model.body(f"a{row}").id == root)
        raise FederateError(
            f"mujoco became unstable before {seconds_text(self._step * self.step_ns)} "
            f"({f'first agent: {name}' if name else 'agent unknown'}): {' '.join(text.split())}",
            remedy="start robots apart from each other and from obstacles, or use a shorter step",
        )


class _PresenceChange(NamedTuple):
    """The step at which an agent appears or disappears."""

    step: int
    row: int
    appears: bool


def _changes(lifetimes: Mapping[int, Lifetime], step_ns: int) -> Iterator[_PresenceChange]:
    """Yield the changes after step 0; an agent is present at least during its lifetime."""
    for row, lifetime in lifetimes.items():
        if lifetime.appears_ns >= step_ns:
            yield _PresenceChange(lifetime.appears_ns // step_ns, row, appears=True)
        if lifetime.disappears_ns is not None:
            last_step = -(-lifetime.disappears_ns // step_ns)  # rounded up
            yield _PresenceChange(last_step, row, appears=False)


_MUJOCO_MEMBERS: Final = {"model", "data", "_sensors", "_registers"}
"""Members that `__deepcopy__` does not copy: copies share the model, and have new data and new views of it."""

_WARNINGS: Final[list[str]] = []
"""Warnings of MuJoCo, which it would otherwise write to `MUJOCO_LOG.TXT` in the current folder."""
mujoco.set_mju_user_warning(_WARNINGS.append)

SERVICE: Final = FederateService(
    MujocoPhysics, name="mujoco", software=f"MuJoCo {mujoco.__version__}", agents_disappear=True
)
