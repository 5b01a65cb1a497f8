"""The client of a lab in the virtual machine: the machine's relay program runs here and forwards to a local lab."""

import socket
import subprocess
import threading
from collections.abc import Iterator, Mapping
from pathlib import Path

import pytest

from fieldkit.config.profiles import load_profile
from fieldkit.core.deadline import Deadline
from fieldkit.core.errors import ConfigurationError, LinkError, TestbedLostError
from fieldkit.core.model import Vector
from fieldkit.lab import folder
from fieldkit.lab.protocol import Overview
from fieldkit.lab.robots import Destination, LabRobot
from sim_backends.emulated import interactive_lab
from sim_backends.emulated.emulated_options import EmulatedOptions
from sim_backends.emulated.linux_wifi import lab_relay
from sim_backends.emulated.linux_wifi.guest_lab import GuestLab
from sim_backends.emulated.linux_wifi.streams import ChannelStreams
from sim_backends.world.world import load_world
from tests.helpers.runs import fieldkit

pytestmark = pytest.mark.emulated

LIMIT_S = 60.0
MEMBERS = {
    name: LabRobot(name, load_profile("turtlebot3_burger"), f"10.42.0.{number}")
    for number, name in enumerate(("robot-1", "robot-2"), start=1)
}


def draw_overview(places_m: Mapping[str, Vector]) -> Overview:
    return interactive_lab.overview(MEMBERS, places_m, EmulatedOptions.defaults(), load_world("open"))


@pytest.fixture(scope="module")
def directory(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """The folder of a running lab, with a name that needs quoting."""
    path = tmp_path_factory.mktemp("a 100% lab")
    started = fieldkit(path, "lab", "up", "--robots", "2")
    assert started.code == 0, started.err
    yield path
    fieldkit(path, "lab", "down")


@pytest.fixture(scope="module")
def lab(directory: Path) -> Iterator[GuestLab]:
    host, guest = socket.socketpair()
    with host, guest:
        relay_thread = threading.Thread(target=lab_relay.relay, args=(guest.fileno(), folder.of_directory(directory)))
        streams = ChannelStreams(host.fileno())
        reader = threading.Thread(target=streams.run)
        for thread in (relay_thread, reader):
            thread.start()
        yield GuestLab(streams, MEMBERS, lambda: None, draw_overview, Deadline.after(LIMIT_S))
        host.shutdown(socket.SHUT_RDWR)
        for thread in (relay_thread, reader):
            thread.join(LIMIT_S)
            assert not thread.is_alive()


def test_state_and_moves_are_those_of_the_lab(lab: GuestLab, directory: Path) -> None:
    assert lab.programs("robot-1")[:2] == ("sshd", "sensors")
    assert lab.move("robot-1", Destination(20.0, 10.0, None, relative=False)) == pytest.approx((20, 10, 0.2))
    assert lab.place_m("robot-1") == pytest.approx((20, 10, 0.2))
    assert lab.overview().robots["robot-1"] == pytest.approx((20, 10))
    with pytest.raises(ConfigurationError, match="robot-3"):
        lab.move("robot-3", Destination(0, 0, None, relative=True))


def test_ssh_logs_in_on_a_robot_through_the_channel(lab: GuestLab, directory: Path, tmp_path: Path) -> None:
    key, known_hosts = tmp_path / "key", tmp_path / "known"
    key.touch(mode=0o600)
    key.write_text(lab.login.private_key)
    known_hosts.write_text("".join(f"{name} {host_key}\n" for name, host_key in lab.login.host_keys.items()))
    robot_socket = lab.connect("robot-2", LIMIT_S)
    robot_socket.settimeout(None)
    listener = socket.create_server(("127.0.0.1", 0))

    def forward_connection() -> None:
        client, _ = listener.accept()
        with client, robot_socket:
            lab_relay._copy_both_ways(client, robot_socket)

    with listener:
        thread = threading.Thread(target=forward_connection)
        thread.start()
        options = ("-i", str(key), "-o", f"UserKnownHostsFile={known_hosts}", "-o", "HostKeyAlias=robot-2", "-n")
        port = str(listener.getsockname()[1])
        argv = ("ssh", "-F", "none", *options, "-p", port, f"{lab.login.user}@127.0.0.1", "hostname; seq 50000")
        login = subprocess.run(argv, capture_output=True, text=True, timeout=LIMIT_S, check=False)
        thread.join(LIMIT_S)
    assert login.stdout.splitlines() == ["robot-2", *map(str, range(1, 50_001))], login.stderr


def test_errors_of_the_lab_reach_the_client(lab: GuestLab) -> None:
    with pytest.raises(ConnectionError, match="no robot 'robot-9'"):
        lab.connect("robot-9", LIMIT_S)


def test_a_machine_that_has_exited_is_reported() -> None:
    def check_alive() -> None:
        raise TestbedLostError("ended")

    with socket.socketpair()[0] as host, pytest.raises(TestbedLostError, match="ended"):
        GuestLab(ChannelStreams(host.fileno()), MEMBERS, check_alive, draw_overview, Deadline.after(LIMIT_S))


def test_an_invalid_answer_of_the_machine_is_reported() -> None:
    host, guest = socket.socketpair()
    with host, guest:
        streams = ChannelStreams(host.fileno())
        reader = threading.Thread(target=streams.run)
        reader.start()

        def answer() -> None:
            guest.recv(7)  # the frame that opens the stream
            guest.sendall(b"\x00\x00\x00\x00\x01\x00\x02{}\x00\x00\x00\x00\x02\x00\x00")

        threading.Thread(target=answer).start()
        with pytest.raises(LinkError, match="no valid answer"):
            GuestLab(streams, MEMBERS, lambda: None, draw_overview, Deadline.after(LIMIT_S))
        host.shutdown(socket.SHUT_RDWR)
        reader.join(LIMIT_S)
