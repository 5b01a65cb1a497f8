"""A job in the virtual machine of `test_wifi_meshes.py`: babeld and batman-adv on Linux's Wi-Fi, after WPA3.

It prints results as JSON. The labs have three robots in topology `master`; in a mesh, the relay is no access point.
"""

import json
import sys
import time

from fieldkit.core.model import Protocol, Role, Vector
from fieldkit.steps import routing
from fieldkit.steps.scene import Scene
from fieldkit.telemetry.source_outputs import mesh_values
from fieldkit.telemetry.telemetry_section import TelemetrySource
from tests.sim_backends.emulated.linux_wifi.variants_job import (
    ADDRESSES,
    CAST,
    GAP,
    JOIN_S,
    ROW,
    TRIANGLE,
    Running,
    lab,
    ping,
    run_on_robot,
    wait_for_link,
)

BABEL = {"protocol": "babel", "hello": "500ms"}
BATMAN = {"protocol": "batman-adv", "hello": "500ms"}
RECEIVER = ADDRESSES[Role.RECEIVER]
# The receiver is in range of the sender, and the relay is not.
DIRECT: dict[str, Vector] = {**GAP, "r1": (60.0, 0.0, 1.0)}

SHOW_ROUTE = {
    "babel": ("ip", "-4", "route", "show", "proto", "babel", RECEIVER),
    "batman-adv": ("batctl", "meshif", "bat0", "originators", "-n", "-H"),
}
QUERY = TelemetrySource.model_validate({"batctl": {"interface": "bat0"}}).argv()


def wait_for_loss(running: Running, protocol: str) -> bool:
    """Wait until the sender reports the loss: babeld has removed the route, or batctl lists no neighbour."""
    end_s = time.monotonic() + JOIN_S
    while time.monotonic() < end_s:
        output = run_on_robot(running, Role.SENDER, *(QUERY if protocol == "batman-adv" else SHOW_ROUTE[protocol]))
        if not (mesh_values(output)["neighbours"] if protocol == "batman-adv" else output.strip()):
            return True
    return False


def ping_output(running: Running) -> str:
    return run_on_robot(running, Role.SENDER, "ping", "-n", "-c", "20", "-i", "0.2", "-W", "1", RECEIVER)


def measure(running: Running, protocol: str) -> dict[str, object]:
    """Return the results of a mesh: forwarding by the relay, loss of the relay, its return, and a direct route."""
    show_route = SHOW_ROUTE[protocol]
    results: dict[str, object] = {}

    def record_result(name: str, value: object) -> None:
        results[name] = value
        sys.stdout.write(f"{time.monotonic():.0f} s: {protocol}: {name} = {value}\n")
        sys.stdout.flush()

    running.medium.place(ROW)
    record_result("link", wait_for_link(running))
    record_result("ping", ping_output(running))
    record_result("route", run_on_robot(running, Role.SENDER, *show_route))
    (check, *_) = routing.needs(Scene(Protocol.UDP, CAST, "f"))
    record_result("routing", run_on_robot(running, Role.SENDER, *check.argv))
    record_result("addresses", {role: run_on_robot(running, role, "ip", "-br", "link") for role in CAST})
    if protocol == "batman-adv":
        record_result("telemetry", {role: run_on_robot(running, role, *QUERY) for role in CAST})
    running.medium.place(GAP)
    record_result("is lost", wait_for_loss(running, protocol))
    record_result("ping without relay", ping(running, 3))
    running.medium.place(ROW)
    record_result("link again", wait_for_link(running))
    running.robots[Role.RELAY].switch_off()
    record_result("is lost without radio", wait_for_loss(running, protocol))
    running.robots[Role.RELAY].switch_on()
    record_result("link with radio", wait_for_link(running))
    running.medium.place(DIRECT)
    record_result("direct link", wait_for_link(running))
    record_result("direct route", run_on_robot(running, Role.SENDER, *show_route))
    record_result("direct ping", ping_output(running))
    return results


def main() -> None:
    results: dict[str, object] = {}
    with lab({"security": "wpa3", "monitor": True}) as running:
        running.medium.place(TRIANGLE)
        results["WPA3 link"] = wait_for_link(running)
        # Its wpa_supplicant is killed, so the interface keeps this mode.
        results["WPA3 interface"] = run_on_robot(running, Role.SENDER, "ip", "-o", "link", "show", "wlan0")
    for mesh in (BABEL, BATMAN):
        with lab({}, mesh={**mesh}) as running:
            results[mesh["protocol"]] = measure(running, mesh["protocol"])
    sys.stdout.write(f"RESULTS {json.dumps(results)}\n")


if __name__ == "__main__":
    main()
