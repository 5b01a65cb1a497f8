"""A rover's side of a teleoperation: print each command as it comes, stop when none has come for half a second."""

import socket
import sys

STOP_AFTER_S = 0.5

commands = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
commands.bind(("", 9000))
commands.settimeout(STOP_AFTER_S)
is_driving = False
while True:
    try:
        said = commands.recv(100).decode()
        is_driving = True
    except TimeoutError:
        if not is_driving:
            continue
        said, is_driving = "stop", False
    print(said, flush=True)
    if said == "end":
        sys.exit()
