"""Preflight check of the connection to an autopilot: its kind, and the programs that use it."""

import json

import pytest

from fieldkit.core.model import Role, Verdict
from fieldkit.motion.steps.link_need import link_need
from fieldkit.steps.scene import CommandResult
from tests.helpers.casts import CAST

REACHABLE = json.dumps({"error": "", "system": 7, "candidates": []})
CONNECTION_REFUSED = json.dumps(
    {"error": "Connection refused", "system": 0, "candidates": ["TCP port 5760", "/dev/ttyACM0"]}
)
NO_AUTOPILOT = json.dumps({"error": "", "system": 0, "candidates": []})


@pytest.mark.parametrize(
    ("connection", "kind"),
    [
        ("udpout:127.0.0.1:14550", "UDP, the robot sends first"),
        ("udpin:0.0.0.0:14551", "UDP, the autopilot sends first"),
        ("tcp:127.0.0.1:5760", "TCP"),
        ("/dev/ttyAMA0:921600", "serial line"),
    ],
)
def test_detail_names_connection_and_programs(connection: str, kind: str) -> None:
    need = link_need(CAST[Role.RECEIVER], Role.RECEIVER, connection, ("pilot", "guard"))
    assert connection in need.argv[-1]
    assert need.judge(CommandResult(REACHABLE, 0)) == (
        Verdict.OK,
        f"{connection} ({kind}) reaches system 7; pilot and guard use it through the link server",
        "",
    )


@pytest.mark.parametrize(
    ("text", "detail", "remedy"),
    [
        (
            CONNECTION_REFUSED,
            "cannot be opened: Connection refused",
            "the robot's computer has TCP port 5760, /dev/ttyACM0; write",
        ),
        (NO_AUTOPILOT, "no heartbeat from an autopilot", "no other common connection"),
        ("error: MAVLink over usb: is not a connection", "is not a connection", "mavlink.connection"),
        ("", "no answer", "mavlink.connection"),
        ("[]", "[]", "mavlink.connection"),
    ],
)
def test_failure_names_available_connections(text: str, detail: str, remedy: str) -> None:
    need = link_need(CAST[Role.RECEIVER], Role.RECEIVER, "tcp:127.0.0.1:5760", ("recorder",))
    verdict, problem, suggestion = need.judge(CommandResult(text, 0))
    assert verdict is Verdict.FAIL
    assert detail in problem
    assert remedy in suggestion
