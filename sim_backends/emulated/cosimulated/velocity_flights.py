"""Drones of autopilots in a physics simulator that moves drones only by velocities, such as Gazebo.

The quadrotor model of the built-in physics computes the velocity of a drone from the command of its autopilot, with
thrust, tilt, drag and gravity. The physics simulator moves the drone at this velocity, and obstacles stop it. If the
drone has moved at another velocity than commanded, it has touched something, and the model continues with the
measured velocity.
"""

from collections.abc import Mapping, Sequence
from typing import Any, Final

from sim_backends.federates.protocols import PhysicsFederate
from sim_backends.physics.body import Velocity
from sim_backends.physics.collisions import Footprint, is_supported
from sim_backends.physics.ground import Ground
from sim_backends.physics.quadrotor import FlightPose, FlightStatus, FlightTarget, Quadrotor
from sim_backends.world.motion import State
from sim_backends.world.world import World

CONTROL_NS: Final = 10_000_000
"""Maximum time between two velocities, unless the physics step is longer; the autopilot has the same step."""
_TOLERANCE_M_S: Final = 0.05
"""If a measured velocity differs by more than this from the last two commanded velocities, the drone has touched
something. Two commands are compared, because Gazebo applies a command one step after it has received it."""
_MIN_SINK_M_S: Final = 0.05
"""Support is detected only while the commanded sink rate is higher than this. The lowest sink rate of a landing is
0.1 m/s."""
_MIN_RISE_M_S: Final = 0.01
"""A supported drone that rises faster has lifted off."""
_START_GAP_M: Final = 0.02
"""A drone is supported at its start if a surface is within this distance below it."""


