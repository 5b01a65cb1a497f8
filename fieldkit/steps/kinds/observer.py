"""Observers of a robot during a fault: jobs that record when the robot answered."""

from dataclasses import dataclass
from typing import Final

from fieldkit.core.columns import step_prefixed
from fieldkit.core.model import Fault, FaultKind, Role
from fieldkit.measure.evidence import outage
from fieldkit.remote.jobs import Job
from fieldkit.steps.kinds import ping
from fieldkit.steps.scene import BY_EXIT_OR_LIMIT, BY_FIELDKIT, Planned, Scene
from fieldkit.steps.variants import PingTool, Tool

RECOVERED_S: Final = 1.0
"""A robot has recovered when it has sent as many answers as it normally sends in this time."""

_INTERVAL_S: Final = 0.1
"""Time between two pings or polls."""

# Every $2 seconds, prints the seconds since boot. While processes named $1 run, also prints `up` and their process
# IDs. Zombies do not count.
_WATCH_SCRIPT: Final = (
    'echo "watching $1"; while :; do pids=; for file in /proc/[0-9]*/comm; do '
    'read -r name <"$file" && [ "$name" = "$1" ] && read -r stat <"${file%comm}stat" || continue; '
    'case $stat in *") Z "*) ;; *) pids="$pids ${stat%% *}" ;; esac; done 2>/dev/null; '
    'read -r now _ </proc/uptime; echo "$now${pids:+ up}$pids"; sleep "$2"; done'
)

# Prints the duration of the cause ($1: how long the fault itself lasted, without the recovery) and the interval of
# pings or polls ($2). Then waits until file $3 has $5 more lines that contain $4.
_RECOVERY_SCRIPT: Final = (
    'echo "lasted_s $1"; echo "interval_s $2"; enough=$(($(grep -c "$4" "$3") + $5)); '
    'until [ "$(grep -c "$4" "$3")" -ge "$enough" ]; do sleep 0.1; done'
)


def observer_role(fault: Fault) -> Role:
    """Return the role of the observing robot.

    For `kill`, it is the robot with the fault; otherwise the sender, or the receiver if the sender has the fault.
    """
    if fault.kind is FaultKind.KILL:
        return fault.role
    return Role.RECEIVER if fault.role == Role.SENDER else Role.SENDER


@dataclass(frozen=True)
class Observer:
    """Records when a robot answers, by pings from another robot, or by polls of its process on the robot itself.

    Attributes:
        scene: The attempt.
        fault: The fault of the robot.
        name: Name of the step, the prefix of its jobs and files; empty if it has no name.
    """

    scene: Scene
    fault: Fault
    name: str = ""

    @property
    def role(self) -> Role:
        """Role of the observing robot."""
        return observer_role(self.fault)

    def watch(self, limit_s: float) -> Planned:
        """Return the job that observes until it is stopped.

        It is ready when the robot has answered a ping, or for `kill` when its script has started.
        """
        interval = f"{self._interval_s:g}"
        if self._is_kill:
            argv: tuple[str, ...] = ("sh", "-c", _WATCH_SCRIPT, "sh", self.fault.process, interval)
        else:
            link = self.fault.link
            # Without `-I`, the requests could use another link, because a robot answers on any link for all of its
            # addresses.
            interface_options = (
                ("-I", self.scene.link(self.role, link).interface) if self.scene.robot(self.role).links else ()
            )
            address = self.scene.link(self.fault.role, link).address
            argv = ping.command_line(self.scene, self.role, (*interface_options, "-i", interval), address)
        job = Job(
            folder=self.scene.folder,
            name=step_prefixed(self.name, f"fault-{self.fault.kind}"),
            argv=argv,
            limit_s=limit_s,
            log=self._file,
            ready="log:watching" if self._is_kill else "log:bytes from",
        )
        if self._is_kill:
            return Planned(self.role, job, program="sh", permitted_causes=BY_FIELDKIT)
        program = self.scene.robot(self.role).profile.tools.ping
        return Planned(self.role, job, program=program, tool=Tool.PING, permitted_causes=BY_FIELDKIT)

    def await_recovery(self, lasted_s: str, limit_s: float) -> Planned:
        """Return the job that records how long the fault itself lasted, and ends when the robot has recovered.

        Args:
            lasted_s: Duration of the fault in seconds, as text, or `unknown`.
            limit_s: Time after which the job stops waiting.
        """
        answer = " up " if self._is_kill else "bytes from"
        arguments = (
            lasted_s,
            f"{self._interval_s:g}",
            self._file,
            answer,
            str(round(RECOVERED_S / self._interval_s)),
        )
        job = Job(
            folder=self.scene.folder,
            name=step_prefixed(self.name, f"fault-{self.fault.kind}-heals"),
            argv=("sh", "-c", _RECOVERY_SCRIPT, "sh", *arguments),
            limit_s=limit_s,
            log=step_prefixed(self.name, outage.log_file(self.fault.kind)),
            stdout=step_prefixed(self.name, outage.note_file(self.fault.kind)),
        )
        return Planned(self.role, job, program="grep", permitted_causes=BY_EXIT_OR_LIMIT)

    @property
    def _is_kill(self) -> bool:
        return self.fault.kind is FaultKind.KILL

    @property
    def _file(self) -> str:
        return step_prefixed(self.name, outage.observed_file(self.fault.kind))

    @property
    def _interval_s(self) -> float:
        """Time between two pings or polls; old iputils allow less than 200 ms only for root."""
        tools = self.scene.tools(self.role)
        is_slow = not self._is_kill and tools.ping is PingTool.IPUTILS_OLD and not tools.root
        return ping.OLD_IPUTILS_MIN_INTERVAL_S if is_slow else _INTERVAL_S
