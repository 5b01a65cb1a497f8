"""A trial of a cell of the fault matrix: it starts a motion, injects the fault, and observes the robot."""

import json
import os
import random
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Final

from fieldkit.core.deadline import Deadline
from tests.helpers.motion_cells import AT_REST, DELAY_S, PAUSE_S, InjectedFault, Moment, MotionCell, expected
from tests.helpers.motion_lab import LONG_S, MotionLab, start_trial
from tests.helpers.motion_outcomes import MotionOutcome, problems
from tests.helpers.motion_parties import ON_ROBOT, Party, SlowProcesses, agents_on, pids_of, send
from tests.helpers.motion_truth import (
    STATIONARY_FOR_S,
    STOPPED_FOR_S,
    MotionSampler,
    descended_s,
    grounded_s,
    moved_again_m,
    stopped_s,
)
from tests.helpers.runs import finish, start
from tests.helpers.sshd import wait_until

REACHES_S: Final = 60.0
"""Time limit for a trial to reach the phase of its cell."""
OBSERVED_S: Final = 5.0
"""Time of observation after the robot has stopped."""
ENDS_S: Final = 45.0
"""Maximum time of observation of a running fieldkit until it exits."""
ARRIVES_S: Final = 40.0
"""Maximum time of observation of a robot that does not stop or is not on the ground."""
LOST_HZ: Final = 2.0
"""A lower rate of positions indicates a lost link; 10 Hz are requested, and the rate is averaged over 1 s."""
_PHASES: Final = {
    Moment.OUT: ("out",),
    Moment.THERE: ("there",),
    Moment.BACK: ("back", "coming back"),
    Moment.GROUND: ("standing",),
    Moment.CLIMBING: ("climbing",),
    Moment.FLYING: ("flying",),
    Moment.LANDING: ("coming down",),
}
"""Names of each phase in the logs of robots."""
_MAX_DELAY_S: Final = 0.5
"""Maximum of the random delay between the start of the phase and the fault."""
_DISARM_CHECK: Final = """\
import time
from pymavlink import mavutil
drone = mavutil.mavlink_connection("udpout:127.0.0.1:14550", source_system=251)
until_s, beat = time.monotonic() + 15, None
while (beat is None or beat.base_mode & 128) and time.monotonic() < until_s:
    drone.mav.heartbeat_send(6, 8, 0, 0, 0)
    beat = drone.recv_match(type="HEARTBEAT", blocking=True, timeout=0.5) or beat
raise SystemExit(beat is None or bool(beat.base_mode & 128))
"""
_CAPITALS: Final = re.compile(r"\b(?:[A-Z][A-Z'-]+[ ,:;.!]+){2,}[A-Z]{2,}")
"""At least three consecutive words in capitals."""


