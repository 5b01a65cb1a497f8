"""Observers of a robot while a fault befalls it: jobs that write down when it answered."""

from dataclasses import dataclass
from typing import Final

from fieldkit.core.columns import prefixed
from fieldkit.core.model import Fault, FaultKind, Role
from fieldkit.measure.evidence import recovery
from fieldkit.remote.jobs import Job
from fieldkit.steps.kinds import ping
from fieldkit.steps.scene import BY_FIELDKIT, BY_ITSELF_OR_LIMIT, Planned, Scene
from fieldkit.steps.variants import PingTool, Tool

HEALED_S: Final = 1.0
"""A robot has healed when it has answered as often as it does in this time."""

_INTERVAL_S: Final = 0.1

# Seconds since boot, `up` and the process ids while processes of the name $1 live (a zombie does not), every $2 s.
_WATCH: Final = (
    'echo "watching $1"; while :; do pids=; for file in /proc/[0-9]*/comm; do '
    'read -r name <"$file" && [ "$name" = "$1" ] && read -r stat <"${file%comm}stat" || continue; '
    'case $stat in *") Z "*) ;; *) pids="$pids ${stat%% *}" ;; esac; done 2>/dev/null; '
    'read -r now _ </proc/uptime; echo "$now${pids:+ up}$pids"; sleep "$2"; done'
)

# Writes down how long the cause lasted ($1) and the interval ($2), then waits for $5 more lines with $4 in file $3.
_HEALS: Final = (
    'echo "lasted_s $1"; echo "interval_s $2"; enough=$(($(grep -c "$4" "$3") + $5)); '
    'until [ "$(grep -c "$4" "$3")" -ge "$enough" ]; do sleep 0.1; done'
)


def observed_from(fault: Fault) -> Role:
    """Return who observes: the other end of the pair, or for a killed process the robot itself."""
    if fault.kind is FaultKind.KILL:
        return fault.role
    return Role.RECEIVER if fault.role == Role.SENDER else Role.SENDER


@dataclass(frozen=True)
class Observer:
    """Sees a robot go and come back: pings it from the other end, or watches its process on the robot itself.

    Attributes:
        scene: The attempt.
        fault: What befalls the robot.
        name: Name of the step, which jobs and files begin with; empty without one.
    """

    scene: Scene
    fault: Fault
    name: str = ""

    @property
    def role(self) -> Role:
        """The role that observes."""
        return observed_from(self.fault)

    def watch(self, limit_s: float) -> Planned:
        """Return the job that observes, up once the robot has answered; it runs until it is stopped."""
        interval = f"{self._interval_s:g}"
        if self._kills:
            argv: tuple[str, ...] = ("sh", "-c", _WATCH, "sh", self.fault.process, interval)
        else:
            argv = ping.command_line(
                self.scene, self.role, ("-i", interval), self.scene.robot(self.fault.role).address
            )
        job = Job(
            folder=self.scene.folder,
            name=prefixed(self.name, f"fault-{self.fault.kind}"),
            argv=argv,
            limit_s=limit_s,
            log=self._file,
            ready="log:watching" if self._kills else "log:bytes from",
        )
        if self._kills:
            return Planned(self.role, job, program="sh", ends=BY_FIELDKIT)
        program = self.scene.robot(self.role).profile.tools.ping
        return Planned(self.role, job, program=program, tool=Tool.PING, ends=BY_FIELDKIT)

    def heals(self, lasted_s: str, limit_s: float) -> Planned:
        """Return the job that ends when the robot has healed; first it writes down what only the testbed knows.

        Args:
            lasted_s: How many seconds the cause lasted, `unknown` where nobody knows.
            limit_s: When to give up.
        """
        answer = " up " if self._kills else "bytes from"
        words = (lasted_s, f"{self._interval_s:g}", self._file, answer, str(round(HEALED_S / self._interval_s)))
        job = Job(
            folder=self.scene.folder,
            name=prefixed(self.name, f"fault-{self.fault.kind}-heals"),
            argv=("sh", "-c", _HEALS, "sh", *words),
            limit_s=limit_s,
            log=prefixed(self.name, recovery.log_file(self.fault.kind)),
            stdout=prefixed(self.name, recovery.note_file(self.fault.kind)),
        )
        return Planned(self.role, job, program="grep", ends=BY_ITSELF_OR_LIMIT)

    @property
    def _kills(self) -> bool:
        return self.fault.kind is FaultKind.KILL

    @property
    def _file(self) -> str:
        return prefixed(self.name, recovery.observed_file(self.fault.kind))

    @property
    def _interval_s(self) -> float:
        """Time between two looks; an old ping lets only root ask more often than every 200 ms."""
        tools = self.scene.tools(self.role)
        slow = not self._kills and tools.ping is PingTool.IPUTILS_OLD and not tools.root
        return ping.OLD_INTERVAL_S if slow else _INTERVAL_S
