"""A backend for robots on a bench, where a programmable attenuator simulates the distance."""

import math
import os
import socket
from collections.abc import Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager
from typing import Final

from fieldkit.backends.field import FieldBackend
from fieldkit.backends.protocols import Cast, Testbed
from fieldkit.config.schema import Document
from fieldkit.config.site import Site
from fieldkit.core.errors import ConfigurationError, FieldkitError, LinkError
from fieldkit.core.events import Sink
from fieldkit.core.model import Fault, Move, Placement, Role, Scenario, Topology
from fieldkit.core.prompts import DONE, Answer, Operator
from fieldkit.remote.shell import Shell

LOSS_AT_1_M_DB: Final = 40.2  # free space at 2.437 GHz
PORT: Final = 5025  # SCPI over a plain socket


class BenchBackend:
    """Real robots over SSH, whose antennas are connected by a cable."""

    permissions: frozenset[str] = frozenset()
    by_hand = False
    lab_bytes = 0

    def __init__(self, site: Site | None, document: Document | None) -> None:
        self._field = FieldBackend(site, document)

    def cast(self, topology: Topology) -> Cast:
        if topology is not Topology.MASTERLESS:
            raise ConfigurationError("the bench has one cable", remedy="use --topology masterless")
        return self._field.cast(topology)

    @contextmanager
    def open(self, cast: Cast, *, seed: int, sink: Sink, operator: Operator) -> Iterator[Testbed]:
        with self._field.open(cast, seed=seed, sink=sink, operator=operator) as testbed:
            yield BenchTestbed(testbed, os.environ.get("BENCH_ATTENUATOR", "192.168.1.50"))

    def persistent_shells(self, *, sink: Sink) -> AbstractContextManager[Mapping[str, Shell | FieldkitError]]:
        return self._field.persistent_shells(sink=sink)


class BenchTestbed:
    """A testbed that sets the attenuation of the requested distance."""

    oracle = None

    def __init__(self, robots: Testbed, attenuator: str) -> None:
        self._robots = robots
        self._attenuator = attenuator

    @property
    def shells(self) -> Mapping[Role, Shell]:
        return self._robots.shells

    @property
    def operator(self) -> Operator:
        return self._robots.operator

    def inject(self, fault: Fault) -> float | None:
        return self._robots.inject(fault)  # the field testbed requests the fault from the operator

    def bring_back(self, role: Role, *, has_returned: bool) -> None:
        pass  # no robot drove

    def moving(self, move: Move) -> AbstractContextManager[None]:
        raise ConfigurationError("robots cannot move on the bench", remedy="use a procedure without a step move")

    def place(self, placement: Placement) -> Answer:
        if placement.scenario is Scenario.NLOS:
            raise ConfigurationError("the bench has no wall", remedy="use a procedure with scenario los")
        loss_db = LOSS_AT_1_M_DB + 20 * math.log10(max(placement.distance.metres, 1.0))
        try:
            with socket.create_connection((self._attenuator, PORT), timeout=5.0) as link:
                link.sendall(f"ATT {loss_db:.1f}\n".encode())
        except OSError as error:
            raise LinkError(
                f"the attenuator does not answer: {error}", where=self._attenuator, remedy="check that it is on"
            ) from error
        return DONE
