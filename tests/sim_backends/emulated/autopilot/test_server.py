"""The autopilot's process with datagrams that are not MAVLink, that were altered, or that have arbitrary values."""

import random
import re
import select
import socket
import struct
import subprocess
import sys
import time
from pathlib import Path
from typing import Final

from pymavlink.dialects.v20 import common as d

from tests.fuzz.mutate import mutated
from tests.helpers.drones import Sender

SYSTEM: Final = 7
DATAGRAMS: Final = 3_000
PROGRAM: Final = """
import sys
from pathlib import Path
from sim_backends.emulated.autopilot.mavlink_server import Drone, serve
from sim_backends.world.world import load_world

port, folder = int(sys.argv[1]), Path(sys.argv[2])
world = load_world("lawn").model_dump_json()
drone = Drone(7, port, "px4", "duckiedrone", 3.0, max_height_m=30.0, fence_m=100.0, antenna_m=0.1, world=world)
serve(drone, assigned_paths=folder / "motion", motion_record=folder / "steered", ready=folder / "ready")
"""


def frame_with_any_values(rng: random.Random) -> bytes:
    """Return a valid frame of any message with arbitrary field values; most are addressed to the drone."""
    message_class = rng.choice(list(d.mavlink_map.values()))
    link = d.MAVLink(None, srcSystem=rng.randrange(1, 256), srcComponent=190)
    size = struct.calcsize(message_class.unpacker.format)
    payload = bytearray(rng.choice((rng.randbytes(size), bytes(size), b"\xff" * size)))
    offset = 0
    for name, field_format in zip(
        message_class.ordered_fieldnames, re.findall("[0-9]*[a-zA-Z]", message_class.unpacker.format), strict=True
    ):
        if name in {"target_system", "target_component"} and rng.random() < 0.9:
            payload[offset] = SYSTEM if name == "target_system" else 1
        offset += struct.calcsize(f"<{field_format}")
    packed: bytes = d.MAVLink_message(message_class.id, message_class.msgname)._pack(
        link, message_class.crc_extra, bytes(payload)
    )
    return packed


def free_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as endpoint:
        endpoint.bind(("", 0))
        port: int = endpoint.getsockname()[1]
        return port


def heartbeat(port: int) -> d.MAVLink_message:
    """Return the heartbeat that the drone sends to a new client, within a minute."""
    sender, end_s = Sender(255, 190), time.monotonic() + 60
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as endpoint:
        while time.monotonic() < end_s:
            endpoint.sendto(sender.frame(d.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3)), ("127.0.0.1", port))
            if select.select([endpoint], [], [], 0.5)[0]:
                for message in d.MAVLink(None).parse_buffer(endpoint.recv(65_536)) or ():
                    if message.get_type() == "HEARTBEAT":
                        return message
    raise AssertionError("no heartbeat")


def test_the_process_survives_any_datagrams_without_output(tmp_path: Path) -> None:
    rng, port, sender = random.Random(11), free_port(), Sender(255, 190)
    valid_frames = [
        sender.frame(message)
        for message in (
            d.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3),
            d.MAVLink_command_long_message(SYSTEM, 1, d.MAV_CMD_COMPONENT_ARM_DISARM, 0, 1, 0, 0, 0, 0, 0, 0),
            d.MAVLink_param_set_message(SYSTEM, 1, b"GF_MAX_HOR_DIST", 10.0, d.MAV_PARAM_TYPE_REAL32),
            d.MAVLink_mission_count_message(SYSTEM, 1, 3),
        )
    ]
    argv = (sys.executable, "-c", PROGRAM, str(port), str(tmp_path))
    with subprocess.Popen(argv, stderr=subprocess.PIPE) as autopilot:
        try:
            first_heartbeat = heartbeat(port)
            clients = [socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(4)]
            for number in range(DATAGRAMS):
                datagram = (
                    mutated(rng.choice(valid_frames), valid_frames, rng)[:60_000]
                    if number % 3
                    else frame_with_any_values(rng)
                )
                clients[number % 4].sendto(datagram, ("127.0.0.1", port))
            for client in clients:
                client.close()
            assert heartbeat(port).get_srcSystem() == first_heartbeat.get_srcSystem() == SYSTEM
            assert autopilot.poll() is None
        finally:
            autopilot.kill()
            _, errors = autopilot.communicate()
    assert errors == b""
