"""Checks of a robot: findings for real outputs of tools."""

import re
from collections.abc import Sequence
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fieldkit.backends.protocols import Robot
from fieldkit.config import schema
from fieldkit.core.events import Finding
from fieldkit.core.model import Control, Role, Verdict
from fieldkit.measure.robot_clock import Offset
from fieldkit.measure.robot_state.clock_report import ClockReport
from fieldkit.steps.nest import with_record
from fieldkit.steps.scene import CommandResult
from fieldkit.trial import size
from fieldkit.trial.check import contact, radio, software, system, time_sources
from fieldkit.trial.check.probe import Sections, parse
from fieldkit.trial.check.report import Report
from fieldkit.trial.plan import Plan
from fieldkit.trial.procedure import Procedure
from tests.helpers.casts import CAST, TURTLEBOT, los_plan
from tests.helpers.paths import DATA

SENDER, RECEIVER, RELAY = (CAST[role] for role in (Role.SENDER, Role.RECEIVER, Role.RELAY))
PLAN = los_plan()
OK, WARN, FAIL = Verdict.OK, Verdict.WARN, Verdict.FAIL


def read_result(name: str, code: int = 0) -> CommandResult:
    return CommandResult((DATA / name).read_text(encoding="utf-8").strip("\n"), code)


def only(findings: Sequence[Finding], check: str) -> Finding:
    (finding,) = [finding for finding in findings if finding.check == check]
    return finding


def judge_radio(robot: Robot, **sections: CommandResult) -> list[Finding]:
    """Judge the radio; each keyword is the name of a section, with underscores instead of hyphens."""
    base = {"interface": read_result("ip/6.1.0/up.txt")}
    report = Report(robot.name)
    radio.judge(robot, base | {name.replace("_", "-"): text for name, text in sections.items()}, report)
    return report.findings


@pytest.mark.parametrize(
    ("file", "code", "status", "detail"),
    [
        ("ip/6.1.0/up.txt", 0, OK, "up, 10.42.0.1/24"),
        ("busybox/1.35.0/ip-up.txt", 0, OK, "up, 10.42.0.1/24"),
        ("ip/6.1.0/down.txt", 0, FAIL, "down"),
        ("ip/6.1.0/no-carrier.txt", 0, FAIL, "no carrier"),
        ("ip/6.1.0/nope.txt", 1, FAIL, 'Device "nope" does not exist.'),
        ("busybox/1.35.0/ip-nope.txt", 1, FAIL, "can't find device 'nope'"),
    ],
)
def test_an_interface_must_be_up_and_connected(file: str, code: int, status: Verdict, detail: str) -> None:
    finding = only(judge_radio(SENDER, interface=read_result(file, code)), "interface wlan0")
    assert finding.status is status
    assert detail in finding.detail
    assert bool(finding.remedy) == (status is FAIL)


def test_an_interface_with_another_address_is_a_failure() -> None:
    finding = only(judge_radio(RECEIVER), "interface wlan0")
    assert (finding.status, finding.detail) == (FAIL, "has 10.42.0.1/24, not 10.42.0.2")


def test_the_settings_of_offloads_are_always_ok() -> None:
    finding = only(judge_radio(SENDER, offloads=read_result("ethtool/6.1/tun.txt")), "offloads")
    assert (finding.status, finding.detail) == (OK, "GSO on, TSO off, GRO on")
    assert only(judge_radio(SENDER), "offloads").status is OK


def test_a_station_has_access_point_channel_signal_and_rate() -> None:
    findings = judge_radio(
        SENDER,
        wifi_info=read_result("iw/info-station.txt"),
        wifi_link=read_result("iw/link-station.txt"),
        wifi_power_save=read_result("iw/power-save-off.txt"),
    )
    assert only(findings, "Wi-Fi").detail == (
        "managed 'knowhere', at f0:99:bf:0e:86:98, channel 11, -65 dBm, 65.0 MBit/s"
    )
    assert {finding.status for finding in findings} == {OK}


