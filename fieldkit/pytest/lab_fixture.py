"""The lab of a test module: its robots are opened once, and closed after its last test."""

import argparse
import secrets
import sys
from collections.abc import Callable
from contextlib import AbstractContextManager, ExitStack
from functools import cached_property
from typing import Self, TypeVar

import pytest

from fieldkit.backends.protocols import Backend, Cast, Testbed
from fieldkit.cli import cli_options as command_line
from fieldkit.cli import sites
from fieldkit.cli.operators import Terminal
from fieldkit.core.errors import ConfigurationError
from fieldkit.core.events import Asked, Event, Request, Sink
from fieldkit.core.model import Fault, FaultKind, Leg, Move, Placement, Scenario, Topology
from fieldkit.core.prompts import UNATTENDED, Answer, Operator, Question
from fieldkit.core.units import (
    METRES_PER_S_PER_UNIT,
    parse_distance,
    parse_duration_s,
    parse_offset_m,
    parse_quantity,
)
from fieldkit.pytest.evidence import EvidenceKeeper
from fieldkit.pytest.plugin_options import LabOptions, one_of
from fieldkit.pytest.robot_fixture import RobotHandles
from fieldkit.trial.running import opening

T = TypeVar("T")


def operator_of(config: pytest.Config, options: LabOptions, sink: Sink) -> Operator:
    """Return the operator: the person at the terminal, or a substitute if the option `yes` is set."""
    return UNATTENDED if options.yes else UncapturedTerminal(config, sink)


class UncapturedTerminal:
    """Asks questions at the terminal although pytest captures the output and closes the input.

    Args:
        config: The configuration of pytest.
        sink: Receives each request and its answer.
    """

    def __init__(self, config: pytest.Config, sink: Sink) -> None:
        self._capture = config.pluginmanager.getplugin("capturemanager")
        self._sink = sink
        self._terminal = Terminal(self._show)

    def ask(self, request: str, *, may_skip: bool = False) -> Answer:  # noqa: ARG002 (a test cannot be skipped here)
        """Ask a person to do something; see `Operator.ask`."""
        return self._ask_uncaptured(request, lambda: self._terminal.ask(request))

    def enter(self, question: Question) -> str:
        """Ask a person a question; see `Operator.enter`."""
        return self._ask_uncaptured(f"answer: {question.text}", lambda: self._terminal.enter(question))

    def _ask_uncaptured(self, task: str, ask: Callable[[], T]) -> T:
        if self._capture is not None:
            self._capture.suspend(in_=True)
        try:
            if not sys.stdin.isatty():
                raise ConfigurationError(
                    f"a person must {task}, but standard input is not a terminal",
                    remedy="place the robots first, then add --fieldkit-yes",
                )
            return ask()
        finally:
            if self._capture is not None:
                self._capture.resume()

    def _show(self, event: Event) -> None:
        self._sink(event)
        match event:
            case Request(text):
                sys.stderr.write(f"\n{text}, then Enter\n")
            case Asked(text, how):
                sys.stderr.write(f"\n{text}? {how}\n")


