"""Detection of the variants of a robot's tools: the commands of the probe, and the parser of its output."""

import re
from collections.abc import Iterable, Iterator
from dataclasses import replace
from itertools import pairwise
from pathlib import PurePosixPath
from types import MappingProxyType
from typing import Final

from fieldkit.config.profiles import RobotProfile
from fieldkit.core.errors import RobotError
from fieldkit.remote.command import printable, quote, with_environment
from fieldkit.steps.variants import Netcat, PingTool, Recorder, Tool, Variants, expected

PROBE_S: Final = 40.0
"""Maximum duration of the command that `probe` returns. Each tool has 6 s, because ros2, a Python program, needs 3 s
to start on a small computer."""

# Runs in POSIX sh: dash, bash, busybox ash. Standard input is empty, and a tool that does not exit is killed.
_PROBE_FUNCTION: Final = r"""run_tool() {
    printf '==> %s <==\n' "$1"
    shift
    "$@" </dev/null 2>&1 &
    tool=$!
    (trap 'kill "$!"; exit' TERM; sleep 6 & wait "$!"; kill -s KILL "$tool") >/dev/null 2>&1 &
    watchdog=$!
    wait "$tool"
    printf '\n==> exit %s <==\n' "$?"
    kill "$watchdog"
}
"""
_MARK: Final = re.compile(rb"^==> (?:(?P<name>[a-z]+)|exit (?P<code>[0-9]{1,3})) <==$", re.MULTILINE)
# Exit codes of a POSIX shell: a program that cannot be executed or is not found, and a program killed by SIGKILL (9).
_MISSING_CODES: Final = {126, 127}
_KILLED_CODE: Final = 128 + 9
_USER: Final = "user"
_ECHO: Final = "echo"

_NETCATS: Final = (
    (Netcat.OPENBSD, re.compile(r"^OpenBSD netcat.*", re.MULTILINE)),
    (Netcat.NCAT, re.compile(r"^Ncat:? .*[0-9].*", re.MULTILINE)),
    (Netcat.BUSYBOX, re.compile(r"^BusyBox v.*", re.MULTILINE)),
    (Netcat.TRADITIONAL, re.compile(r"^\[v1\.1.*", re.MULTILINE)),
)
_IPUTILS: Final = re.compile(r"^ping .*iputils[ -][a-z]*(?P<date>[0-9]{8}).*", re.MULTILINE)
_BUSYBOX: Final = re.compile(r"^BusyBox v.*", re.MULTILINE)
# iputils 20210722 lowered the minimum interval of an unprivileged user from 200 ms to 2 ms (its commit 0ccdbb9).
_NEW_IPUTILS: Final = 20210722
_TCPDUMP: Final = re.compile(r"^tcpdump version .*", re.MULTILINE)
_STORAGE: Final = re.compile(
    r"storage identifier to be used, defaults\s+to\s+['\"](?P<id>[a-z0-9_]+)['\"]", re.IGNORECASE
)
_STORAGES: Final = re.compile(r"-s \{(?P<ids>[a-z0-9_,\s]+)\}")


def probe(profile: RobotProfile, tools: Iterable[Tool] = Tool) -> tuple[str, ...]:
    """Return a command that prints the output of each tool for `parse`, and changes nothing on the robot."""
    names = profile.tools
    ros = profile.ros
    commands_by_tool: dict[Tool, tuple[tuple[str, tuple[str, ...]], ...]] = {
        Tool.NETCAT: ((Tool.NETCAT, (names.netcat, "-h")),),
        Tool.PING: (
            (Tool.PING, (names.ping, "-V")),
            (_ECHO, (names.ping, "-c", "1", "-i", "0.2", "-W", "1", "127.0.0.1")),
        ),
        Tool.CAPTURE: ((Tool.CAPTURE, (names.capture, "--help")),),
    }
    if ros is not None:
        help_command = with_environment((*_record_command(profile), "--help"), setup=ros.command.setup)
        commands_by_tool[Tool.RECORDER] = ((Tool.RECORDER, help_command),)
    probed_tools = [
        tool
        for tool in commands_by_tool
        if tool in set(tools) and (tool is not Tool.RECORDER or _record_command(profile))
    ]
    named_commands = [
        (_USER, ("id", "-u")),
        *(command for tool in probed_tools for command in commands_by_tool[tool]),
    ]
    calls = "".join(f"run_tool {name} {quote(argv)}\n" for name, argv in named_commands)
    return ("sh", "-c", _PROBE_FUNCTION + calls)