def test_a_signal_near_the_sensitivity_is_a_warning() -> None:
    link = read_result("iw/link-station.txt")
    # The TurtleBot's sensitivity is -82 dBm.
    for dbm, status in ((-72, OK), (-73, WARN)):
        link_with_signal = CommandResult(link.text.replace("-65 dBm", f"{dbm} dBm"), 0)
        findings = judge_radio(SENDER, wifi_info=read_result("iw/info-station.txt"), wifi_link=link_with_signal)
        assert only(findings, "Wi-Fi").status is status


def test_power_save_is_a_warning_with_the_command_that_disables_it() -> None:
    findings = judge_radio(
        SENDER,
        wifi_info=read_result("iw/info-station.txt"),
        wifi_link=read_result("iw/link-station.txt"),
        wifi_power_save=read_result("iw/power-save-on.txt"),
    )
    finding = only(findings, "power save")
    assert (finding.status, finding.remedy) == (WARN, "sudo iw dev wlan0 set power_save off")


def test_a_station_without_a_network_fails() -> None:
    findings = judge_radio(
        SENDER, wifi_info=read_result("iw/info-txpower.txt"), wifi_link=read_result("iw/link-none.txt")
    )
    assert only(findings, "Wi-Fi").status is FAIL


def test_an_access_point_counts_its_stations_and_needs_no_power_save() -> None:
    findings = judge_radio(
        RELAY, wifi_info=read_result("iw/info-ap.txt"), wifi_stations=read_result("iw/stations-ap.txt")
    )
    assert only(findings, "Wi-Fi").detail == "AP 'xx', channel 1, 1 station, -57 dBm"
    assert "power save" not in {finding.check for finding in findings}


def test_a_station_that_should_be_an_access_point_is_a_warning() -> None:
    findings = judge_radio(
        RELAY, wifi_info=read_result("iw/info-station.txt"), wifi_link=read_result("iw/link-station.txt")
    )
    finding = only(findings, "Wi-Fi")
    assert finding.status is WARN
    assert finding.detail.endswith(": a station, but according to its profile the robot runs an access point")


def test_an_ad_hoc_cell_is_not_a_missing_network() -> None:
    ibss = CommandResult(read_result("iw/info-station.txt").text.replace("managed", "IBSS"), 0)
    findings = judge_radio(SENDER, wifi_info=ibss, wifi_link=read_result("iw/link-ibss.txt"))
    assert only(findings, "Wi-Fi").detail == "IBSS 'knowhere', at 02:11:87:86:a3:0f, channel 11"


def test_outputs_of_the_kernels_wifi_stack_are_read_in_every_mode() -> None:
    station = judge_radio(
        SENDER, wifi_info=read_result("iw/info-hwsim-station-6.txt"), wifi_link=read_result("iw/link-hwsim-6.txt")
    )
    assert only(station, "Wi-Fi").detail == "managed 'lawn', at 02:00:00:00:00:00, channel 6, -30 dBm, 1.0 MBit/s"
    relay = judge_radio(
        RELAY,
        wifi_info=read_result("iw/info-hwsim-ap-6.txt"),
        wifi_stations=read_result("iw/stations-hwsim-ap-6.txt"),
    )
    assert only(relay, "Wi-Fi").detail == "AP 'lawn', channel 6, 2 stations, -30 dBm"
    ibss = judge_radio(
        SENDER, wifi_info=read_result("iw/info-hwsim-ibss-5.txt"), wifi_link=read_result("iw/link-hwsim-ibss-6.txt")
    )
    assert only(ibss, "Wi-Fi").detail == "IBSS 'lawn', at 26:9f:2e:55:bf:8b, channel 6"
    down = judge_radio(
        SENDER, wifi_info=read_result("iw/info-hwsim-down-5.txt"), wifi_link=read_result("iw/link-none.txt")
    )
    assert only(down, "Wi-Fi").detail == "not associated with a network"


def test_an_interface_without_a_radio_has_no_wifi_findings() -> None:
    findings = judge_radio(SENDER, wifi_info=read_result("iw/no-wifi.txt", 1))
    assert {finding.check for finding in findings} == {"interface wlan0", "control", "offloads"}


