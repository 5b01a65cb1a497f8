"""Telemetry sources against Debian's snmpd and an HTTP server on loopback, with correct, slow and hostile answers."""

import socket
import threading
from collections.abc import Callable, Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest

from fieldkit.config import schema
from fieldkit.telemetry import laptop_telemetry, source_readings
from fieldkit.telemetry.source_readings import SourceReadings
from fieldkit.telemetry.telemetry_section import TelemetrySource
from tests.helpers.telemetry_devices import ENTERPRISE, snmp_agent

SECRET = "fk-secret-27"


def query(text: str, **environment: str) -> SourceReadings:
    source = schema.validate(schema.parse(text, source="source.yaml"), TelemetrySource)
    return source_readings.parse(laptop_telemetry.query_once(source, environment), source)


@pytest.fixture
def agent(tmp_path: Path) -> Iterator[int]:
    with snmp_agent(tmp_path, SECRET) as port:
        yield port


def snmp(port: int, credentials: str) -> str:
    return (
        f"at: laptop\nlimit: 60s\nsnmp: {{address: 127.0.0.1, port: {port}, credentials: {credentials}}}\nvalues:\n"
        f"  signal_dbm: {{oid: {ENTERPRISE}.1.0}}\n  band: {{oid: {ENTERPRISE}.2.0}}\n"
        f"  noise_dbm: {{oid: {ENTERPRISE}.3.0}}\n  sinr_db: {{oid: {ENTERPRISE}.9.0}}\n"
    )


def test_a_real_agent(agent: int, tmp_path: Path) -> None:
    expected = {"signal_dbm": -71.0, "band": "B7", "noise_dbm": -98.5}
    by_variable = snmp(agent, "{environment: AP_SNMP}")
    assert query(by_variable, AP_SNMP=f"defCommunity {SECRET}").values == (expected,)
    folder = tmp_path / "ap"
    folder.mkdir(mode=0o700)
    (folder / "snmp.conf").write_text(f"defCommunity {SECRET}\n", encoding="ascii")
    assert query(snmp(agent, f"{{file: '{folder}/snmp.conf'}}")).values == (expected,)
    wrong = query(by_variable, AP_SNMP="defCommunity other")
    assert (wrong.values, wrong.reason) == ((), "snmpget failed with exit code 1")


Answer = Callable[[BaseHTTPRequestHandler], None]


def answer_json(handler: BaseHTTPRequestHandler) -> None:
    is_known = handler.headers.get("Authorization") == f"Bearer {SECRET}"
    body = b'{"lte": {"rsrp": "-97 dBm", "sinr": 11.5, "band": "B3"}}' if is_known else b"denied"
    handler.send_response(200 if is_known else 401)
    handler.send_header("Content-Length", str(len(body)))
    handler.end_headers()
    handler.wfile.write(body)


def answer_endlessly(handler: BaseHTTPRequestHandler) -> None:
    handler.send_response(200)
    handler.end_headers()
    while True:
        handler.wfile.write(b'{"lte": {"rsrp": -1}}' * 1000)


def answer_slowly(handler: BaseHTTPRequestHandler) -> None:
    handler.send_response(200)
    handler.end_headers()
    while not STOPPED.wait(0.1):
        handler.wfile.write(b" ")


def never_answer(_: BaseHTTPRequestHandler) -> None:
    STOPPED.wait(60)


def answer_with_a_redirect(handler: BaseHTTPRequestHandler) -> None:
    handler.send_response(302)
    handler.send_header("Location", "file:///etc/passwd")
    handler.send_header("Content-Length", "0")
    handler.end_headers()


def answer_with_garbage(handler: BaseHTTPRequestHandler) -> None:
    handler.send_response(200)
    handler.end_headers()
    handler.wfile.write(b"\x00\xff\x1b[31m" * 100)


STOPPED = threading.Event()
ANSWERS: dict[str, Answer] = {
    "/json": answer_json,
    "/endless": answer_endlessly,
    "/slow": answer_slowly,
    "/never": never_answer,
    "/redirect": answer_with_a_redirect,
    "/garbage": answer_with_garbage,
}


class Handler(BaseHTTPRequestHandler):
    def do_GET(self) -> None:
        try:
            ANSWERS[self.path](self)
        except OSError:  # the client has closed the connection
            return

    def log_message(self, *_: object) -> None:
        """Print nothing."""


@pytest.fixture(scope="module")
def server() -> Iterator[str]:
    STOPPED.clear()
    running = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    running.daemon_threads = True
    thread = threading.Thread(target=running.serve_forever)
    thread.start()
    yield f"http://127.0.0.1:{running.server_port}"
    STOPPED.set()
    running.shutdown()
    thread.join()
    running.server_close()


def http(url: str, limit: str) -> str:
    return (
        f"at: laptop\nlimit: {limit}\nhttp: {{url: '{url}', credentials: {{environment: ROUTER}}}}\n"
        "values: {signal_dbm: {json: lte.rsrp}, sinr_db: {json: lte.sinr}, band: {json: lte.band}}\n"
    )


def test_a_real_server(server: str) -> None:
    config = f'header = "Authorization: Bearer {SECRET}"'
    readings = query(http(f"{server}/json", "60s"), ROUTER=config)
    assert readings.values == ({"signal_dbm": -97.0, "sinr_db": 11.5, "band": "B3"},)
    assert query(http(f"{server}/json", "60s")).reason == "HTTP error"


@pytest.mark.parametrize(
    ("path", "limit", "reasons"),
    [
        ("/endless", "60s", {"its output was longer than 64 KiB"}),
        ("/slow", "1s", {"no answer in time", "no answer in 1 s"}),
        ("/never", "1s", {"no answer in time", "no answer in 1 s"}),
        ("/redirect", "60s", {"its output is not JSON: Expecting value: line 1 column 1 (char 0)"}),
        ("/garbage", "60s", {"its output is not JSON: Expecting value: line 1 column 1 (char 0)"}),
    ],
)
def test_wrong_answers_give_no_value(server: str, path: str, limit: str, reasons: set[str]) -> None:
    readings = query(http(server + path, limit))
    assert readings.values == ()
    assert readings.reason in reasons


def test_a_closed_port_gives_no_value() -> None:
    with socket.socket() as unused:
        unused.bind(("127.0.0.1", 0))
        assert query(http(f"http://127.0.0.1:{unused.getsockname()[1]}/", "60s")).reason == "connection refused"