class VelocityFlights:
    """A physics simulator whose drones follow the commands of autopilots.

    Commands to other robots, and their states, are passed on.

    Args:
        physics: The physics simulator; it has just started, with all robots at rest.
        drones: Body of each drone, at its start.
        world: The world; None for open flat ground.

    Attributes:
        step_ns: Time step of the physics simulator.
        limits_m_s2: Acceleration limit of each robot.
    """

    def __init__(self, physics: PhysicsFederate, drones: Mapping[str, Quadrotor], world: World | None) -> None:
        self.step_ns = physics.step_ns
        self.limits_m_s2: Mapping[str, float] = physics.limits_m_s2
        self._physics = physics
        obstacles = Ground(world, None).obstacles
        self._drones = {name: _Drone(body, obstacles) for name, body in drones.items()}
        self._control_steps = max(CONTROL_NS // self.step_ns, 1)
        self._step = 0

    def advance(self, to_ns: int, commands: Mapping[str, Any]) -> Mapping[str, State]:
        """Implement `PhysicsFederate.advance`; while a drone flies, its velocity is updated every `CONTROL_NS`."""
        pending_commands = dict(commands)
        for name, drone in self._drones.items():
            if isinstance(command := pending_commands.get(name), FlightTarget):
                drone.command = command
                del pending_commands[name]
        last_step = to_ns // self.step_ns
        while True:
            step = last_step
            if any(drone.is_controlled for drone in self._drones.values()):
                step = min(step, self._step + self._control_steps)
            elapsed_s = (step - self._step) * self.step_ns / 1e9
            if elapsed_s > 0:
                pending_commands |= self._velocities(elapsed_s)
            states = self._physics.advance(to_ns if step == last_step else step * self.step_ns, pending_commands)
            pending_commands = {}
            if elapsed_s > 0:
                for name, drone in self._drones.items():
                    drone.observe(states[name], elapsed_s)
            self._step = step
            if step == last_step:
                return states

    def flight_status(self, name: str) -> FlightStatus:
        """Return the measured position of a drone, the attitude of its model, and True if it rests on something."""
        drone = self._drones[name]
        return FlightStatus(drone.pose.place_m, drone.pose.roll_rad, drone.pose.pitch_rad, drone.is_supported)

    def close(self) -> None:
        """Stop the physics simulator."""
        if close := getattr(self._physics, "close", None):
            close()

    def _velocities(self, elapsed_s: float) -> dict[str, Velocity]:
        """Return the velocity of each drone whose velocity changes, for the next interval."""
        velocities = {name: drone.next_velocity(elapsed_s) for name, drone in self._drones.items()}
        return {name: velocity for name, velocity in velocities.items() if velocity is not None}


class _Drone:
    """The model of one drone.

    Args:
        body: Its body, at its start.
        obstacles: Obstacles that may support it at its start.

    Attributes:
        command: The last command of its autopilot; None before the first one.
        pose: Its measured position, and the velocity, attitude and heading of the model. A component of the velocity
            is the measured one if the drone has touched something. The heading is measured unless a heading is
            commanded.
        is_supported: True if it rests on something.
    """

    def __init__(self, body: Quadrotor, obstacles: Sequence[Footprint]) -> None:
        self.command: FlightTarget | None = None
        self.pose = body.initial_pose()
        self.is_supported = is_supported(body, self.pose.place_m, obstacles, _START_GAP_M)
        self._body = body
        self._place_m = self.pose.place_m  # the last measured position
        self._last_velocity, self._velocity = Velocity(), Velocity()

    @property
    def is_controlled(self) -> bool:
        """True if its velocity changes with time: it flies, or falls."""
        return self.command is not None and (self.command.powered or not self.is_supported)

    def next_velocity(self, elapsed_s: float) -> Velocity | None:
        """Return the velocity for the next interval; None if it is the same as before."""
        self._last_velocity, self._velocity = self._velocity, Velocity()
        if self.command is not None and self.is_controlled:
            self.pose = self._body.course(self.pose, self.command, elapsed_s).at(1)
            turns = self.command.velocity.yaw_rad is not None
            self._velocity = Velocity(self.pose.velocity_m_s, self.pose.heading_rad if turns else None)
        else:  # the drone is at rest and level
            self.pose = FlightPose(self.pose.place_m, heading_rad=self.pose.heading_rad)
        return None if self._velocity == self._last_velocity else self._velocity

    def observe(self, state: State, elapsed_s: float) -> None:
        """Update the pose with the measured state of the antenna at the end of an interval of this length."""
        east_m, north_m, up_m = state.position_m
        before_m, self._place_m = self._place_m, (east_m, north_m, up_m - self._body.antenna_m)
        east, north, up = (
            (place - before) / elapsed_s for place, before in zip(self._place_m, before_m, strict=True)
        )
        self._update_support(up)
        commands_m_s = zip(self._last_velocity.velocity_m_s, self._velocity.velocity_m_s, strict=True)
        (east, north, up) = (
            model if _is_between(measured, commands) else measured
            for measured, model, commands in zip((east, north, up), self.pose.velocity_m_s, commands_m_s, strict=True)
        )
        heading_rad = self.pose.heading_rad
        if self._velocity.yaw_rad is None and state.heading_rad is not None:
            heading_rad = state.heading_rad
        self.pose = self.pose._replace(place_m=self._place_m, velocity_m_s=(east, north, up), heading_rad=heading_rad)

    def _update_support(self, up_m_s: float) -> None:
        """Detect support if it sinks at less than half of the commanded speed, and lift-off if it rises."""
        last_m_s, current_m_s = (velocity.velocity_m_s[2] for velocity in (self._last_velocity, self._velocity))
        slower_sink_m_s = max(last_m_s, current_m_s)
        if slower_sink_m_s < -_MIN_SINK_M_S and up_m_s > slower_sink_m_s / 2:
            self.is_supported = True
        elif current_m_s > 0 and up_m_s > _MIN_RISE_M_S:
            self.is_supported = False


def _is_between(value_m_s: float, limits_m_s: tuple[float, float]) -> bool:
    """Return True if a value is between two others in any order, within the tolerance."""
    return min(limits_m_s) - _TOLERANCE_M_S <= value_m_s <= max(limits_m_s) + _TOLERANCE_M_S