def test_a_radio_without_iw_is_a_warning() -> None:
    ethernet_output = CommandResult(
        read_result("ip/6.1.0/up.txt").text.replace("link/none", "link/ether b8:27:eb:94:14:9a"), 0
    )
    findings = judge_radio(
        SENDER, interface=ethernet_output, wireless=CommandResult("/sys/class/net/wlan0/phy80211", 0)
    )
    assert only(findings, "Wi-Fi").remedy == "sudo apt-get install iw"


def judge_system(role: Role, **changes: CommandResult) -> list[Finding]:
    """Judge the system of a robot whose sections are all fine except for `changes`."""
    sections: dict[str, CommandResult] = {
        "system": CommandResult("Raspbian GNU/Linux 10 (buster), Linux 5.10.63-v7+ armv7l", 0),
        "disk": CommandResult(
            "Filesystem     1024-blocks    Used Available Capacity Mounted on\n"
            "/dev/root         14960428 3451724  10862848      25% /",
            0,
        ),
        "listeners": CommandResult("", 1),
        "batteries": CommandResult("", 2),
    }
    report = Report(CAST[role].name)
    system.judge(PLAN, role, sections | changes, report)
    return report.findings


@pytest.mark.parametrize(
    ("role", "free_kib", "status"),
    [
        (Role.RECEIVER, 10_862_848, OK),
        (Role.RECEIVER, (100 << 10) + 1_000, OK),
        (Role.RECEIVER, 100 << 10, FAIL),
        (Role.RECEIVER, 0, FAIL),
        # The recording robot uses rosbag, which leaves 1 GiB free.
        (Role.SENDER, (1 << 20) + 1_000, OK),
        (Role.SENDER, 1 << 20, FAIL),
    ],
)
def test_a_robot_s_disk_must_have_space_for_an_attempt(role: Role, free_kib: int, status: Verdict) -> None:
    head = "Filesystem           1024-blocks    Used Available Capacity Mounted on\n"
    finding = only(
        judge_system(role, disk=CommandResult(f"{head}/dev/root 14960428 3451724 {free_kib}  25% /", 0)), "disk"
    )
    assert finding.status is status


def test_a_disk_with_unknown_space_fails() -> None:
    assert only(judge_system(Role.SENDER, disk=CommandResult("df: .: Stale file handle", 1)), "disk").status is FAIL


def test_the_laptop_must_have_space_for_an_attempt_and_should_have_space_for_the_trial() -> None:
    size_bytes = size.trial_bytes(PLAN)
    for free, status in (
        (size.RESERVE_BYTES + size_bytes, OK),
        (size.RESERVE_BYTES + size_bytes - 1, WARN),
        (0, FAIL),
    ):
        report = Report("laptop")
        system.judge_disk_space(PLAN, free, Path("/trials"), report)
        assert only(report.findings, "disk").status is status


def test_evidence_that_takes_long_to_fetch_is_a_warning_with_size_and_rate(tmp_path: Path) -> None:
    report = Report("laptop")
    system.judge_laptop(PLAN, tmp_path, report)
    assert "fetch" not in {finding.check for finding in report.findings}
    (entry, *others) = PLAN.procedure.steps
    long_record = with_record(entry, 36_000.0)
    procedure = PLAN.procedure.model_copy(update={"steps": (long_record, *others)})
    system.judge_laptop(PLAN.model_copy(update={"procedure": procedure}), tmp_path, report)
    finding = only(report.findings, "fetch")
    assert finding.status is WARN
    assert re.fullmatch(
        r"an attempt leaves about \d\.\d GB, which takes \d+ min \d\d s to fetch at 2\.5 MB/s", finding.detail
    )


LISTENER = "   0: 00000000:04D2 00000000:0000 0A 00000000:00000000 00:00000000 00000000     0        0 1795259 1"


