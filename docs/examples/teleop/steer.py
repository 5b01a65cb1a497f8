"""The operator's program for teleoperation: send ten commands per second to the rover, for some seconds."""

import socket
import sys
import time

rover, seconds = sys.argv[1], float(sys.argv[2])
commands = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
for number in range(round(10 * seconds)):
    commands.sendto(f"drive {number}".encode(), (rover, 9000))
    time.sleep(0.1)
