"""Checks of a robot's radio interface with the output of the probe: address, SSH, offloads, Wi-Fi and power save."""

import re
from collections.abc import Mapping
from typing import Final

from fieldkit.backends.protocols import Robot
from fieldkit.config import locations
from fieldkit.core.model import Control
from fieldkit.core.units import format_count
from fieldkit.steps.scene import CommandResult
from fieldkit.trial.check.probe import MISSING_SECTION, Sections
from fieldkit.trial.check.report import Report

MARGIN_DB: Final = 10
"""A signal is reported as weak if it is below the sensitivity in the profile plus this margin."""

_FLAGS: Final = re.compile(r"^[0-9]+: \S+ <(?P<flags>[A-Z0-9_,-]*)>", re.MULTILINE)
# Uses `[ \t]` instead of `\s`, which also matches line breaks and would backtrack over empty lines.
_ADDRESS: Final = re.compile(r"^[ \t]+inet (?P<address>[0-9.]{7,15}/[0-9]{1,2})\b", re.MULTILINE)
_OFFLOADS: Final = {
    "GSO": "generic-segmentation-offload",
    "TSO": "tcp-segmentation-offload",
    "GRO": "generic-receive-offload",
}
# Lines in the output of iw 5.19 (see its source files link.c, interface.c and station.c).
_FACTS: Final = {
    "type": r"^[ \t]*type (.{1,30})$",
    "channel": r"^[ \t]*channel ([0-9]{1,3}) \(",
    "associated": r"^(?:Connected to|Joined IBSS) (\S{1,20}) \(on ",
    "ssid": r"^[ \t]*(?:SSID:|ssid) (.{1,128})$",
    "rate": r"^[ \t]*tx bitrate:[ \t]*([0-9.]{1,10} MBit/s)",
}
_SIGNAL: Final = re.compile(r"^[ \t]*signal:[ \t]+(-[0-9]{1,3}) (?:\[.*\] )?dBm", re.MULTILINE)
_POWER_SAVE: Final = re.compile(r"^Power save: (on|off)$", re.MULTILINE)


def judge(robot: Robot, sections: Sections, report: Report) -> None:
    """Report findings about the interface under test."""
    interface = robot.profile.radio.interface
    _judge_interface(robot, sections, report)
    _judge_control(robot, sections, report)
    _judge_offloads(sections, report)
    if sections.get("wifi-info", MISSING_SECTION).ok:
        _judge_wifi(robot, sections, report)
    elif (
        sections.get("wireless", MISSING_SECTION).ok
        and "link/ether" in sections.get("interface", MISSING_SECTION).text
    ):
        section = sections.get("wifi-info", MISSING_SECTION)
        if section.code == CommandResult.MISSING:
            report.warn("Wi-Fi", "signal and power save cannot be read without iw", "sudo apt-get install iw")
        else:
            report.warn("Wi-Fi", section.text, f"sudo iw dev {interface} info")


def _judge_interface(robot: Robot, sections: Sections, report: Report) -> None:
    name = robot.profile.radio.interface
    check, section = f"interface {name}", sections.get("interface", MISSING_SECTION)
    flags = _FLAGS.search(section.text)
    addresses = _ADDRESS.findall(section.text)
    if section.code == CommandResult.MISSING:
        report.fail(check, "ip is not installed", "sudo apt-get install iproute2")
    elif flags is None or is_interface_missing(sections):
        report.fail(
            check,
            section.text,
            f"ip link   # then correct radio.interface: {locations.copy_profile_command(robot.profile.name)}",
        )
    elif "UP" not in flags["flags"].split(","):
        report.fail(check, "down", f"sudo ip link set {name} up")
    elif "NO-CARRIER" in flags["flags"]:
        report.fail(
            check,
            "up, but not associated with a network: no carrier",
            f"iw dev {name} link   # then join the network",
        )
    elif robot.address not in {address.partition("/")[0] for address in addresses}:
        actual = f"has {', '.join(addresses)}" if addresses else "has no IPv4 address"
        remedy = f"ip addr   # then correct address of {robot.name} in the site file, or join its network"
        report.fail(check, f"{actual}, not {robot.address}", remedy)
    else:
        report.ok(check, f"up, {', '.join(addresses)}")