def test_a_port_in_use_fails_on_the_receiver_only() -> None:
    port_in_use = CommandResult(LISTENER, 0)
    finding = only(judge_system(Role.RECEIVER, listeners=port_in_use), "port 1234")
    assert finding.status is FAIL
    assert "1234" in finding.remedy
    assert (
        only(
            judge_system(Role.RECEIVER, listeners=CommandResult(LISTENER.replace("04D2", "04D3"), 0)), "port 1234"
        ).status
        is OK
    )
    assert "port 1234" not in {finding.check for finding in judge_system(Role.SENDER, listeners=port_in_use)}


def test_a_low_battery_is_a_warning() -> None:
    findings = judge_system(Role.SENDER, batteries=CommandResult("BAT0 81\nbq27000-0 19", 0))
    assert [(finding.status, finding.detail) for finding in findings if finding.check == "battery"] == [
        (OK, "BAT0 at 81 %"),
        (WARN, "bq27000-0 at 19 %"),
    ]


@pytest.mark.parametrize(
    ("offset_s", "error_s", "status"),
    [(0.9, 0.0, OK), (-1.1, 0.05, WARN), (1.3, 0.5, OK), (3600.0, 0.01, WARN), (-7200.0, 0.01, WARN)],
)
def test_a_clock_with_an_error_above_a_second_is_a_warning(offset_s: float, error_s: float, status: Verdict) -> None:
    report = Report("turtlebot-1")
    contact.judge_clock(Offset(offset_s, error_s), "pi@robot", report)
    assert only(report.findings, "clock").status is status


def test_an_error_of_an_hour_is_reported_in_hours() -> None:
    report = Report("turtlebot-1")
    contact.judge_clock(Offset(-3601.0, 0.01), "-p 2222 pi@robot", report)
    (finding,) = report.findings
    assert finding.detail.startswith("1.0 hours behind")
    assert "sudo date -u -s @$(date +%s)" in finding.remedy


def installed(plan: Plan = PLAN) -> dict[str, CommandResult]:
    commands = software.commands(plan, Role.SENDER)
    tools = "\n".join(
        f"==> {name} <==\n{text}\n==> exit 0 <=="
        for name, text in {
            "user": "0",
            "netcat": "[v1.10-47]",
            "ping": "ping from iputils 20221126",
            "echo": "64 bytes from 127.0.0.1: icmp_seq=1 ttl=64 time=0.017 ms",
            "capture": "tcpdump version 4.99.3\nUsage: tcpdump [--immediate-mode]",
            "recorder": "Usage: rosbag record TOPIC1 [TOPIC2 TOPIC3...]",
        }.items()
    )
    return dict.fromkeys(commands, CommandResult("/usr/bin/it", 0)) | {
        "tools": CommandResult(tools, 0),
        "ROS": CommandResult("noetic http://127.0.0.1:11311", 0),
    }


def judge_all(sections: Sections, plan: Plan = PLAN) -> list[Finding]:
    report = Report(SENDER.name)
    software.judge(plan, Role.SENDER, sections, report)
    return report.findings


def procedure_of(step: str) -> Procedure:
    """Return a procedure that has only this step."""
    head = "name: x\nsummary: X\nscenario: los\ntopology: master\nprotocols: [tcp]\nrepeats: 1\nsteps:\n"
    return schema.validate(schema.parse(f"{head}- {step}\n", source="x.yaml"), Procedure)


def test_a_robot_that_has_everything_passes() -> None:
    findings = judge_all(installed())
    assert {finding.status for finding in findings} == {OK}
    tools = "traditional netcat, ping from iputils 20221126, tcpdump version 4.99.3"
    assert only(findings, "tools").detail == tools


def test_a_missing_program_is_one_failure_with_its_package() -> None:
    sections = installed() | {"program nc.traditional": CommandResult("", 1)}
    (failure,) = [finding for finding in judge_all(sections) if finding.status is not OK]
    assert failure.check == "nc.traditional"
    assert failure.remedy == "sudo apt-get install netcat-traditional"


