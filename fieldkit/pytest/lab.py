"""The lab of a file of tests: its robots are brought up once, and gone when its last test has ended."""

import argparse
import secrets
from contextlib import AbstractContextManager, ExitStack
from functools import cached_property
from typing import Self

from fieldkit.backends.protocols import Backend, Cast, Testbed
from fieldkit.cli import options as command_line
from fieldkit.cli import sites
from fieldkit.core.errors import ConfigurationError
from fieldkit.core.model import Fault, FaultKind, Leg, Move, Placement, Scenario, Topology
from fieldkit.core.prompts import Operator
from fieldkit.core.units import (
    METRES_PER_S_PER_UNIT,
    parse_distance,
    parse_duration_s,
    parse_offset_m,
    parse_quantity,
)
from fieldkit.pytest.evidence import EvidenceKeeper
from fieldkit.pytest.options import LabOptions, one_of
from fieldkit.pytest.robots import RobotHandles
from fieldkit.trial.running import opening


class OpenedLab:
    """Robots of one topology at a time, brought up when they are first wanted; use as a context manager.

    Args:
        options: What it is to be.
        keeper: Takes what happens into the evidence.
        operator: Does what the backend cannot do by itself.
        workers: How many processes run tests at the same time.

    Attributes:
        options: What it is to be.
        keeper: See above.
        session: Names it on the robots' locks.
        topology: Whose robots are up; None before any are.
        robots: They.
    """

    def __init__(self, options: LabOptions, keeper: EvidenceKeeper, operator: Operator, *, workers: int) -> None:
        self.options = options
        self.keeper = keeper
        self.session = secrets.token_hex(8)
        self.topology: Topology | None = None
        self.robots = RobotHandles(self)
        self._operator = operator
        self._workers = workers
        self._up = ExitStack()
        self._testbed: Testbed | None = None
        self._cast: Cast = {}

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._close()

    def __repr__(self) -> str:
        return f"<lab {self.backend_name}, {self.topology or 'not up'}>"

    @property
    def backend_name(self) -> str:
        """Where the robots come from."""
        return self._source[0]

    @property
    def backend(self) -> Backend:
        """What brings them up."""
        return self._source[1]

    @property
    def testbed(self) -> Testbed:
        """The robots that are up; errors as `open`."""
        return self.open()

    @property
    def cast(self) -> Cast:
        """Who plays which role; errors as `open`."""
        self.open()
        return self._cast

    def open(self, topology: Topology | None = None) -> Testbed:
        """Bring the robots up, unless they are; those of another topology end first.

        Args:
            topology: Whose; None for those that are up, or those of the options.

        Raises:
            ConfigurationError: The backend, the site file or the topology is wrong, several workers would share
                robots, or something is missing on this machine.
            LinkError, RobotError: A robot cannot be reached, or somebody else has it.
        """
        wanted = topology or self.topology or self._first_topology()
        if self._testbed is None or wanted != self.topology:
            self._close()
            self._bring_up(wanted)
        assert self._testbed is not None
        return self._testbed

    def place(self, distance: str, scenario: str = "los") -> None:
        """Put the robots elsewhere, where they stay; a person is asked to carry real ones.

        Args:
            distance: Between the robots, or between each of them and the relay: `30ft`.
            scenario: `los`, or `nlos`: behind the wall.

        Raises:
            ConfigurationError: That is no distance or scenario, or nobody is there to be asked.
            LinkError: The robots could not be placed.
        """
        testbed = self.open()
        assert self.topology is not None
        self.tell(f"place {distance}, {scenario}")
        placement = Placement(one_of(Scenario, scenario, "scenario"), self.topology, parse_distance(distance))
        if note := testbed.place(placement).note:
            self.tell(f"noted: {note}")

    def fault(self, kind: str, robot: str, *, lasts: str = "", process: str = "") -> float | None:
        """Do something to a robot on purpose; return when its cause is over, and not yet that the robot has healed.

        Args:
            kind: `link-down`, `out-of-range`, `reboot`, or `kill`.
            robot: Its role or its name.
            lasts: For how long the link is down, or the robot away: `3s`.
            process: Name of the process that is killed.

        Returns:
            How many seconds the cause lasted, None where nobody knows.

        Raises:
            ConfigurationError: There is no such fault or robot, or it lacks or has too much of the above.
            LinkError, RobotError: It could not be done.
        """
        what, testbed = one_of(FaultKind, kind, "fault"), self.open()
        is_lasting = what in {FaultKind.LINK_DOWN, FaultKind.OUT_OF_RANGE}
        for given, key, wanted in ((lasts, "lasts", is_lasting), (process, "process", what is FaultKind.KILL)):
            if bool(given) is not wanted:
                example = f'{key}="{"3s" if key == "lasts" else "roscore"}"'
                raise ConfigurationError(
                    f"the fault {what} {'needs' if wanted else 'takes no'} {key}",
                    remedy=f"write {example}" if wanted else f"leave {key} out",
                )
        duration_s = parse_duration_s(lasts) if lasts else 0.0
        self.tell(f"{what} {robot} {lasts or process}")
        return testbed.inject(Fault(what, self.robots[robot].role, duration_s, process))

    def moving(
        self, robot: str, *, away: str = "0m", left: str = "0m", speed: str = "0.2m/s"
    ) -> AbstractContextManager[None]:
        """Return a context in which a robot moves from its place; it is back there afterwards.

        Args:
            robot: Its role or its name.
            away: So far from the robot at the other end of its link; towards it with a minus sign.
            left: So far to its left then; to its right with a minus sign.
            speed: How fast: `0.2m/s`.

        Raises:
            ConfigurationError: There is no such robot, or that is no way.
        """
        leg = Leg(parse_offset_m(away), parse_offset_m(left))
        speed_m_s = parse_quantity(speed, METRES_PER_S_PER_UNIT, "speed")
        if leg == Leg() or speed_m_s == 0:
            raise ConfigurationError(f"{robot} would not move", remedy='write for example away="10m", speed="0.2m/s"')
        self.tell(f"move {robot} {away} away, {left} left, at {speed}")
        return self.open().moving(Move(self.robots[robot].role, (leg,), speed_m_s))

    def tell(self, text: str) -> None:
        """Add a line to the evidence."""
        self.keeper.folder.add(text)

    @cached_property
    def _source(self) -> tuple[str, Backend]:
        arguments = argparse.Namespace(backend=self.options.backend, site=self.options.site)
        return command_line.backend(arguments, self.keeper.told)

    def _first_topology(self) -> Topology:
        if self.options.topology is not None:
            return one_of(Topology, self.options.topology, "topology")
        site, _ = sites.lab_site(argparse.Namespace(site=self.options.site))
        return next(iter(site.roles), Topology.MASTER) if site else Topology.MASTER

    def _bring_up(self, topology: Topology) -> None:
        if self.backend.by_hand and self._workers > 1:
            raise ConfigurationError(
                f"{self._workers} workers of pytest-xdist cannot share the robots of the backend {self.backend_name}",
                remedy="run these tests in one process: pytest -n 0",
            )
        cast = self.backend.cast(topology)
        self.tell(f"open {self.backend_name}, {topology}")
        with ExitStack() as opened:
            testbed = opened.enter_context(
                opening.opened(
                    self.backend,
                    cast,
                    session=self.session,
                    what="pytest",
                    seed=self.options.seed,
                    sink=self.keeper.told,
                    operator=self._operator,
                )
            )
            if not self.backend.by_hand:
                testbed.place(Placement(Scenario.LOS, topology, parse_distance(self.options.distance)))
            self._up = opened.pop_all()
        self._testbed, self._cast, self.topology = testbed, cast, topology

    def _close(self) -> None:
        self._testbed, self.topology = None, None
        self._up.close()
