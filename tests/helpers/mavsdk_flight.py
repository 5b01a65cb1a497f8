"""A flight with MAVSDK, run as a program on a robot: `python -m tests.helpers.mavsdk_flight HOST PORT LOSS`.

It arms, takes off, flies to three points and lands, over a link that loses the share LOSS of the datagrams in each
direction, and prints one line of JSON. It is a separate program because MAVSDK is a C++ library with its own threads.
"""

import json
import random
import select
import socket
import sys
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from typing import Final

from mavsdk import ComponentType, Configuration, Mavsdk
from mavsdk.plugins.action import Action
from mavsdk.plugins.mission import Mission
from mavsdk.plugins.mission.mission import MissionError, MissionItem, MissionPlan
from mavsdk.plugins.telemetry import Telemetry, TelemetryError

HEIGHT_M: Final = 1.0
CORNERS_M: Final = ((0.0, 2.0), (2.0, 2.0), (2.0, 0.0))
"""Distances north and east of the take-off position."""
M_PER_DEGREE: Final = 111_319.5
"""Metres per degree near the equator and the prime meridian, with an error of at most 1 %."""
TIMEOUT_S: Final = 60.0
UPLOADS: Final = 5
NAN: Final = float("nan")


def forward_with_losses(client_socket: socket.socket, drone: tuple[str, int], loss: float) -> None:
    """Forward datagrams between the client of `client_socket` and the drone, with random losses."""
    random_source = random.Random(1)
    drone_socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    client: tuple[str, int] | None = None
    while True:
        for readable in select.select([client_socket, drone_socket], [], [])[0]:
            data, sender = readable.recvfrom(65_536)
            client = sender if readable is client_socket else client
            if client and random_source.random() >= loss:
                (drone_socket if readable is client_socket else client_socket).sendto(
                    data, drone if readable is client_socket else client
                )


def until(condition: Callable[[], bool]) -> None:
    """Wait until a condition is true, for at most `TIMEOUT_S`."""
    end_s = time.monotonic() + TIMEOUT_S
    while not condition():
        if time.monotonic() > end_s:
            raise TimeoutError(condition)
        time.sleep(0.05)


def corner(latitude: float, longitude: float, north_m: float, east_m: float) -> MissionItem:
    """The mission item that flies over a corner."""
    return MissionItem(
        latitude_deg=latitude + north_m / M_PER_DEGREE,
        longitude_deg=longitude + east_m / M_PER_DEGREE,
        relative_altitude_m=HEIGHT_M,
        speed_m_s=2.0,
        is_fly_through=True,
        gimbal_pitch_deg=NAN,
        gimbal_yaw_deg=NAN,
        camera_action=MissionItem.CameraAction.NONE,
        loiter_time_s=NAN,
        camera_photo_interval_s=NAN,
        acceptance_radius_m=0.3,
        yaw_deg=NAN,
        camera_photo_distance_m=NAN,
        vehicle_action=MissionItem.VehicleAction.NONE,
    )


def upload(mission: Mission, plan: MissionPlan) -> None:
    """Upload a mission, and repeat a failed upload: the upload fails if the last MISSION_ACK is lost."""
    for _ in range(UPLOADS - 1):
        with suppress(MissionError):
            mission.upload_mission(plan)
            return
    mission.upload_mission(plan)


def request_positions(telemetry: Telemetry) -> None:
    """Request positions at 20 Hz because PX4 sends them at 1 Hz by default; repeat a lost request."""
    for _ in range(UPLOADS - 1):
        with suppress(TelemetryError):
            telemetry.set_rate_position_velocity_ned(20.0)
            return
    telemetry.set_rate_position_velocity_ned(20.0)


def fly(url: str) -> dict[str, object]:
    """Fly the mission; return the observations."""
    mavsdk = Mavsdk(Configuration.create_with_component_type(ComponentType.GROUND_STATION))
    mavsdk.add_any_connection(url)
    system = mavsdk.first_autopilot(TIMEOUT_S)
    action, mission, telemetry = Action(system), Mission(system), Telemetry(system)
    until(telemetry.health_all_ok)
    request_positions(telemetry)
    action.set_takeoff_altitude(HEIGHT_M)
    action.arm()
    action.takeoff()
    until(lambda: telemetry.position().relative_altitude_m > HEIGHT_M - 0.15)
    home = telemetry.home()
    items = [corner(home.latitude_deg, home.longitude_deg, *corner_m) for corner_m in CORNERS_M]
    upload(mission, MissionPlan(items))
    downloaded_items = mission.download_mission().mission_items
    nearest_m = [float("inf")] * len(CORNERS_M)

    def is_finished() -> bool:
        position = telemetry.position_velocity_ned().position
        for number, (north_m, east_m) in enumerate(CORNERS_M):
            distance_m = ((position.north_m - north_m) ** 2 + (position.east_m - east_m) ** 2) ** 0.5
            nearest_m[number] = min(nearest_m[number], distance_m)
        return bool(mission.is_mission_finished())

    mission.start_mission()
    until(is_finished)
    action.land()
    until(lambda: not telemetry.armed())
    battery = telemetry.battery().remaining_percent
    return {"nearest_m": nearest_m, "items": len(downloaded_items), "battery": battery}


def main(host: str, port: str, loss: str) -> None:
    """Fly the drone at this address."""
    client_socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    client_socket.bind(("127.0.0.1", 0))
    threading.Thread(
        target=forward_with_losses, args=(client_socket, (host, int(port)), float(loss)), daemon=True
    ).start()
    sys.stdout.write(json.dumps(fly(f"udpout://127.0.0.1:{client_socket.getsockname()[1]}")) + "\n")


if __name__ == "__main__":
    main(*sys.argv[1:])