@pytest.mark.parametrize(
    ("step", "program", "remedy"),
    [
        ("iperf3: {from: sender, to: receiver}", "iperf3", "sudo apt-get install iperf3"),
        (
            "run: {robot: sender, command: /opt/vendor/ctl --json}",
            "/opt/vendor/ctl",
            "install /opt/vendor/ctl, or correct the command of this run in the procedure",
        ),
        ("run: {robot: sender, command: busybox uptime}", "busybox", "sudo apt-get install busybox"),
    ],
)
def test_a_missing_program_of_a_step_is_reported_with_its_source(step: str, program: str, remedy: str) -> None:
    plan = PLAN.model_copy(update={"procedure": procedure_of(step)})
    sections = installed(plan) | {f"program {program}": CommandResult("", 127)}
    (failure,) = [finding for finding in judge_all(sections, plan) if finding.status is not OK]
    assert (failure.check, failure.remedy) == (program, remedy)


def test_a_missing_capture_permission_fails_with_the_command_that_grants_it() -> None:
    result = CommandResult("tcpdump: wlan0: You don't have permission to perform this capture on that device", 1)
    (failure,) = [
        finding for finding in judge_all(installed() | {"right to capture": result}) if finding.status is not OK
    ]
    assert failure.remedy == "sudo setcap cap_net_raw,cap_net_admin+eip $(command -v tcpdump)"


def test_a_missing_sudo_permission_fails_with_the_rule_that_grants_it() -> None:
    tools = TURTLEBOT.tools.model_copy(update={"capture_right": "sudo"})
    robot = SENDER.model_copy(update={"profile": TURTLEBOT.model_copy(update={"tools": tools})})
    plan = PLAN.model_copy(update={"cast": {**PLAN.cast, Role.SENDER: robot}})
    for result, remedy in (
        (CommandResult("sudo: a password is required", 1), "sudo tee /etc/sudoers.d/fieldkit"),
        (CommandResult("sh: 9: sudo: not found", CommandResult.MISSING), "capture_right: direct"),
    ):
        (failure,) = [
            finding
            for finding in judge_all(installed(plan) | {"right to capture": result}, plan)
            if finding.status is not OK
        ]
        assert remedy in failure.remedy


@given(st.text())
def test_any_output_can_be_parsed(text: str) -> None:
    assert all(section.code >= 0 for section in parse(text).values())


@given(st.text())
def test_findings_contain_only_printable_text(text: str) -> None:
    report = Report("turtlebot-1")
    all_sections = {
        name: CommandResult(text, 0) for name in (*installed(), "system", "disk", "interface", "wifi-info")
    }
    system.judge(PLAN, Role.SENDER, all_sections, report)
    software.judge(PLAN, Role.SENDER, all_sections, report)
    radio.judge(SENDER, all_sections, report)
    for finding in report.findings:
        assert (finding.check + finding.detail + finding.remedy).isprintable()


@pytest.mark.parametrize(
    ("connection", "control", "status", "detail"),
    [
        ("10.42.0.254 51000 10.42.0.1 22", Control.RADIO, OK, "as the site file states"),
        ("10.42.0.254 51000 10.42.0.1 22", Control.SEPARATE, WARN, "does not contain control: radio"),
        ("192.168.1.9 51000 192.168.1.5 22", Control.SEPARATE, OK, "it connects to 192.168.1.5"),
        ("192.168.1.9 51000 192.168.1.5 22", Control.RADIO, OK, "it connects to 192.168.1.5"),
        ("", Control.SEPARATE, OK, "does not report the addresses"),
    ],
)
def test_the_route_of_ssh_is_detected(connection: str, control: Control, status: Verdict, detail: str) -> None:
    finding = only(
        judge_radio(SENDER.model_copy(update={"control": control}), control=CommandResult(connection, 0)), "control"
    )
    assert finding.status is status
    assert detail in finding.detail


