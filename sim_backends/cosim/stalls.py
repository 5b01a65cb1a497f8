"""`stalled_federate` as a fault: a party that answers late, in wall time, once, at a simulated time."""

import time
from collections.abc import Mapping, Sequence
from typing import Any

from sim_backends.cosim.federates import Action, NetworkFederate, PhysicsFederate, Program
from sim_backends.cosim.wall_time import Waits
from sim_backends.network.packets import Arrival, Drop, Packet, Received
from sim_backends.world.motion import State


class Stall:
    """Keeps whoever asks waiting, once.

    Args:
        at_ns: From which simulated time on: the first question about it, or about later, waits.
        wall_s: For how long, in seconds of wall time.

    Attributes:
        waited_s: For how long somebody has waited.
    """

    def __init__(self, at_ns: int, wall_s: float) -> None:
        self._at_ns = at_ns
        self._wall_s = wall_s
        self._over = False
        self.waited_s = 0.0

    def wait(self, now_ns: int) -> None:
        """Wait, if it is time for it."""
        if self._over or now_ns < self._at_ns:
            return
        self._over = True
        begun_s = time.perf_counter()
        time.sleep(self._wall_s)
        self.waited_s += time.perf_counter() - begun_s


class _Stalled:
    def __init__(self, inner: object, stall: Stall) -> None:
        self._stall = stall
        self._inner = inner if isinstance(inner, Waits) else None

    @property
    def waited_s(self) -> float:
        """See `wall_time.Waits`; what it stalls may wait, too."""
        return self._stall.waited_s + (self._inner.waited_s if self._inner else 0.0)


class StalledPhysics(_Stalled):
    """A physics that stalls.

    Args:
        physics: What it is otherwise.
        stall: When, and for how long.
    """

    def __init__(self, physics: PhysicsFederate, stall: Stall) -> None:
        super().__init__(physics, stall)
        self._physics = physics
        self.step_ns = physics.step_ns
        self.limits_m_s2 = physics.limits_m_s2

    def advance(self, to_ns: int, commands: Mapping[str, Any]) -> Mapping[str, State]:
        """See `PhysicsFederate.advance`."""
        self._stall.wait(to_ns)
        return self._physics.advance(to_ns, commands)


class StalledNetwork(_Stalled):
    """A network that stalls.

    Args:
        network: What it is otherwise.
        stall: When, and for how long.
    """

    def __init__(self, network: NetworkFederate, stall: Stall) -> None:
        super().__init__(network, stall)
        self._network = network
        self.extrapolates = getattr(network, "extrapolates", False)

    def advance(
        self, to_ns: int, packets: Sequence[Packet], states: Mapping[str, State]
    ) -> tuple[list[Arrival], list[Drop]]:
        """See `NetworkFederate.advance`."""
        self._stall.wait(to_ns)
        return self._network.advance(to_ns, packets, states)

    def next_event_ns(self) -> int | None:
        """See `NetworkFederate.next_event_ns`."""
        return self._network.next_event_ns()


class StalledProgram(_Stalled):
    """A program that stalls.

    Args:
        program: What it is otherwise.
        stall: When, and for how long.
    """

    def __init__(self, program: Program, stall: Stall) -> None:
        super().__init__(program, stall)
        self._program = program

    def next_wake_ns(self) -> int | None:
        """See `Program.next_wake_ns`."""
        return self._program.next_wake_ns()

    def wake(self, now_ns: int, own: State, received: Sequence[Received]) -> Action:
        """See `Program.wake`."""
        self._stall.wait(now_ns)
        return self._program.wake(now_ns, own, received)
