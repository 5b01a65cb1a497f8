"""The physics federate `emane`, which reads agent locations and path losses from EMANE events, in real time."""

import math
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from typing import Any, Final

from sim_backends.emane_events.channel import EventListener
from sim_backends.emane_events.events import (
    ALL_NEMS,
    LOCATION,
    PATHLOSS,
    NemLocation,
    NemPathloss,
    SerializedEvent,
    decode_locations,
    decode_pathlosses,
)
from sim_backends.emane_events.geodesy import LocalFrame, velocity_m_s
from sim_backends.emane_events.options import EmaneOptions
from sim_backends.emane_events.protobuf import MalformedEventError
from sim_backends.federates.answering import FederateService
from sim_backends.federates.frames import PHYSICS
from sim_backends.federates.handshake import Hello
from sim_backends.federates.named import PythonFederate
from sim_backends.federates.protocols import FederateError, UnansweredError
from sim_backends.world.motion import STILL, State


class EmaneLocations:
    """A physics federate that places each agent at the position of the last location event for its NEM.

    A NEM (network emulation module) is a radio interface in EMANE; the option `nems` assigns one to each agent.

    The first request waits until each agent has a location. From then on, simulated time passes as fast as wall
    time. The motion of the scenario's agents is not
    simulated.

    Args:
        hello: First message of the run; its configuration contains the options of `EmaneOptions`.

    Attributes:
        step_ns: The time step that the first message requests.
        limits_m_s2: Acceleration limit of each agent: infinite, because events may contain any location.
        waited_s: Total time that it has waited, in seconds of wall time.
        path_losses_db: Path loss by transmitter and receiver. As in EMANE's receivers, this is the forward loss in
            the events for the receiver's NEM, which is the path loss from the other NEM to this NEM. The reverse loss
            is ignored.

    Raises:
        ValueError: An option is invalid.
        ConfigurationError: The channel cannot be used.
    """

    def __init__(self, hello: Hello) -> None:
        self._options = EmaneOptions.of_run(hello)
        nems = self._options.nems_of(agent.name for agent in hello.agents)
        self._agents = {nem: name for name, nem in nems.items()}
        self._frame = LocalFrame(self._options.reference)
        self._listener = EventListener(self._options.channel, self._options.device)
        self._states: dict[str, State] = {}
        self._started_s: float | None = None
        self.step_ns = hello.step_ns
        self.limits_m_s2 = {agent.name: math.inf for agent in hello.agents}
        self.waited_s = 0.0
        self.path_losses_db: dict[tuple[str, str], float] = {}

    def __deepcopy__(self, memo: dict[int, Any]) -> "EmaneLocations":
        raise FederateError("the emane physics federate cannot be copied, because it follows events in real time")

    def advance(self, to_ns: int, commands: Mapping[str, Any]) -> Mapping[str, State]:
        """Implement `PhysicsFederate.advance`: wait until this time, and return the last locations.

        Raises:
            FederateError: An agent has a command.
            UnansweredError: No location of an agent has arrived in time.
        """
        if commands:
            raise FederateError(
                f"the emane physics federate does not move robots, but there is a command for {', '.join(commands)}",
                remedy="remove the motion of the agents from the scenario",
            )
        start_s = time.monotonic()
        if self._started_s is None:
            self._wait_for_all(start_s + self._options.wait)
            self._started_s = time.monotonic()
        while (events := self._listener.receive(self._started_s + to_ns / 1e9)) is not None:
            self._apply(events)
        self.waited_s += time.monotonic() - start_s
        return dict(self._states)

    def close(self) -> None:
        """Close the channel."""
        self._listener.close()

    def _wait_for_all(self, deadline_s: float) -> None:
        """Wait until a location of each agent has arrived, at most until `deadline_s`, a time of `time.monotonic`."""
        while len(self._states) < len(self._agents):
            events = self._listener.receive(deadline_s)
            if events is None:
                missing = ", ".join(
                    f"{name} (NEM {nem})" for nem, name in self._agents.items() if name not in self._states
                )
                raise UnansweredError(
                    f"emane physics federate: no location of {missing} has arrived on {self._options.channel} within "
                    f"{self._options.wait:g} s",
                    remedy="start the publisher of the events, or set channel, device or nems",
                )
            self._apply(events)

    def _apply(self, events: Sequence[SerializedEvent]) -> None:
        """Store the locations and path losses in events; malformed events are ignored."""
        for event in events:
            with suppress(MalformedEventError):
                if event.event == LOCATION:
                    self._apply_locations(decode_locations(event.content))
                elif event.event == PATHLOSS and self._options.pathloss:
                    self._apply_losses(event.nem, decode_pathlosses(event.content))

    def _apply_locations(self, locations: Sequence[NemLocation]) -> None:
        for location in locations:
            if (name := self._agents.get(location.nem)) is not None:
                geodetic_position = (location.latitude_deg, location.longitude_deg, location.altitude_m)
                velocity = STILL if location.velocity is None else velocity_m_s(location.velocity)
                self._states[name] = State(self._frame.position_m(geodetic_position), velocity)

    def _apply_losses(self, nem: int, losses: Sequence[NemPathloss]) -> None:
        """Store the path losses in an event that the NEM `nem` receives."""
        receivers = self._agents.values() if nem == ALL_NEMS else filter(None, [self._agents.get(nem)])
        for receiver in receivers:
            for loss in losses:
                transmitter = self._agents.get(loss.nem, receiver)
                if transmitter != receiver and math.isfinite(loss.forward_db):
                    self.path_losses_db[transmitter, receiver] = loss.forward_db


def _load() -> FederateService:
    return FederateService(
        EmaneLocations,
        name="emane",
        software="EMANE events",
        is_deterministic=False,
        forks=False,
        commands=(),
    )


FEDERATE: Final = PythonFederate(
    PHYSICS, _load, "positions and path losses from the events of EMANE, in real time", EmaneOptions
)
"""Target of the entry point `emane`."""
