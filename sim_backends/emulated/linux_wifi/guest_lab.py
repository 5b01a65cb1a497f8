"""A lab in the virtual machine: `fieldkit lab up` runs there, and this process is its client."""

import json
import shlex
import socket
import sys
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Final, TypeVar

from fieldkit.config.json_records import Codec
from fieldkit.core.deadline import Deadline
from fieldkit.core.errors import LinkError
from fieldkit.core.model import Vector
from fieldkit.lab.protocol import Login, Overview
from fieldkit.lab.requests import RobotState, pack_destination, unpack_place_m, unpack_state
from fieldkit.lab.robots import Destination, LabRobot
from sim_backends.emulated.linux_wifi import guest
from sim_backends.emulated.linux_wifi.lab_relay import CONNECTED, GuestLogin
from sim_backends.emulated.linux_wifi.streams import ChannelStreams
from sim_backends.emulated.linux_wifi.virtual_machine import CHANNEL, Machine, require_machine, started_machine
from sim_backends.emulated.process import worker
from sim_backends.emulated.robot.mesh_options import MeshOptions
from sim_backends.emulated.robot.spec import USER

Answer = TypeVar("Answer")

_START_S: Final = 1800.0
"""Maximum time until the robots can be reached. On an idle host with an emulated processor this takes 2 minutes."""
_REPLY_S: Final = 15.0
"""Timeout of a request."""
_POLL_S: Final = 0.5
_MAX_ANSWER_BYTES: Final = 8 << 20
_LOGIN: Final = Codec(GuestLogin)
_SUBJECT: Final = "the lab in the virtual machine"
_SITE: Final = "/run/lab.yaml"
"""Path of the lab's site file in the machine."""


class GuestLab:
    """The robots of a lab in the machine.

    Args:
        streams: Streams to `lab_relay` in the machine.
        members: The robots by name.
        check_alive: Raises an error if the machine has ended.
        draw: Returns the plan view for the positions of the robots.
        deadline: Time by which the lab must answer for the first time.

    Attributes:
        members: The robots by name.
        login: The login at the robots.

    Raises:
        LinkError: The lab does not answer.
        TestbedLostError: The machine has ended.
    """

    def __init__(
        self,
        streams: ChannelStreams,
        members: Mapping[str, LabRobot],
        check_alive: Callable[[], None],
        draw: Callable[[Mapping[str, Vector]], Overview],
        deadline: Deadline,
    ) -> None:
        self._streams = streams
        self._draw = draw
        self._check_alive = check_alive
        self.members = members
        login = self._request("login", _read_login, deadline)
        self.login = Login(USER, login.private_key, login.host_keys)

    def connect(self, name: str, timeout_s: float) -> socket.socket:
        """Implement `Lab.connect`; the machine may need longer than `timeout_s`."""
        stream = self._open(f"connect {name}")
        try:
            stream.settimeout(max(timeout_s, _REPLY_S))
            _require_connection(stream)
        except BaseException:
            stream.close()
            raise
        return stream

    def programs(self, name: str) -> tuple[str, ...]:
        """Implement `Lab.programs`: the answer of the lab in the machine."""
        return self._state(name).programs

    def place_m(self, name: str) -> Vector:
        """Implement `Lab.place_m`: the answer of the lab in the machine."""
        return self._state(name).place_m

    def move(self, name: str, to: Destination) -> Vector:
        """Implement `Lab.move`: the lab in the machine moves the robot."""
        return self._request(f"move {name} {pack_destination(to)}", unpack_place_m)

    def overview(self) -> Overview:
        """Implement `Lab.overview`; it is computed here, because the machine is slow."""
        return self._draw({name: self.place_m(name) for name in self.members})

    def lateness(self) -> None:
        """Implement `Lab.lateness`: None, because the lab has no co-simulation."""
        return

    def _state(self, name: str) -> RobotState:
        state = self._request("state", unpack_state)
        return next(robot for robot in state.robots if robot.name == name)

    def _open(self, request: str) -> socket.socket:
        self._check_alive()
        stream = self._streams.open()
        stream.sendall(f"{request}\n".encode())
        return stream

    def _request(self, request: str, read: Callable[[bytes], Answer], deadline: Deadline | None = None) -> Answer:
        """Return the answer of the lab to a request, decoded by `read`."""
        deadline = deadline or Deadline.after(_REPLY_S)
        answer = b""
        with closing(self._open(request)) as stream:
            stream.settimeout(_POLL_S)
            while True:
                try:
                    data = stream.recv(1 << 16)
                except TimeoutError:
                    self._check_alive()
                    if deadline.expired:
                        raise LinkError(f"{_SUBJECT} does not answer", remedy="try again") from None
                    continue
                answer += data
                if not data or len(answer) > _MAX_ANSWER_BYTES:
                    break
        try:
            return read(answer)
        except ValueError as error:
            raise LinkError(f"{_SUBJECT} gave no valid answer: {error}") from error


def _read_login(answer: bytes) -> GuestLogin:
    return _LOGIN.parse(json.loads(answer))


def _require_connection(stream: socket.socket) -> None:
    """Read the answer to `connect`; raise ConnectionError, with the text of the answer, if it is not `CONNECTED`."""
    answer = stream.recv(len(CONNECTED))
    if answer != CONNECTED:
        raise ConnectionError((answer + stream.recv(4096)).decode(errors="replace") or "the robot does not answer")


@contextmanager
def bring_up(
    members: Mapping[str, LabRobot],
    site: Mapping[str, object],
    *,
    seed: int,
    radios: int,
    draw: Callable[[Mapping[str, Vector]], Overview],
    mesh: MeshOptions | None = None,
) -> Iterator[GuestLab]:
    """Yield the lab in a new virtual machine.

    Args:
        members: The robots by name.
        site: Content of its site file.
        seed: Seed of all random numbers of the lab.
        radios: Number of radios.
        draw: Returns the plan view for the positions of the robots.
        mesh: The robots' mesh, which may need further programs and kernel modules.

    Raises:
        ConfigurationError: A program, or the kernel of the machine, is not installed.
        TestbedLostError: The machine, or the lab in it, ended.
    """
    kernel = require_machine(mesh=mesh)
    host_end, machine_end = socket.socketpair()
    with host_end, machine_end:
        script = _script(site, Path.cwd(), seed)
        with started_machine(kernel, script, radios=radios, channel=machine_end) as machine:
            streams = ChannelStreams(host_end.fileno())
            reader = threading.Thread(target=streams.run, name="machine", daemon=True)
            reader.start()
            try:
                yield GuestLab(streams, members, lambda: _check(machine), draw, Deadline.after(_START_S))
            finally:
                host_end.shutdown(socket.SHUT_RDWR)
                reader.join()


def _check(machine: Machine) -> None:
    """Print the new output of the machine; raise TestbedLostError if it has ended."""
    sys.stderr.write(machine.new_output().decode(errors="replace"))
    machine.check_alive()


def _script(site: Mapping[str, object], folder: Path, seed: int) -> str:
    relay = shlex.join((*worker.command("sim_backends.emulated.linux_wifi.lab_relay"), CHANNEL, str(folder)))
    lab = ("lab", "up", "--foreground", "--seed", str(seed), "--site", _SITE)
    return (
        f"printf %s {shlex.quote(json.dumps(site))} > {_SITE}\n"
        + guest.prologue(folder)
        + f"{relay} &\nexec {shlex.join((*worker.command('fieldkit'), *lab))}\n"
    )
