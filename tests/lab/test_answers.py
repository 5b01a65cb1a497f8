"""Messages of the lab process: packed messages are unpacked unchanged, and invalid messages are refused."""

import os
import socket
import tempfile
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from fieldkit.core.errors import ConfigurationError, FieldkitError, LinkError, RobotError
from fieldkit.lab import requests
from fieldkit.lab.folder import LabFolder
from fieldkit.lab.protocol import LabLateness, LabLink, Outline, Overview
from fieldkit.lab.requests import LabState, RobotState
from fieldkit.lab.robots import Destination

STATE = LabState(
    pid=4711,
    up_s=2.5,
    robots=(RobotState("a", "turtlebot3_burger", ("sender (master)",), "10.42.0.1", (1.0, 2.0, 0.5), ("sshd",)),),
    lateness=LabLateness(0.1, 0.002, None, 4, 0),
)
OVERVIEW = Overview(
    world="lawn",
    area_m=(40.0, 30.0),
    outlines=[Outline("wood", ((1.0, 1.0), (2.0, 1.0), (2.0, 3.0)))],
    robots={"a": (1.0, 2.0), "b": (4.0, 2.0)},
    links=[LabLink(("a", "b"), 31.5, True, ("tree",))],
)
UNPACK_FUNCTIONS = [requests.unpack_state, requests.unpack_overview, requests.unpack_place_m]


def test_packed_answers_are_read_unchanged() -> None:
    assert requests.unpack_state(requests.pack_state(STATE)) == STATE
    assert requests.unpack_overview(requests.pack_overview(OVERVIEW)) == OVERVIEW
    assert requests.unpack_place_m(requests.pack_place((1.0, -2.0, 0.5))) == (1.0, -2.0, 0.5)


@pytest.mark.parametrize("up_m", [None, 1.5])
def test_packed_destination_is_a_single_line(up_m: float | None) -> None:
    destination = Destination(east_m=3.0, north_m=-1.0, up_m=up_m, relative=True)
    request = requests.pack_destination(destination)
    assert "\n" not in request
    assert requests.unpack_destination(request) == destination


@pytest.mark.parametrize("unpack", UNPACK_FUNCTIONS)
@pytest.mark.parametrize(
    ("packed_error", "expected_error"),
    [(ConfigurationError, ConfigurationError), (LinkError, LinkError), (RobotError, LinkError)],
)
def test_packed_error_is_raised_when_unpacked(
    unpack: Callable[[bytes], object], packed_error: type[FieldkitError], expected_error: type[FieldkitError]
) -> None:
    with pytest.raises(expected_error, match="no such place") as error_info:
        unpack(requests.pack_error(packed_error("no such place", remedy="look at the map")))
    assert type(error_info.value) is expected_error
    assert error_info.value.remedy == "look at the map"


@pytest.mark.parametrize("unpack", UNPACK_FUNCTIONS)
@pytest.mark.parametrize("answer", [b"", b"{", b"[]", b"null", b"{}", b'{"error": 3}', b'{"place_m": ["1", 2, 3]}'])
def test_invalid_answer_is_value_error(unpack: Callable[[bytes], object], answer: bytes) -> None:
    with pytest.raises(ValueError, match=r"\S"):
        unpack(answer)


@pytest.mark.parametrize(
    "request_", ["", "{}", "[1, 2]", '{"east_m": "1", "north_m": 2, "up_m": 0, "relative": false}']
)
def test_invalid_destination_is_value_error(request_: str) -> None:
    with pytest.raises(ValueError, match=r"\S"):
        requests.unpack_destination(request_)


@pytest.fixture
def listener() -> Iterator[tuple[LabFolder, socket.socket]]:
    """Socket of a lab that accepts no connection, in a folder with a short path."""
    with tempfile.TemporaryDirectory() as path, socket.socket(socket.AF_UNIX) as lab:
        lab.bind(str(LabFolder(Path(path)).socket))
        lab.listen()
        yield LabFolder(Path(path)), lab


def test_a_lab_that_exits_before_it_accepts_the_connection_is_no_lab(
    listener: tuple[LabFolder, socket.socket],
) -> None:
    """The kernel closes the sockets of a killed lab a few milliseconds after its main thread has exited."""
    folder, lab = listener
    exit_of_lab = threading.Timer(0.2, lab.close)
    exit_of_lab.start()
    try:
        with pytest.raises(requests.NoLabError, match="no lab is running"):
            requests.state(folder)
    finally:
        exit_of_lab.join()


def test_the_end_of_a_lab_that_has_just_exited_is_no_lab(
    listener: tuple[LabFolder, socket.socket], monkeypatch: pytest.MonkeyPatch
) -> None:
    def no_such_process(_pid: int, _flags: int = 0) -> int:
        raise ProcessLookupError

    monkeypatch.setattr(os, "pidfd_open", no_such_process)
    with pytest.raises(requests.NoLabError, match="no lab is running"):
        requests.end(listener[0])
