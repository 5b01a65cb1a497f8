"""A physics federate in JSBSim: each drone is a DJI F450, a model that JSBSim contains. There are no obstacles."""

import math
import os

import jsbsim

from sim_backends.federates.answering import FederateService
from sim_backends.federates.frames import PHYSICS
from sim_backends.federates.named import PythonFederate
from sim_backends.federates.records import VELOCITY
from sim_backends.federates.simulator_options import SimulatorOptions
from sim_backends.physics.body import Velocity
from sim_backends.world.motion import GRAVITY_M_S2, State

FOOT_M = 0.3048
EAST_M, NORTH_M = 6_378_137.0, 6_335_439.0  # metres per radian of longitude and of latitude, WGS 84 at the equator
HOVER_S = 3.0  # hovering before time 0, in which the motors reach their speed
RATE_RAD_S = 0.75  # maximum turning rate that the model accepts as a command
os.environ.setdefault("JSBSIM_DEBUG", "0")  # otherwise JSBSim writes to standard output
jsbsim.set_logger(jsbsim.DefaultLogger(jsbsim.LogLevel.FATAL))


class Drone:
    """An F450, whose velocity and heading are controlled by its turning rates and its throttle."""

    def __init__(self, start, step_s):
        self.fdm, self.step_s = jsbsim.FGFDMExec(None), step_s
        self.target, self.throttle, self.heading_rad = Velocity(), 0.43, start.heading_rad or 0.0
        self.fdm.load_model("F450")
        self.fdm.set_dt(step_s)
        self.fdm["ic/h-sl-ft"] = 1000 / FOOT_M
        self.fdm["ic/psi-true-rad"] = math.pi / 2 - self.heading_rad
        self.fdm.run_ic()
        self.fdm["propulsion/set-running"] = -1  # all motors
        self.fdm["fcs/ScasEngage"] = 1
        self.offset_m = 0.0, 0.0, 0.0
        for _ in range(round(HOVER_S / step_s)):
            self.step()
        self.offset_m = tuple(to - at for to, at in zip(start.position_m, self.state().position_m, strict=True))

    def state(self):
        fdm = self.fdm
        velocity_fps = fdm["velocities/v-east-fps"], fdm["velocities/v-north-fps"], -fdm["velocities/v-down-fps"]
        east_m, north_m = EAST_M * fdm["position/long-gc-rad"], NORTH_M * fdm["position/lat-geod-rad"]
        place_m = east_m, north_m, FOOT_M * fdm["position/h-sl-ft"]
        position_m = tuple(at + offset for at, offset in zip(place_m, self.offset_m, strict=True))
        return State(position_m, tuple(FOOT_M * v for v in velocity_fps), math.pi / 2 - fdm["attitude/psi-rad"])

    def step(self):
        """Update the controls, and advance by one step."""
        fdm, (_, (v_e, v_n, v_u), heading_rad) = self.fdm, self.state()
        (to_e, to_n, to_u), cos, sin = self.target.velocity_m_s, math.cos(heading_rad), math.sin(heading_rad)
        east, north, up = limited(to_e - v_e, 2.0), limited(to_n - v_n, 2.0), limited(to_u - v_u, 1.0)
        pitch_rad = -math.atan2(east * cos + north * sin, GRAVITY_M_S2)  # positive with its nose up
        roll_rad = math.atan2(east * sin - north * cos, GRAVITY_M_S2)
        turn_rad = math.remainder(self.heading_rad - heading_rad, math.tau)
        fdm["fcs/elevator-cmd-norm"] = limited(2 * (pitch_rad - fdm["attitude/theta-rad"]) / RATE_RAD_S, 1.0)
        fdm["fcs/aileron-cmd-norm"] = limited(2 * (roll_rad - fdm["attitude/phi-rad"]) / RATE_RAD_S, 1.0)
        fdm["fcs/rudder-cmd-norm"] = limited(-turn_rad / RATE_RAD_S, 1.0)
        self.throttle = 0.5 + limited(self.throttle - 0.5 + 0.05 * up * self.step_s, 0.5)
        fdm["fcs/throttle-cmd-norm"] = self.throttle + 0.1 * up
        fdm.run()


def limited(value, limit):
    return max(-limit, min(value, limit))


class Drones:
    """A physics simulator: `advance` moves the drones, one step at a time."""

    def __init__(self, hello):
        for agent in hello.agents:
            if not agent.flies:
                raise ValueError(f"{agent.name} is a {agent.profile}, which drives; JSBSim moves only drones")
        self.step_ns, self.at_ns, self.from_ns, self.last_ns, self.commands = hello.step_ns, 0, 0, 0, {}
        self.limits_m_s2 = {agent.name: math.inf for agent in hello.agents}
        self.drones = {agent.name: Drone(agent.start, hello.step_ns / 1e9) for agent in hello.agents}

    def advance(self, to_ns, commands):
        """Return the states at the last step until `to_ns`; commands apply from the previous `to_ns` on."""
        if commands:
            self.commands, self.from_ns = self.commands | commands, self.last_ns
        self.last_ns = to_ns
        while self.at_ns + self.step_ns <= to_ns:
            for name, command in self.commands.items() if self.at_ns >= self.from_ns else ():
                drone = self.drones[name]
                drone.target = command
                drone.heading_rad = drone.heading_rad if command.yaw_rad is None else command.yaw_rad
            self.commands = {} if self.at_ns >= self.from_ns else self.commands
            for drone in self.drones.values():
                drone.step()
            self.at_ns += self.step_ns
        return {name: drone.state() for name, drone in self.drones.items()}


SERVICE = {"name": "jsbsim", "software": f"JSBSim {jsbsim.__version__}", "forks": False, "commands": (VELOCITY,)}
JSBSIM = PythonFederate(PHYSICS, lambda: FederateService(Drones, **SERVICE), "JSBSim: F450 drones", SimulatorOptions)
