"""Devices that telemetry sources query: an SNMP agent, an HTTP server with JSON, and a modem on the system bus."""

import os
import shutil
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Final

from typing_extensions import override

from fieldkit.core.deadline import Deadline
from tests.helpers.sshd import free_port, wait_until

ENTERPRISE: Final = "1.3.6.1.4.1.99999.1"
_OBJECTS: Final = f"""\
override .{ENTERPRISE}.1.0 integer -71
override .{ENTERPRISE}.2.0 octet_str "B7"
override .{ENTERPRISE}.3.0 octet_str "-98.5 dBm"
"""
_BUS: Final = """\
<busconfig><type>system</type><auth>EXTERNAL</auth><listen>unix:path={bus}</listen>
<policy context="default"><allow send_destination="*" eavesdrop="true"/><allow eavesdrop="true"/>
<allow own="*"/><allow user="*"/></policy></busconfig>
"""
_MODEM: Final = Path(__file__).parent / "mock_modem.py"


@contextmanager
def snmp_agent(folder: Path, community: str) -> Iterator[int]:
    """Run Debian's snmpd on loopback; yield its port."""
    program = shutil.which("snmpd", path="/usr/sbin:/usr/bin")
    assert program is not None, "install snmpd: .ci/install --dev"
    port = free_port()
    config = folder / "snmpd.conf"
    config.write_text(f"agentAddress udp:127.0.0.1:{port}\nrocommunity {community}\n{_OBJECTS}", encoding="utf-8")
    # -C: only this file; its state is in the folder.
    words = (program, "-f", "-Lf", str(folder / "log"), "-C", "-c", str(config), "-I", "-smux")
    process = subprocess.Popen(words, env={"SNMP_PERSISTENT_DIR": str(folder), "PATH": "/usr/bin:/usr/sbin"})
    try:
        bound = f":{port:04X} "
        wait_until(lambda: bound in Path("/proc/net/udp").read_text(encoding="ascii"), Deadline.after(60))
        yield port
    finally:
        process.kill()
        process.wait()


@contextmanager
def json_server(text: bytes) -> Iterator[int]:
    """Run an HTTP server on loopback that answers each request with a text; yield its port."""

    class Answer(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            self.send_response(200)
            self.send_header("Content-Length", str(len(text)))
            self.end_headers()
            self.wfile.write(text)

        @override
        def log_message(self, format: str, *args: object) -> None: ...

    server = ThreadingHTTPServer(("127.0.0.1", 0), Answer)
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    try:
        yield server.server_port
    finally:
        server.shutdown()
        thread.join()
        server.server_close()


@contextmanager
def modem_bus(folder: Path) -> Iterator[str]:
    """Run a system bus with one LTE modem; yield its address, which mmcli reads from DBUS_SYSTEM_BUS_ADDRESS."""
    assert shutil.which("mmcli") is not None, "install modemmanager: .ci/install --dev"
    bus, config, ready = folder / "bus", folder / "bus.conf", folder / "ready"
    config.write_text(_BUS.format(bus=bus), encoding="utf-8")
    address = f"unix:path={bus}"
    daemon = subprocess.Popen(("dbus-daemon", f"--config-file={config}", "--nofork"), stderr=subprocess.DEVNULL)
    mock = None
    try:
        wait_until(bus.exists, Deadline.after(60))
        # Debian's Python has dbusmock.
        environment = os.environ | {"DBUS_SYSTEM_BUS_ADDRESS": address}
        words = ("/usr/bin/python3", str(_MODEM), str(ready))
        mock = subprocess.Popen(words, env=environment, stdout=subprocess.DEVNULL, stderr=sys.stderr)
        wait_until(lambda: ready.exists() or mock.poll() is not None, Deadline.after(60))
        assert mock.poll() is None
        yield address
    finally:
        for process in filter(None, (mock, daemon)):
            process.kill()
            process.wait()
