"""The operator's side: send the rover ten commands a second, for so many seconds."""

import socket
import sys
import time

rover, seconds = sys.argv[1], float(sys.argv[2])
commands = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
for number in range(round(10 * seconds)):
    commands.sendto(f"drive {number}".encode(), (rover, 9000))
    time.sleep(0.1)