def is_interface_missing(sections: Sections) -> bool:
    """Return True if the robot has no interface with the name in its profile."""
    section = sections.get("interface", MISSING_SECTION)
    return section.code != CommandResult.MISSING and _FLAGS.search(section.text) is None


def _judge_control(robot: Robot, sections: Sections, report: Report) -> None:
    # The SSH server reports the client's address and port, then the robot's address and port.
    words = sections.get("control", MISSING_SECTION).text.split()
    if len(words) != 4:
        report.ok("control", "the SSH server does not report the addresses of the connection")
    elif words[2] != robot.address:
        report.ok("control", f"SSH does not use the radio under test: it connects to {words[2]}")
    elif robot.control is Control.RADIO:
        report.ok("control", "SSH shares the radio under test, as the site file states")
    else:
        report.warn(
            "control",
            "SSH shares the radio under test, but the site file does not contain control: radio",
            "write control: radio in the site file, or set host to its address on another network",
        )


def _judge_offloads(sections: Sections, report: Report) -> None:
    section = sections.get("offloads", MISSING_SECTION)
    states = {name: re.search(rf"^{long}: (on|off)", section.text, re.MULTILINE) for name, long in _OFFLOADS.items()}
    offloads = [f"{name} {state[1]}" for name, state in states.items() if state]
    is_missing = section.code == CommandResult.MISSING
    unknown_text = f"unknown: ethtool {'is not installed' if is_missing else 'does not report them'}"
    report.ok("offloads", ", ".join(offloads) or unknown_text)


def facts(sections: Sections) -> Mapping[str, str]:
    """Return the values in the output of `iw info` and `iw link`, by the names in `_FACTS`."""
    text = "\n".join(sections.get(name, MISSING_SECTION).text for name in ("wifi-info", "wifi-link"))
    matches = {name: re.search(pattern, text, re.MULTILINE) for name, pattern in _FACTS.items()}
    return {name: match[1] for name, match in matches.items() if match}


def _judge_wifi(robot: Robot, sections: Sections, report: Report) -> None:
    wifi_facts = facts(sections)
    interface = robot.profile.radio.interface
    is_access_point = wifi_facts.get("type") == "AP"
    if "associated" not in wifi_facts and wifi_facts.get("type") == "managed":
        report.fail("Wi-Fi", "not associated with a network", f"sudo wpa_cli -i {interface} reconnect")
        return
    signal_section = "wifi-stations" if is_access_point or "associated" not in wifi_facts else "wifi-link"
    signals = [int(signal) for signal in _SIGNAL.findall(sections.get(signal_section, MISSING_SECTION).text)]
    words = [
        f"{wifi_facts.get('type', 'unknown mode')} {wifi_facts.get('ssid', '')!r}",
        *([f"at {wifi_facts['associated']}"] if "associated" in wifi_facts else []),
        *([f"channel {wifi_facts['channel']}"] if "channel" in wifi_facts else []),
        *([format_count(len(signals), "station")] if is_access_point else []),
        *([f"{min(signals)} dBm"] if signals else []),
        *([wifi_facts["rate"]] if "rate" in wifi_facts else []),
    ]
    weak_dbm = robot.profile.radio.sensitivity_dbm + MARGIN_DB
    if signals and min(signals) < weak_dbm:
        report.warn(
            "Wi-Fi",
            f"{', '.join(words)}: weaker than {weak_dbm:g} dBm",
            f"iw dev {interface} link   # the robot may be too far away",
        )
    elif robot.profile.radio.access_point and wifi_facts.get("type") == "managed":
        report.warn(
            "Wi-Fi",
            f"{', '.join(words)}: a station, but according to its profile the robot runs an access point",
            f"start its access point, or correct the profile: {locations.copy_profile_command(robot.profile.name)}",
        )
    else:
        report.ok("Wi-Fi", ", ".join(words))
    if not is_access_point:
        _judge_power_save(interface, sections, report)


def _judge_power_save(interface: str, sections: Sections, report: Report) -> None:
    section = sections.get("wifi-power-save", MISSING_SECTION)
    state = _POWER_SAVE.search(section.text)
    if state is None:
        report.ok("power save", f"unknown: {section.text}")
    elif state[1] == "on":
        report.warn("power save", "on: delays become long and vary", f"sudo iw dev {interface} set power_save off")
    else:
        report.ok("power save", "off")
