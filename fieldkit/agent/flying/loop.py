"""The control loop of a pilot. It runs ten times per second and checks each time whether the flight may continue."""

from __future__ import annotations

import threading
import time
from typing import Callable, Iterator

from fieldkit.agent.autopilots.autopilot import AutopilotState, status_text
from fieldkit.agent.autopilots.mavlink_frames import ATTITUDE, GLOBAL_POSITION_INT, HEARTBEAT, LOCAL_POSITION_NED
from fieldkit.agent.flying.flight_plan import CLIMB, GO, HOME, LEAVE, STAY, FlightPlan
from fieldkit.agent.flying.landing import (
    COMMAND_TIMEOUT_S,
    FENCE_BREACHED,
    LEASE_EXPIRED,
    PEER_STOPPED,
    REFUSED,
    RETRY_S,
    TAKEN_OVER,
    FlightError,
    log_line,
)
from fieldkit.agent.flying.liveness import FLYING, IDLE, LANDING, PILOT, LivenessFile
from fieldkit.agent.flying.origin import FlightFence, FlightOrigin, Position
from fieldkit.agent.flying.session import AutopilotSession
from fieldkit.agent.orders import CANCELLED, Orders

RATE_HZ = 10.0
"""Rate of iterations, of set-points, and of the reports in `_STREAMS`."""
GAP_S = 1.0
"""Maximum time between two iterations in flight. After a longer gap, for example after SIGSTOP, it is aborted."""
HEARTBEAT_S = 6.0
"""Timeout for the first heartbeat of the autopilot."""

_FLIGHT_HEARTBEAT_TIMEOUT_S = 10.0
"""Timeout for heartbeats in flight. It is long, because a lost connection may be restored."""
_POSITION_TIMEOUT_S = 5.0
"""Timeout for position reports in flight, which are requested repeatedly during this time."""
_STREAMS = (HEARTBEAT, LOCAL_POSITION_NED, ATTITUDE)


