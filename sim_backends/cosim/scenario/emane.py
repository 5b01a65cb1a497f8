"""Publishes the positions of a run's agents, and the path losses between them, as events of EMANE.

EMANE is an emulator of radio networks. Its events contain the positions of radios, and the attenuation of the signals
between them.
"""

import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from itertools import combinations
from types import TracebackType
from typing import Final

import numpy as np

from fieldkit.core.errors import ConfigurationError
from fieldkit.core.model import Vector
from sim_backends.cosim.recording.recorder import Sampling
from sim_backends.cosim.run_record import IpObserver, Window, WindowObserver
from sim_backends.cosim.scenario.agent_setup import antennas_of
from sim_backends.cosim.scenario.schema import CosimScenario
from sim_backends.emane_events.channel import EventPublisher
from sim_backends.emane_events.events import (
    ALL_NEMS,
    LOCATION,
    PATHLOSS,
    NemLocation,
    NemPathloss,
    SerializedEvent,
    encode_locations,
    encode_pathlosses,
)
from sim_backends.emane_events.geodesy import LocalFrame, emane_velocity
from sim_backends.emane_events.options import EmaneOptions
from sim_backends.network.ip import Fragment
from sim_backends.radio.world_channel import WorldChannel
from sim_backends.world.motion import State
from sim_backends.world.world import load_world

_LOCATIONS_PER_EVENT: Final = 20
"""Largest number of locations in an event, so that it fits into an Ethernet frame."""

Losses = Callable[[Sequence[Vector]], Mapping[tuple[int, int], float]]
"""A function that returns the path losses in dB between positions, by pairs of indices."""


class EmaneObserver(AbstractContextManager["EmaneObserver"]):
    """An observer that publishes events of EMANE, and forwards all calls to another observer.

    Args:
        options: The event channel.
        nems: Identifier of the NEM (EMANE's term for a radio) of each agent.
        losses: Returns the path losses; None to publish locations only.
        observer: The other observer, or None.

    Attributes:
        log_ip: The other observer's method; missing if it does not accept IP packets.

    Raises:
        ConfigurationError: The channel cannot be used.
    """

    log_ip: Callable[[int, str, Fragment], None]

    def __init__(
        self, options: EmaneOptions, nems: Mapping[str, int], losses: Losses | None, observer: WindowObserver | None
    ) -> None:
        self._options = options
        self._nems = nems
        self._losses = losses
        self._observer = observer
        self._frame = LocalFrame(options.reference)
        self._sampling = Sampling(round(options.interval * 1e9))
        self._start_s = 0.0
        self._publisher = EventPublisher(options.channel, options.device)
        if isinstance(observer, IpObserver):
            self.log_ip = observer.log_ip

    def begin(self, states: Mapping[str, State]) -> None:
        """Publish the states at time 0."""
        if self._observer is not None:
            self._observer.begin(states)
        self._start_s = time.monotonic()
        self._publish(states)

    def window(self, window: Window) -> None:
        """Publish the states at the end of a window if they are due; a run in real time first waits for that time."""
        if self._observer is not None:
            self._observer.window(window)
        if self._sampling.is_due(window.end_ns):
            if self._options.real_time:
                time.sleep(max(self._start_s + window.end_ns / 1e9 - time.monotonic(), 0.0))
            self._publish(window.states)

    def __exit__(
        self, _kind: type[BaseException] | None, _error: BaseException | None, _trace: TracebackType | None
    ) -> None:
        """Close the channel."""
        self._publisher.close()

    def _publish(self, states: Mapping[str, State]) -> None:
        locations = [self._location(nem, states[name]) for name, nem in self._nems.items() if name in states]
        events = [
            SerializedEvent(ALL_NEMS, LOCATION, encode_locations(locations[first : first + _LOCATIONS_PER_EVENT]))
            for first in range(0, len(locations), _LOCATIONS_PER_EVENT)
        ]
        if self._losses is not None:
            events += self._pathlosses(states)
        self._publisher.publish(events)

    def _location(self, nem: int, state: State) -> NemLocation:
        return NemLocation(nem, *self._frame.geodetic(state.position_m), emane_velocity(state.velocity_m_s))

    def _pathlosses(self, states: Mapping[str, State]) -> list[SerializedEvent]:
        """Return an event for each agent, with its path losses to all others; both directions have equal losses."""
        assert self._losses is not None
        names = [name for name in self._nems if name in states]
        losses_db = self._losses([states[name].position_m for name in names])
        losses_by_nem: dict[int, list[NemPathloss]] = {}
        for (first, second), loss_db in losses_db.items():
            for receiver, peer in ((first, second), (second, first)):
                loss = NemPathloss(self._nems[names[peer]], loss_db, loss_db)
                losses_by_nem.setdefault(self._nems[names[receiver]], []).append(loss)
        return [SerializedEvent(nem, PATHLOSS, encode_pathlosses(losses)) for nem, losses in losses_by_nem.items()]


def emane_observer(scenario: CosimScenario, seed: int, observer: WindowObserver | None) -> EmaneObserver:
    """Return the observer that publishes the events of a run.

    Args:
        scenario: The scenario, which has a section `emane`.
        seed: Seed of the random draws for shadowing.
        observer: Another observer of the run, or None.

    Raises:
        ConfigurationError: The section does not match the agents, or the channel cannot be used.
    """
    options = scenario.emane
    assert options is not None
    try:
        nems = options.nems_of(scenario.agents)
    except ValueError as error:
        raise ConfigurationError(
            f"scenario {scenario.name}: emane: {error}", remedy="correct the key emane.nems of the scenario"
        ) from error
    has_losses = options.pathloss and not scenario.radio.is_fixed
    return EmaneObserver(options, nems, _losses(scenario, seed) if has_losses else None, observer)


def _losses(scenario: CosimScenario, seed: int) -> Losses:
    """Return a function that computes the path losses between positions in the world of a scenario."""
    channel = WorldChannel(seed, antennas_of(scenario), scenario.radio, load_world(scenario.world))

    def losses_db(positions_m: Sequence[Vector]) -> dict[tuple[int, int], float]:
        pairs = list(combinations(range(len(positions_m)), 2))
        if not pairs:
            return {}
        ends_m = np.array([[positions_m[first], positions_m[second]] for first, second in pairs])
        return dict(zip(pairs, channel.loss_db(ends_m[:, 0], ends_m[:, 1]).tolist(), strict=True))

    return losses_db
