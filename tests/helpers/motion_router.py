"""A MAVLink router similar to mavlink-router, for one autopilot: clients connect by TCP, the autopilot uses UDP.

`python3 motion_router.py PORT AUTOPILOT_PORT` runs on the robot. All frames of a client are forwarded to the
autopilot, and all frames of the autopilot to each client.
"""

import selectors
import socket
import sys
from contextlib import suppress


def main() -> None:
    """Forward frames until the process is killed."""
    port, autopilot = int(sys.argv[1]), ("127.0.0.1", int(sys.argv[2]))
    clients: set[socket.socket] = set()
    with (
        socket.create_server(("127.0.0.1", port)) as server,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as endpoint,
        selectors.DefaultSelector() as selector,
    ):
        endpoint.bind(("127.0.0.1", 0))
        selector.register(server, selectors.EVENT_READ)
        selector.register(endpoint, selectors.EVENT_READ)
        sys.stdout.write("up\n")
        sys.stdout.flush()
        while True:
            for key, _ in selector.select():
                ready_socket = key.fileobj
                if ready_socket is server:
                    client, _ = server.accept()
                    client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                    clients.add(client)
                    selector.register(client, selectors.EVENT_READ)
                elif ready_socket is endpoint:
                    with suppress(OSError):
                        datagram = endpoint.recv(65_536)
                        for client in clients:
                            with suppress(OSError):
                                client.sendall(datagram)
                elif isinstance(ready_socket, socket.socket):
                    data = b""
                    with suppress(OSError):
                        data = ready_socket.recv(65_536)
                    if data:
                        with suppress(OSError):
                            endpoint.sendto(data, autopilot)
                    else:
                        selector.unregister(ready_socket)
                        clients.discard(ready_socket)
                        ready_socket.close()


if __name__ == "__main__":
    main()