def parse(output: bytes, profile: RobotProfile) -> Variants:
    """Return the variants of tools, from the output of `probe`. A tool that was not probed has the expected variant.

    Raises:
        RobotError: A tool is missing, is of an unknown kind, did not exit in time, or lacks a permission. A missing
            recorder is not an error: it has the variant `NONE`.
    """
    outputs = dict(_sections(output))
    if _USER not in outputs:
        raise RobotError(
            f"its tools cannot be identified: {printable(output) or 'no answer'}",
            remedy="log in and check that its login shell is a POSIX shell: echo $SHELL",
        )
    variants = replace(expected(profile), root=outputs[_USER][0].strip() == "0")
    versions: dict[Tool, str] = {}
    if Tool.NETCAT in outputs:
        kind, versions[Tool.NETCAT] = _parse_netcat(*outputs[Tool.NETCAT], profile.tools.netcat)
        variants = replace(variants, netcat=kind)
    if Tool.PING in outputs:
        ping, versions[Tool.PING] = _parse_ping(*outputs[Tool.PING], profile.tools.ping)
        variants = replace(variants, ping=ping)
    if _ECHO in outputs:
        _require_ping(outputs[_ECHO][0], profile.tools.ping, variants.ping)
    if Tool.CAPTURE in outputs:
        has_immediate_mode, versions[Tool.CAPTURE] = _parse_capture(*outputs[Tool.CAPTURE], profile.tools.capture)
        variants = replace(variants, immediate_mode=has_immediate_mode)
    if Tool.RECORDER in outputs:
        variants = replace(variants, recorder=_parse_recorder(*outputs[Tool.RECORDER], profile))
    return replace(variants, versions=MappingProxyType(versions))


def _sections(output: bytes) -> Iterator[tuple[str, tuple[str, int]]]:
    """Yield the result of each tool: its name, its output, and its exit code."""
    start = None
    for mark in _MARK.finditer(output):
        if start is None:
            start = mark if mark["name"] else None
        elif mark["code"]:
            text = output[start.end() + 1 : mark.start() - 1].decode("utf-8", "replace")
            yield start["name"].decode(), (text, int(mark["code"]))
            start = None


def _record_command(profile: RobotProfile) -> tuple[str, ...]:
    """Return the record command without its options; empty if it is a program whose `--help` is unknown."""
    words = profile.ros.command.record if profile.ros else ("",)
    verbs = {"rosbag": ("record",), "ros2": ("bag", "record")}
    verb = verbs.get(PurePosixPath(words[0]).name)
    return () if verb is None or words[1 : 1 + len(verb)] != verb else (words[0], *verb)


def _parse_netcat(text: str, code: int, program: str) -> tuple[Netcat, str]:
    for kind, pattern in _NETCATS:
        if match := pattern.search(text):
            return kind, printable(match[0].encode())
    raise _unknown_tool_error(
        text, code, program, "sudo apt-get install netcat-traditional, and write netcat: nc.traditional"
    )


def _parse_ping(text: str, code: int, program: str) -> tuple[PingTool, str]:
    if match := _IPUTILS.search(text):
        is_new = int(match["date"]) >= _NEW_IPUTILS
        return PingTool.IPUTILS if is_new else PingTool.IPUTILS_OLD, printable(match[0].encode())
    if match := _BUSYBOX.search(text):
        return PingTool.BUSYBOX, printable(match[0].encode())
    raise _unknown_tool_error(text, code, program, "sudo apt-get install iputils-ping, and write ping: ping")


def _require_ping(text: str, program: str, kind: PingTool) -> None:
    if "bytes from 127.0.0.1" not in text:
        raise RobotError(
            f"{program} cannot ping 127.0.0.1 (-i 0.2): {printable(text.encode()) or 'no answer'}",
            remedy="sudo apt-get install iputils-ping"
            if kind is PingTool.BUSYBOX
            else f"sudo setcap cap_net_raw+ep $(command -v {quote((program,))})",
        )


def _parse_capture(text: str, code: int, program: str) -> tuple[bool, str]:
    if match := _TCPDUMP.search(text):
        return "--immediate-mode" in text, printable(match[0].encode())
    raise _unknown_tool_error(text, code, program, "sudo apt-get install tcpdump, and write capture: tcpdump")


def _parse_recorder(text: str, code: int, profile: RobotProfile) -> Recorder:
    if profile.ros is None:
        return Recorder.NONE
    is_ros1 = profile.ros.variant == "ros1"
    if ("rosbag record" if is_ros1 else "ros2 bag record") not in text:
        if code == _KILLED_CODE:
            raise _timeout_error(" ".join((*_record_command(profile), "--help")))
        return Recorder.NONE
    if is_ros1:
        return Recorder.ROSBAG
    words = profile.ros.command.record
    storage_options = [value for option, value in pairwise(words) if option in {"-s", "--storage"}]
    default = _STORAGE.search(text)
    storage = (
        storage_options[-1]
        if storage_options
        else default["id"]
        if default
        else Recorder.SQLITE3.removeprefix("ros2-")
    )
    offered_storages = _STORAGES.search(text)  # ROS 2 Foxy and older do not list the storages
    kinds = {"sqlite3": Recorder.SQLITE3, "mcap": Recorder.MCAP}
    if offered_storages and storage not in re.split(r"[,\s]+", offered_storages["ids"]):
        return Recorder.NONE
    return kinds.get(storage, Recorder.NONE)


def _timeout_error(command: str) -> RobotError:
    return RobotError(
        f"{command} did not exit in time",
        remedy=f"the robot may be busy: try again, or run on it: uptime; time {command}",
    )


def _unknown_tool_error(text: str, code: int, program: str, remedy: str) -> RobotError:
    if code == _KILLED_CODE:
        return _timeout_error(program)
    problem = f"there is no {program}" if code in _MISSING_CODES else f"{program} is of an unknown kind"
    excerpt = printable(text.encode(), limit=100)
    return RobotError(f"{problem}: {excerpt}" if excerpt else problem, remedy=f"{remedy} in its profile")