@pytest.mark.parametrize("file", ["ip/6.1.0/nope.txt", "busybox/1.35.0/ip-nope.txt"])
def test_a_missing_interface_hides_the_check_of_capture_permission(file: str) -> None:
    result = CommandResult("tcpdump: wlan0: No such device exists\n(SIOCGIFHWADDR: No such device)", 1)
    sections = installed() | {"right to capture": result, "interface": read_result(file, 1)}
    assert "right to capture" not in {finding.check for finding in judge_all(sections)}
    findings = judge_all(sections | {"interface": read_result("ip/6.1.0/up.txt")})
    assert only(findings, "right to capture").status is FAIL


@pytest.mark.parametrize(
    ("user", "programs", "remedy", "expected_remedy"),
    [
        ("1000", "sudo apt-get", "sudo apt-get install iw", "sudo apt-get install iw"),
        ("0", "apt-get", "sudo apt-get install iw", "apt-get install iw"),
        ("1000", "apt-get", "sudo apt-get install iw", "as root: apt-get install iw"),
        ("0", "", "sudo apt-get install iw", "install iw (package name in Debian)"),
        ("0", "sudo", "sudo ip link set wlan0 up", "ip link set wlan0 up"),
        ("1000", "", "sudo ip link set wlan0 up", "as root: ip link set wlan0 up"),
        ("1000", "sudo", "sudo setcap x y", "sudo setcap x y # setcap is in Debian's libcap2-bin"),
        ("1000", "sudo setcap", "sudo setcap x y", "sudo setcap x y"),
        ("1000", "sudo", "fieldkit abort", "fieldkit abort"),
    ],
)
def test_a_remedy_uses_the_tools_and_permissions_of_the_robot(
    user: str, programs: str, remedy: str, expected_remedy: str
) -> None:
    report = Report("turtlebot-1")
    report.user_tools = system.user_tools(
        {"user": CommandResult(user, 0), "user-tools": CommandResult("\n".join(programs.split()), 0)}
    )
    report.fail("iw", "not found", remedy)
    assert only(report.findings, "iw").remedy == expected_remedy


def test_the_remedy_for_a_port_uses_an_available_tool() -> None:
    report = Report(RECEIVER.name)
    report.user_tools = system.user_tools({"user": CommandResult("0", 0), "user-tools": CommandResult("netstat", 0)})
    system.judge(PLAN, Role.RECEIVER, {"listeners": CommandResult(LISTENER, 0)}, report)
    assert only(report.findings, "port 1234").remedy == "netstat -lntup | grep :1234 # find this program and stop it"


def test_the_remedy_for_a_clock_uses_an_available_tool() -> None:
    for user, programs, command in (
        ("0", "", "ssh -t -p 2222 pi@robot date -u -s @$(date +%s)"),
        ("1000", "sudo", "ssh -t -p 2222 pi@robot sudo date -u -s @$(date +%s)"),
        ("1000", "", "ssh -t -p 2222 pi@robot \"su -c 'date -u -s @$(date +%s)'\""),
    ):
        report = Report("turtlebot-1")
        report.user_tools = system.user_tools(
            {"user": CommandResult(user, 0), "user-tools": CommandResult(programs, 0)}
        )
        contact.judge_clock(Offset(5.0, 0.1), "-p 2222 pi@robot", report)
        assert only(report.findings, "clock").remedy == f"{command} # on the laptop"


def test_the_remedy_for_the_control_route_names_the_site_file() -> None:
    finding = only(judge_radio(SENDER, control=CommandResult("10.42.0.254 51000 10.42.0.1 22", 0)), "control")
    assert finding.remedy == "write control: radio in the site file, or set host to its address on another network"


@pytest.mark.parametrize(
    ("offset_s", "error_s", "status"),
    [(-0.75, 0.001, WARN), (-0.75, 0.7, OK), (0.00001, None, OK), (0.2, None, WARN)],
)
def test_a_clock_that_differs_from_its_time_source_is_reported(
    offset_s: float, error_s: float | None, status: Verdict
) -> None:
    report = Report("robot")
    time_sources.judge((ClockReport("chrony", "10.9.0.2", offset_s, error_s),), report)
    assert [finding.status for finding in report.findings] == [status]