class FlightLoop:
    """The control loop of a program that flies a drone.

    Args:
        plan: The flight.
        stop_event: Set when the job must stop.
        note: Called at the end of each iteration with the state of the autopilot.

    Attributes:
        session: The session with the autopilot.
        drone: The state of the autopilot.
        orders: The orders of the laptop; their lease begins with the first heartbeat of the autopilot.
        state: The state of this program, for its guard.
        yaw_rad: The heading of all set-points; 0 before the origin is known.
        fence: The fence; None before the origin is known.
        has_armed: Whether the motors were armed for this flight.

    Raises:
        OSError: The connection or the liveness file cannot be opened.
    """

    def __init__(self, plan: FlightPlan, stop_event: threading.Event, note: Callable[[AutopilotState], None]) -> None:
        self._plan = plan
        self._stop_event = stop_event
        self._liveness = LivenessFile(plan.liveness, PILOT) if plan.liveness else None
        self.session = AutopilotSession(plan.connection, note)
        self.drone = self.session.drone
        self.orders = Orders(plan.orders, (STAY, CLIMB, GO, HOME, LEAVE), plan.lease_s)
        self.state = IDLE
        self.yaw_rad = 0.0
        self.fence: FlightFence | None = None
        self.has_armed = False
        self._iteration_s: float | None = None
        self._mode_name = ""

    def set_origin(self, origin: FlightOrigin, ground_m: float) -> None:
        """Set the origin: the heading of all set-points, and the centre of the fence."""
        self.yaw_rad = origin.heading_rad
        self.fence = FlightFence(origin, ground_m, self._plan.fence_m, self._plan.ceiling_m)

    def wait_for_autopilot(self) -> None:
        """Wait for the first heartbeat of the autopilot, and request its reports.

        Raises:
            FlightError: No heartbeat arrived, or the job was cancelled.
        """
        wait_for_heartbeat(self.session, self._plan.connection, self._stop_event, self.update)
        for kind in _STREAMS:
            self.drone.commands.request_stream(kind, RATE_HZ)
        self.drone.commands.request_stream(GLOBAL_POSITION_INT, 2.0)
        self.orders = Orders(self._plan.orders, (STAY, CLIMB, GO, HOME, LEAVE), self._plan.lease_s)

    def update(self) -> None:
        """Update the liveness entry of this program, and log new texts and a changed mode of the autopilot."""
        if self._liveness is not None:
            self._liveness.update(self.state)
        for text in self.drone.texts.unread():
            log_line(f"the autopilot: {text}")
        if self.drone.dialect is not None and self.drone.mode_name != self._mode_name:
            self._mode_name = self.drone.mode_name
            log_line(f"mode {self._mode_name}")

    def iterate(self, set_point: Callable[[], Position] | None = None) -> Iterator[None]:
        """Yield ten times per second, after the checks of the flight.

        Args:
            set_point: Returns the next set-point, which is moved inside the fence; None for no set-points.

        Raises:
            FlightError: The flight cannot continue.
        """
        self._iteration_s = None
        while True:
            self._require_no_gap()
            if self._stop_event.is_set():
                raise FlightError(CANCELLED, "the job was cancelled")
            self.orders.poll()
            if self.orders.expired:
                raise FlightError(LEASE_EXPIRED, "the order was not renewed in time: the laptop no longer answers")
            self._require_guard()
            self._require_control()
            if set_point is not None:
                position_m = set_point()
                self.drone.commands.send_set_point(
                    self.fence.clamped(position_m) if self.fence else position_m, self.yaw_rad
                )
            self.update()
            self.session.exchange(1 / RATE_HZ)
            yield

    def run_until(self, condition: Callable[[], bool], set_point: Callable[[], Position] | None = None) -> None:
        """Iterate until `condition` returns True; see `iterate` for `set_point` and the errors."""
        for _ in self.iterate(set_point):
            if condition():
                return

    def command_until(
        self,
        send_command: Callable[[], None],
        is_done: Callable[[], bool],
        what: str,
        set_point: Callable[[], Position] | None = None,
    ) -> None:
        """Send a command repeatedly until it is executed.

        Args:
            send_command: Sends the command.
            is_done: Returns True if the command is executed.
            what: The command as the object of "the autopilot refuses", for the error message: `the take-off`.
            set_point: Returns the next set-point; None for no set-points.

        Raises:
            FlightError: The command was not executed in time, and the message contains the autopilot's last text; or
                for the same reasons as in `iterate`.
        """
        start_s, retry_s = time.monotonic(), 0.0
        for _ in self.iterate(set_point):
            if is_done():
                return
            if time.monotonic() > start_s + COMMAND_TIMEOUT_S:
                raise FlightError(REFUSED, f"the autopilot refuses {what} ({status_text(self.drone)})")
            if time.monotonic() > retry_s:
                retry_s = time.monotonic() + RETRY_S
                send_command()

    def _require_no_gap(self) -> None:
        """Raise `FlightError` if this program was suspended or delayed for longer than `GAP_S` in flight."""
        previous_s, self._iteration_s = self._iteration_s, time.monotonic()
        if self.state == FLYING and previous_s is not None and (gap_s := self._iteration_s - previous_s) > GAP_S:
            raise FlightError(LEASE_EXPIRED, f"the pilot did not run for {gap_s:.1f} s")

    def _require_guard(self) -> None:
        """Raise `FlightError` if the guard has stopped."""
        if self._liveness is not None and (problem := self._liveness.poll()):
            raise FlightError(PEER_STOPPED, f"the guard {problem}")

    def _require_control(self) -> None:
        """Raise `FlightError` in flight, unless the drone follows set-points, reports its state, and is in the fence.

        Motors, position and fence are checked only after the motors were armed.
        """
        drone = self.drone
        if self.state != FLYING:
            return
        if drone.heartbeat_age_s > _FLIGHT_HEARTBEAT_TIMEOUT_S:
            connection_note = ", its connection is closed" if self.session.link.lost_since_s is not None else ""
            raise FlightError(
                REFUSED, f"no heartbeat from the autopilot for {_FLIGHT_HEARTBEAT_TIMEOUT_S:g} s{connection_note}"
            )
        if not drone.guided:
            if self._liveness is not None and self._liveness.other_state == LANDING:
                raise FlightError(PEER_STOPPED, "the guard lands it")
            raise FlightError(TAKEN_OVER, f"a person or another program flies it ({status_text(drone)})")
        if not self.has_armed:
            return
        if not drone.armed:
            raise FlightError(TAKEN_OVER, f"its motors have stopped ({status_text(drone)})")
        if drone.position_age_s > _POSITION_TIMEOUT_S:
            raise FlightError(REFUSED, f"it has not reported its position for {_POSITION_TIMEOUT_S:g} s")
        if (
            self.fence is not None
            and drone.position_m is not None
            and (breach := self.fence.breach(drone.position_m))
        ):
            raise FlightError(FENCE_BREACHED, breach)


def wait_for_heartbeat(
    session: AutopilotSession, connection: str, stop_event: threading.Event, each_iteration: Callable[[], None]
) -> None:
    """Wait for the first heartbeat of the autopilot at a connection.

    Raises:
        FlightError: No heartbeat arrived, or the job was cancelled.
    """
    start_s = time.monotonic()
    while not session.drone.alive:
        if stop_event.is_set():
            raise FlightError(CANCELLED, "the job was cancelled")
        if time.monotonic() > start_s + HEARTBEAT_S:
            raise FlightError(REFUSED, f"no heartbeat from an autopilot at {connection} in {HEARTBEAT_S:g} s")
        each_iteration()
        session.exchange(1 / RATE_HZ)
