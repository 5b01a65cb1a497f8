"""ProxyCommand of ssh: obtain a socket to a robot from the lab's process and pass it to ssh.

Usage: connect.py SOCKET ROBOT. The script does not import fieldkit, so that it starts quickly, in any directory.
"""

import socket
import sys

TIMEOUT_S = 20.0


def main(path: str, robot: str) -> int:
    """Pass the robot's socket to ssh over standard output (`ProxyUseFdpass` in ssh_config(5)).

    Return the exit code: 1 if the lab passed no socket; its message is then printed to standard error.
    """
    try:
        with socket.socket(socket.AF_UNIX) as lab:
            lab.settimeout(TIMEOUT_S)
            lab.connect(path)
            lab.sendall(f"connect {robot}\n".encode())
            message, descriptors, _, _ = socket.recv_fds(lab, 4096, 1)
    except OSError as error:
        message, descriptors = f"the lab does not answer: {error}; fieldkit lab ps".encode(), []
    if not descriptors:
        sys.stderr.write(f"{message.decode(errors='replace')}\n")
        return 1
    with socket.socket(fileno=sys.stdout.fileno()) as ssh:
        socket.send_fds(ssh, [b"\0"], descriptors)
        ssh.detach()
    return 0


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
