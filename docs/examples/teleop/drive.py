"""The rover's program for teleoperation: print each command, and `stop` if no command arrives for half a second."""

import contextlib
import socket

STOP_AFTER_S = 0.5

commands = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
commands.bind(("", 9000))
is_driving = False
with contextlib.suppress(KeyboardInterrupt):
    while True:
        commands.settimeout(STOP_AFTER_S if is_driving else None)
        try:
            command, is_driving = commands.recv(100).decode(), True
        except TimeoutError:
            command, is_driving = "stop", False
        print(command, flush=True)