class OpenedLab:
    """Robots of one topology at a time, opened on first use; a context manager.

    Args:
        options: Options of the lab.
        keeper: Receives events and log lines as evidence.
        operator: The person for actions that the backend cannot perform.
        workers: Number of processes that run tests in parallel.

    Attributes:
        options: Options of the lab.
        keeper: Receives events and log lines as evidence.
        session: Identifies the lab in the robots' locks.
        topology: Topology of the open robots; None if no robots are open.
        robots: The robots.
    """

    def __init__(self, options: LabOptions, keeper: EvidenceKeeper, operator: Operator, *, workers: int) -> None:
        self.options = options
        self.keeper = keeper
        self.session = secrets.token_hex(8)
        self.topology: Topology | None = None
        self.robots = RobotHandles(self)
        self._operator = operator
        self._workers = workers
        self._open_robots = ExitStack()
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
        """Name of the backend."""
        return self._named_backend[0]

    @property
    def backend(self) -> Backend:
        """The backend."""
        return self._named_backend[1]

    @property
    def testbed(self) -> Testbed:
        """The testbed of the open robots; raises the same errors as `open`."""
        return self.open()

    @property
    def cast(self) -> Cast:
        """The robot in each role; raises the same errors as `open`."""
        self.open()
        return self._cast

    def open(self, topology: Topology | None = None) -> Testbed:
        """Open the robots unless they are open; robots of another topology are closed first.

        Args:
            topology: The topology; None for the topology of the open robots, or else of the options.

        Raises:
            ConfigurationError: The backend, the site file or the topology is wrong, several workers would share
                robots, or something is missing on this machine.
            LinkError, RobotError: A robot cannot be reached, or is locked by another user.
        """
        requested_topology = topology or self.topology or self._first_topology()
        if self._testbed is None or requested_topology != self.topology:
            self._close()
            self._open(requested_topology)
        assert self._testbed is not None
        return self._testbed

    def place(self, distance: str, scenario: str = "los") -> None:
        """Move the robots to other positions and leave them there; a person is asked to carry real robots.

        Args:
            distance: Distance between the robots, or between each of them and the relay: `30ft`.
            scenario: `los`, or `nlos` for a place behind the wall.

        Raises:
            ConfigurationError: The text is not a distance or scenario, or no person can be asked.
            LinkError: The robots could not be placed.
        """
        testbed = self.open()
        assert self.topology is not None
        self.log(f"place {distance}, {scenario}")
        placement = Placement(one_of(Scenario, scenario, "scenario"), self.topology, parse_distance(distance))
        if note := testbed.place(placement).note:
            self.log(f"note: {note}")

    def fault(self, kind: str, robot: str, *, lasts: str = "", process: str = "") -> float | None:
        """Inject a fault into a robot; return when its cause has ended. The robot may recover later.

        Args:
            kind: `link-down`, `out-of-range`, `reboot`, or `kill`.
            robot: Its role or its name.
            lasts: Duration for which the link is down or the robot is away: `3s`.
            process: Name of the process that is killed.

        Returns:
            Duration of the cause in seconds, or None if it is unknown.

        Raises:
            ConfigurationError: There is no such fault or robot, or a parameter is missing or superfluous.
            LinkError, RobotError: The fault could not be injected.
        """
        fault_kind, testbed = one_of(FaultKind, kind, "fault"), self.open()
        has_duration = fault_kind in {FaultKind.LINK_DOWN, FaultKind.OUT_OF_RANGE}
        for value, key, is_required in (
            (lasts, "lasts", has_duration),
            (process, "process", fault_kind is FaultKind.KILL),
        ):
            if bool(value) is not is_required:
                example = f'{key}="{"3s" if key == "lasts" else "roscore"}"'
                raise ConfigurationError(
                    f"the fault {fault_kind} {'needs' if is_required else 'has no parameter'} {key}",
                    remedy=f"write {example}" if is_required else f"omit {key}",
                )
        duration_s = parse_duration_s(lasts) if lasts else 0.0
        self.log(f"{fault_kind} {robot} {lasts or process}")
        return testbed.inject(Fault(fault_kind, self.robots[robot].role, duration_s, process))

    def moving(
        self, robot: str, *, away: str = "0m", left: str = "0m", speed: str = "0.2m/s"
    ) -> AbstractContextManager[None]:
        """Return a context in which a robot moves along a straight path; afterwards it is back at its place.

        Args:
            robot: Its role or its name.
            away: Distance away from the robot at the other end of its link; negative towards it.
            left: Distance to the left of this direction; negative to the right.
            speed: Speed: `0.2m/s`.

        Raises:
            ConfigurationError: There is no such robot, or the path is invalid.
        """
        leg = Leg(parse_offset_m(away), parse_offset_m(left))
        speed_m_s = parse_quantity(speed, METRES_PER_S_PER_UNIT, "speed")
        if leg == Leg() or speed_m_s == 0:
            raise ConfigurationError(f"{robot} would not move", remedy='write for example away="10m", speed="0.2m/s"')
        self.log(f"move {robot} {away} away, {left} left, at {speed}")
        return self.open().moving(Move(self.robots[robot].role, (leg,), speed_m_s))

    def log(self, text: str) -> None:
        """Add a line to the log of the evidence."""
        self.keeper.folder.add(text)

    @cached_property
    def _named_backend(self) -> tuple[str, Backend]:
        arguments = argparse.Namespace(backend=self.options.backend, site=self.options.site)
        return command_line.backend(arguments, self.keeper.add_event)

    def _first_topology(self) -> Topology:
        if self.options.topology is not None:
            return one_of(Topology, self.options.topology, "topology")
        site, _ = sites.lab_site(argparse.Namespace(site=self.options.site))
        return next(iter(site.roles), Topology.MASTER) if site else Topology.MASTER

    def _open(self, topology: Topology) -> None:
        if self.backend.by_hand and self._workers > 1:
            raise ConfigurationError(
                f"{self._workers} workers of pytest-xdist cannot share the robots of the backend {self.backend_name}",
                remedy="run these tests in one process: pytest -n 0",
            )
        cast = self.backend.cast(topology)
        self.log(f"open {self.backend_name}, {topology}")
        with ExitStack() as open_stack:
            testbed = open_stack.enter_context(
                opening.opened(
                    self.backend,
                    cast,
                    session=self.session,
                    purpose="pytest",
                    seed=self.options.seed,
                    sink=self.keeper.add_event,
                    operator=self._operator,
                )
            )
            if not self.backend.by_hand:
                testbed.place(Placement(Scenario.LOS, topology, parse_distance(self.options.distance)))
            self._open_robots = open_stack.pop_all()
        self._testbed, self._cast, self.topology = testbed, cast, topology

    def _close(self) -> None:
        self._testbed, self.topology = None, None
        self._open_robots.close()
