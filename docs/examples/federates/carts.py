"""A physics federate in Python: robots that follow commands immediately, on flat ground without obstacles.

`python3 carts.py` uses standard input and output, `python3 carts.py tcp-listen:127.0.0.1:7000` listens.
"""

import math
import sys

from sim_backends.federates.serving import serve
from sim_backends.physics.body import Twist, Velocity
from sim_backends.world.motion import State


class Carts:
    """A physics simulator: `advance` moves the robots, one step at a time."""

    def __init__(self, hello):
        self.step_ns = hello.step_ns
        self.limits_m_s2 = {agent.name: math.inf for agent in hello.agents}
        self._states = {agent.name: agent.start for agent in hello.agents}
        self._commands = {agent.name: Velocity() if agent.flies else Twist() for agent in hello.agents}
        self._new, self._new_from_ns = {}, 0
        self._at_ns = self._last_ns = 0

    def advance(self, to_ns, commands):
        """Return the state of each robot at the last step that is not after `to_ns`.

        Commands apply from the `to_ns` of the previous call on.
        """
        if commands:
            self._new, self._new_from_ns = self._new | commands, self._last_ns
        self._last_ns = to_ns
        while self._at_ns + self.step_ns <= to_ns:
            if self._at_ns >= self._new_from_ns:
                self._commands, self._new = self._commands | self._new, {}
            self._states = {name: self._moved(self._commands[name], state) for name, state in self._states.items()}
            self._at_ns += self.step_ns
        return self._states

    def _moved(self, command, state):
        step_s, heading_rad = self.step_ns / 1e9, state.heading_rad
        if isinstance(command, Velocity):
            velocity_m_s = command.velocity_m_s
            heading_rad = heading_rad if command.yaw_rad is None else command.yaw_rad
        else:
            heading_rad += command.turn_rad_s * step_s
            forward_m_s = command.forward_m_s
            velocity_m_s = forward_m_s * math.cos(heading_rad), forward_m_s * math.sin(heading_rad), 0.0
        position_m = tuple(at + v * step_s for at, v in zip(state.position_m, velocity_m_s, strict=True))
        return State(position_m, velocity_m_s, heading_rad)


if __name__ == "__main__":
    serve(Carts, name="carts", address=sys.argv[1] if len(sys.argv) > 1 else None)
