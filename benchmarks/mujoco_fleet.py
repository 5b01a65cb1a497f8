"""Part of `cosim_speed`: the cost of the co-simulation in addition to the steps of MuJoCo.

One robot in fifteen is a drone, beginning with the third (number 2). Of the others, those with even numbers are
Huskies, and those with odd numbers are TurtleBots. All move. The coordinator advances them in windows of 10 ms, with
a network without packets. The peer is a loop over the same model and the same controllers, ten steps per call,
without states, commands and coordinator.
"""

import gc
import statistics
import time
from collections.abc import Mapping, Sequence
from typing import Any, Final

import mujoco

from sim_backends.cosim.agents import Agents
from sim_backends.cosim.coordinator import Coordinator
from sim_backends.cosim.policies.window_policies import SlidingWindow
from sim_backends.federates.frames import PHYSICS
from sim_backends.federates.handshake import AgentStart, Hello
from sim_backends.mujoco_physics.physics import MujocoPhysics
from sim_backends.network.packets import Arrival, Drop, Packet
from sim_backends.physics.body import Twist, Velocity
from sim_backends.world.motion import State

STEPS: Final = 10  # of MuJoCo in a window
WINDOW_S: Final = 0.01
STEP_NS: Final = 1_000_000
START_NS: Final = 1_000_000_000
"""Time at which the robots have reached constant speeds."""
BLOCK: Final = 10
"""Number of windows in a measurement."""


class NoPackets:
    """A network without packets."""

    def advance(
        self, to_ns: int, packets: Sequence[Packet], states: Mapping[str, State]
    ) -> tuple[list[Arrival], list[Drop]]:
        """Implement `NetworkFederate.advance`."""
        del to_ns, packets, states
        return [], []

    def next_event_ns(self) -> int | None:
        """Implement `NetworkFederate.next_event_ns`."""


def moving_robots(count: int) -> MujocoPhysics:
    """Return robots that have reached constant speeds, side by side on flat ground, at 1 s."""
    agents, commands = [], dict[str, Any]()
    for number in range(count):
        name, north_m = f"r{number}", 3.0 * number
        if number % 15 == 2:
            agents.append(AgentStart(name, "iris", State((0.0, north_m, 5.0)), flies=True))
            commands[name] = Velocity((1.0, 0.0, 0.0))
        elif number % 2:
            agents.append(AgentStart(name, "turtlebot3_burger", State((0.0, north_m, 0.192)), antenna_m=0.192))
            commands[name] = Twist(0.2, 0.1)
        else:
            agents.append(AgentStart(name, "husky", State((0.0, north_m, 0.39)), antenna_m=0.39))
            commands[name] = Twist(0.5, 0.1)
    physics = MujocoPhysics(Hello(PHYSICS, agents, step_ns=STEP_NS))
    physics.advance(0, commands)
    physics.advance(START_NS, {})
    return physics


def measure_mujoco(count: int, seconds: float) -> dict[str, float]:
    """Return the figures for a number of robots: medians of blocks of ten windows.

    MuJoCo alone and the co-simulation alternate, so that a drift of the machine's speed affects both equally.
    """
    uncoupled, coupled = moving_robots(count), moving_robots(count)
    model, data = uncoupled.model, uncoupled.data
    coordinator = Coordinator(Agents(coupled, {}), NoPackets(), SlidingWindow(WINDOW_S), [])
    coordinator.advance(START_NS)
    alone_s, coupled_s = [], []
    gc.collect()
    for block in range(1, round(seconds / WINDOW_S / BLOCK) + 1):
        started_s = time.process_time()
        for _ in range(BLOCK):
            uncoupled.run_controllers()
            mujoco.mj_step(model, data, nstep=STEPS)
        between_s = time.process_time()
        coordinator.advance(START_NS + block * BLOCK * STEPS * STEP_NS)
        coupled_s.append(time.process_time() - between_s)
        alone_s.append(between_s - started_s)
    spent_s, peer_s = statistics.median(coupled_s), statistics.median(alone_s)
    return {
        "real_time_factor": BLOCK * WINDOW_S / spent_s,
        "exchange_us": (spent_s - peer_s) / BLOCK * 1e6,
        "coordinator_adds_percent": 100 * (spent_s / peer_s - 1),
    }