@dataclass
class MotionTrial:
    """A trial.

    Args:
        lab: The robots.
        cell: The fault and its phase.
        folder: An empty folder for fieldkit.
        seed: Seed of the time of the fault.
    """

    lab: MotionLab
    cell: MotionCell
    folder: Path
    seed: int
    _restorers: list[Callable[[], object]] = field(default_factory=list)
    _process: "subprocess.Popen[bytes] | None" = None
    _previous_logs: set[Path] = field(default_factory=set)
    _logs: set[Path] = field(default_factory=set)
    _alarm_s: float | None = None
    _programs_s: float | None = None
    _servers: set[int] = field(default_factory=set)
    _link_lost: bool = False
    _scheduling_s: float = 0.0

    def run(self) -> MotionOutcome:
        """Run the trial, and restore the lab."""
        cell, craft, started_s = self.cell, self.cell.craft, time.monotonic()
        self.lab.prepare(cell, self.folder)
        if cell.routed:
            self.lab.start_router(craft)
        self._previous_logs = self.lab.logs(craft)
        with MotionSampler(self.lab.robot(craft).recorded_motion, self.lab.place_m(craft)) as sampler:
            self._process = start_trial(self.folder)
            try:
                self._reach(sampler)
                time.sleep(random.Random(self.seed).uniform(0.0, self._max_delay_s))
                at_s = time.monotonic()
                self._inject()
                self._observe(sampler, at_s)
                outcome = self._outcome(sampler, at_s)
            except AssertionError as error:
                outcome = MotionOutcome(cell.name, self.seed, problems=(f"{error}; {self._read_output()[-300:]}",))
            finally:
                self._end()
        leftovers = self.lab.restore_lab(craft, self.folder)
        duration_s = round(time.monotonic() - started_s, 1)
        return replace(outcome, problems=(*outcome.problems, *leftovers), took_s=duration_s)

    @property
    def _max_delay_s(self) -> float:
        """Maximum delay of the fault; 0 for short phases."""
        return 0.0 if self.cell.moment in AT_REST else _MAX_DELAY_S

    def _reach(self, sampler: MotionSampler) -> None:
        process = self._process
        assert process is not None

        def is_reached() -> bool:
            assert process.poll() is None, f"fieldkit ended before {self.cell.moment} with {process.returncode}"
            return self._in_phase(sampler)

        try:
            wait_until(is_reached, Deadline.after(REACHES_S))
        except AssertionError as error:
            raise AssertionError(f"{self.cell.moment} was not reached: {error}") from error

    def _in_phase(self, sampler: MotionSampler) -> bool:
        """Return True if both the log and the ground-truth motion of the robot show the phase."""
        sample, moment = sampler.newest, self.cell.moment
        if sample is None:
            return False
        if moment is Moment.WAITING:
            return bool(pids_of(Party.AGENT, self.lab.robot(self.cell.craft).pid))
        motion_checks = {
            Moment.OUT: sample.speed_m_s > 0.3,
            Moment.BACK: sample.speed_m_s > 0.3,
            Moment.CLIMBING: sample.up_m > 0.5,
            Moment.FLYING: sample.speed_m_s > 0.5,
            Moment.LANDING: sample.rises_m_s < -0.1,
        }
        return self._phase() in _PHASES[moment] and motion_checks.get(moment, True)

    def _phase(self) -> str:
        """The phase in the newest log on the robot; empty if there is no log."""
        return str(self._last_line().get("phase", ""))

    def _last_line(self) -> dict[str, object]:
        """The last line of the newest log on the robot; empty if there is no log."""
        for path in self.lab.logs(self.cell.craft) - self._previous_logs:
            with suppress(OSError, ValueError, IndexError):
                lines = path.read_bytes()[-2000:].split(b"\n")
                return dict(json.loads(lines[-2]))
        return {}

    def _is_link_lost(self) -> bool:
        """Return True if the link server was replaced after the fault, or positions stopped behind the router."""
        if Party.SERVER in self.cell.parties:
            new_servers = pids_of(Party.SERVER, self.lab.robot(self.cell.craft).pid) - self._servers
            return bool(new_servers)
        rate_hz = self._last_line().get("rate_hz")
        return isinstance(rate_hz, float) and rate_hz < LOST_HZ

    def _inject(self) -> None:
        """Apply the fault to the parties, to the operator last."""
        assert self._process is not None
        fault, parties = self.cell.fault, {*self.cell.parties}
        pids = {pid for party in parties & {*ON_ROBOT} for pid in self._pids_on_robot(party)}
        self._servers = self._pids_on_robot(Party.SERVER) if self.cell.cuts_link else set()
        if parties & {Party.FIELDKIT, Party.LAPTOP}:
            pids.add(self._process.pid)
        if parties & {Party.LINK, Party.LAPTOP}:
            self._disturb_link()
        if fault is InjectedFault.CTRL_C:
            send(signal.SIGINT, {self._process.pid})
        elif fault in {InjectedFault.KILL, InjectedFault.ABORT}:
            send(signal.SIGKILL, pids)
        elif fault is InjectedFault.SLOW and pids:
            self._restorers.append(SlowProcesses(pids).end)
        elif fault is not InjectedFault.SLOW:
            send(signal.SIGSTOP, pids)
            self._restorers.append(lambda: send(signal.SIGCONT, pids))
        if fault in {InjectedFault.STOP, InjectedFault.ABORT}:
            self._run_command(fault)

    def _disturb_link(self) -> None:
        """Cut or delay the control link."""
        links, role = self.lab.field_robots.links, self.lab.role(self.cell.craft)
        if self.cell.fault is InjectedFault.SLOW:
            links.delay(role, DELAY_S)
            self._restorers.append(lambda: links.delay(role, 0.0))
        else:
            links.cut(role)
            self._restorers.append(lambda: links.restore(role))

    def _pids_on_robot(self, party: Party) -> set[int]:
        craft = self.cell.craft
        pids = pids_of(party, self.lab.robot(craft).pid, lambda: self.lab.router_pids(craft))
        assert pids, f"no process of the {party} runs on the robot"
        return pids

    def _run_command(self, fault: InjectedFault) -> None:
        """Run `fieldkit stop` or `fieldkit abort`, as from another terminal."""
        name = self.lab.robot(self.cell.craft).name
        words = ("stop", name) if fault is InjectedFault.STOP else ("abort", "--yes")
        process = start(self.folder, *words)
        with ThreadPoolExecutor(1) as pool:
            completed = pool.submit(finish, process)
            while not completed.done():
                self._scheduling_s = max(self._scheduling_s, scheduling_delay_s(process.pid))
                time.sleep(0.01)
        (self.folder / "stop").write_text(completed.result().out + completed.result().err, encoding="utf-8")

    def _observe(self, sampler: MotionSampler, at_s: float) -> None:
        """Observe the robot until some time after it has stopped or landed; undo a pause after `PAUSE_S`."""
        paused_until_s = at_s + PAUSE_S if self.cell.fault is InjectedFault.PAUSE else None
        is_suspended = self.cell.fault in {InjectedFault.SUSPEND, InjectedFault.STOP} and {
            Party.FIELDKIT,
            Party.LAPTOP,
        } & {*self.cell.parties}
        stopped_at_s: float | None = None
        while True:
            time.sleep(0.05)
            now_s = time.monotonic()
            self._logs |= self.lab.logs(self.cell.craft) - self._previous_logs  # collected logs are deleted
            self._link_lost = self._link_lost or (self.cell.cuts_link and self._is_link_lost())
            if self._alarm_s is None and _CAPITALS.search(self._read_output()):
                self._alarm_s = now_s - at_s
            if paused_until_s is not None and now_s >= paused_until_s:
                self._undo_fault()
                paused_until_s = None
                stopped_at_s = None
            if stopped_at_s is None and self._stopped_s(sampler, at_s) is not None:
                stopped_at_s = now_s
            if paused_until_s is not None or self._programs_run(at_s):
                continue
            is_running = self._process is not None and self._process.poll() is None and not is_suspended
            observed_s = now_s - (stopped_at_s if stopped_at_s is not None else now_s)
            if stopped_at_s is None and now_s - at_s > ARRIVES_S:
                return
            if stopped_at_s is not None and observed_s > OBSERVED_S and (not is_running or observed_s > ENDS_S):
                return

    def _programs_run(self, at_s: float) -> bool:
        """Return True if programs of fieldkit still run on the robot and their time limit has not expired."""
        bound_s, now_s = expected(self.cell).programs_s, time.monotonic()
        if bound_s is None or self._programs_s is not None:
            return False
        if agents_on(self.lab.robot(self.cell.craft).pid):
            return now_s < at_s + bound_s
        self._programs_s = now_s - at_s
        return False

    def _stopped_s(self, sampler: MotionSampler, at_s: float) -> float | None:
        """Time after the fault at which the robot was stationary, or a drone was on the ground."""
        samples = list(sampler.samples)
        return (grounded_s if self.cell.craft.flies else stopped_s)(samples, at_s, self._remains_s)

    @property
    def _remains_s(self) -> float:
        return STATIONARY_FOR_S if self.cell.moment in AT_REST else STOPPED_FOR_S

    def _undo_fault(self) -> None:
        """Undo the fault: suspended processes continue, the link is restored, and a killed router is restarted."""
        while self._restorers:
            self._restorers.pop()()

    def _outcome(self, sampler: MotionSampler, at_s: float) -> MotionOutcome:
        cell, samples = self.cell, list(sampler.samples)
        stopped_after_s = self._stopped_s(sampler, at_s)
        ends_s = stopped_after_s if cell.craft.flies else None
        begins_s = descended_s(samples, at_s) if cell.craft.flies else stopped_after_s
        again_m = (
            0.0 if stopped_after_s is None else moved_again_m(samples, at_s + stopped_after_s + STOPPED_FOR_S / 2)
        )
        code = self._process.poll() if self._process is not None else None
        printed = self._read_output()
        outcome = MotionOutcome(
            cell=cell.name,
            seed=self.seed,
            begins_s=_rounded(begins_s),
            ends_s=_rounded(ends_s),
            again_m=round(again_m, 3),
            farthest_m=round(max(sample.from_start_m for sample in samples), 3),
            disarmed=self._disarmed() if cell.craft.flies else None,
            attempts=len(self._logs),
            code=code,
            alarm_s=_rounded(self._alarm_s),
            programs_s=_rounded(self._programs_s),
            link_lost=self._link_lost if cell.cuts_link else None,
            scheduling_s=round(self._scheduling_s, 2),
            message=(printed.strip().splitlines() or [""])[-1][:300],
            load=round(os.getloadavg()[0], 2),
        )
        return replace(outcome, problems=tuple(problems(cell, outcome)))

    def _disarmed(self) -> bool:
        shell = self.lab.field_robots.testbed.shells[self.lab.role(self.cell.craft)]
        completed = shell.run((sys.executable, "-c", _DISARM_CHECK), deadline=Deadline.after(LONG_S), check=False)
        return completed.exit_code == 0

    def _read_output(self) -> str:
        """All output of fieldkit: notices in its JSON, errors, and the output of `fieldkit stop`."""
        printed = ""
        for name in ("out", "err", "stop"):
            path = self.folder / name
            if path.exists():
                printed += path.read_text(encoding="utf-8", errors="replace")
        return printed

    def _end(self) -> None:
        """Continue suspended processes, and kill fieldkit."""
        self._undo_fault()
        process = self._process
        if process is not None:
            if process.poll() is None:
                with suppress(ProcessLookupError):
                    os.killpg(process.pid, signal.SIGKILL)
            process.wait(LONG_S)


def scheduling_delay_s(pid: int) -> float:
    """Return the time for which the main thread of a process waited for a processor (Linux, /proc/PID/schedstat).

    It is 0 if the process has exited.
    """
    try:
        _, waited_ns, _ = Path(f"/proc/{pid}/schedstat").read_text(encoding="ascii").split()
    except (OSError, ValueError):
        return 0.0
    return int(waited_ns) / 1e9


def _rounded(value_s: float | None) -> float | None:
    return None if value_s is None else round(value_s, 2)
