"""The base of an emulated ground robot at its socket: the process that drives it as it is told, while it is told."""

import contextlib
import select
import socket
import time
from pathlib import Path
from typing import TYPE_CHECKING, Final

from sim_backends.emulated.robot import twists
from sim_backends.emulated.robot.spec import Base
from sim_backends.emulated.ros.helm import Helm

if TYPE_CHECKING:
    from sim_backends.emulated.robot.base_controller import BaseController

_TICK_S: Final = 0.02


def serve(base: Base, *, motion: Path, steered: Path, ready: Path) -> None:
    """Serve for ever; a robot that stands takes no time.

    Args:
        base: The robot's base.
        motion: The file in which the lab says where it has put the robot (`own_motion.append_path`).
        steered: The file in which the robot says where it drives (`helm.Helm`).
        ready: Made when it serves.

    Raises:
        OSError: The socket cannot be made.
    """
    twists.CHANNEL.unlink(missing_ok=True)  # left by one that was killed
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as channel:
        channel.bind(str(twists.CHANNEL))
        channel.setblocking(False)
        helm = Helm(motion, steered, time.monotonic_ns())
        ready.touch()
        select.select([channel], [], [])
        # The physics take numpy, 20 MB and a moment: most robots of most trials are never driven.
        from sim_backends.emulated.robot.base_controller import BaseController  # noqa: PLC0415

        controller = BaseController(base, time.monotonic_ns())
        while True:
            select.select([channel], [], [], None if controller.stands else _TICK_S)
            now_ns = time.monotonic_ns()
            if (where := helm.put(now_ns)) is not None:
                controller.put(where)
            _take(channel, controller, now_ns)
            controller.advance(now_ns)
            _say(helm, controller, now_ns)


def _take(channel: socket.socket, controller: "BaseController", now_ns: int) -> None:
    """Take the velocities that have come; the last one counts."""
    with contextlib.suppress(BlockingIOError):
        while True:
            if (said := twists.unpack(channel.recv(twists.BYTES + 1))) is not None:
                controller.hear(now_ns, *said)


def _say(helm: Helm, controller: "BaseController", now_ns: int) -> None:
    pose = controller.pose
    helm.say(
        now_ns,
        pose.place_m,
        pose.velocity_m_s,
        heading_rad=pose.heading_rad,
        turn_rad_s=pose.turn_rad_s,
        wheels=controller.wheels,
    )
