"""Detection of the variant of a tool from its output."""

import contextlib
import os
import subprocess
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fieldkit.config.profiles import RobotProfile
from fieldkit.core.errors import RobotError
from fieldkit.steps import variants
from fieldkit.steps.variants import Netcat, PingTool, Recorder, Tool
from fieldkit.trial.check import tools
from tests.helpers.casts import TURTLEBOT, ros_of
from tests.helpers.paths import DATA


def read_output(name: str) -> bytes:
    return (DATA / name).read_bytes()


def section(name: str, text: bytes, code: int = 0) -> bytes:
    return b"==> %s <==\n%s\n==> exit %d <==\n" % (name.encode(), text, code)


USER = section("user", b"1000\n")


def with_tools(**names: str) -> RobotProfile:
    """Return the profile of a TurtleBot with other names of programs, and with ROS in its PATH."""
    without_setup = ros_of(TURTLEBOT).command.model_copy(update={"setup": ()})
    ros = ros_of(TURTLEBOT).model_copy(update={"variants": {"ros1": without_setup}})
    return TURTLEBOT.model_copy(update={"tools": TURTLEBOT.tools.model_copy(update=names), "ros": ros})


@pytest.mark.parametrize(
    ("file", "kind", "version"),
    [
        ("nc.traditional/1.10-47/about.txt", Netcat.TRADITIONAL, "[v1.10-47]"),
        ("nc.openbsd/1.219/about.txt", Netcat.OPENBSD, "OpenBSD netcat (Debian patchlevel 1.219-1)"),
        ("ncat/7.93/about.txt", Netcat.NCAT, "Ncat 7.93 ( https://nmap.org/ncat )"),
        ("ncat/7.95/about.txt", Netcat.NCAT, "Ncat 7.95 ( https://nmap.org/ncat )"),
        (
            "busybox/1.35.0/nc-about.txt",
            Netcat.BUSYBOX,
            "BusyBox v1.35.0 (Debian 1:1.35.0-4+deb12u1+b1) multi-call binary.",
        ),
    ],
)
def test_each_netcat_is_identified_by_its_help(file: str, kind: Netcat, version: str) -> None:
    detected = tools.parse(USER + section("netcat", read_output(file), 1), TURTLEBOT)
    assert (detected.netcat, detected.versions) == (kind, {Tool.NETCAT: version})


@pytest.mark.parametrize(
    ("text", "kind"),
    [
        (read_output("ping/20221126/about.txt"), PingTool.IPUTILS),
        (read_output("busybox/1.35.0/ping-about.txt"), PingTool.BUSYBOX),
        (b"ping from iputils 20210722\n", PingTool.IPUTILS),
        (b"ping from iputils 20210202\n", PingTool.IPUTILS_OLD),
        (b"ping from iputils s20190709\n", PingTool.IPUTILS_OLD),
        (b"ping utility, iputils-s20121221\n", PingTool.IPUTILS_OLD),
        (b"ping utility, iputils-sss20101006\n", PingTool.IPUTILS_OLD),
    ],
)
def test_each_ping_is_identified_by_its_version(text: bytes, kind: PingTool) -> None:
    assert tools.parse(USER + section("ping", text), TURTLEBOT).ping is kind


@pytest.mark.parametrize("tool", ["netcat", "ping", "capture"])
def test_a_missing_or_unknown_tool_is_rejected_with_a_remedy(tool: str) -> None:
    with pytest.raises(RobotError, match="there is no") as missing_error:
        tools.parse(USER + section(tool, b"sh: 4: nc: not found\n", 127), TURTLEBOT)
    with pytest.raises(RobotError, match="of an unknown kind: GNU something") as unknown_error:
        tools.parse(USER + section(tool, b"GNU something 0.7.1\n"), TURTLEBOT)
    assert "apt-get install" in missing_error.value.remedy
    assert "apt-get install" in unknown_error.value.remedy


def test_a_killed_recorder_is_not_reported_as_missing() -> None:
    with pytest.raises(RobotError, match="rosbag record --help did not exit in time") as timeout:
        tools.parse(USER + section("recorder", b"", 137), TURTLEBOT)
    assert "the robot may be busy" in timeout.value.remedy


def test_a_ping_without_permission_is_rejected_with_a_remedy() -> None:
    denied_section = section("echo", b"ping: permission denied (are you root?)\n", 1)
    busybox = section("ping", read_output("busybox/1.35.0/ping-about.txt"))
    with pytest.raises(RobotError, match=r"permission denied \(are you root\?\)") as caught:
        tools.parse(USER + busybox + denied_section, TURTLEBOT)
    assert caught.value.remedy == "sudo apt-get install iputils-ping"
    with pytest.raises(RobotError) as caught:
        tools.parse(USER + section("ping", read_output("ping/20221126/about.txt")) + denied_section, TURTLEBOT)
    assert caught.value.remedy.startswith("sudo setcap cap_net_raw+ep")


def test_immediate_mode_of_tcpdump_and_root_are_detected() -> None:
    new_tcpdump = tools.parse(
        section("user", b"0\n") + section("capture", read_output("tcpdump/4.99.3/about.txt")), TURTLEBOT
    )
    assert (new_tcpdump.immediate_mode, new_tcpdump.root) == (True, True)
    old_tcpdump = tools.parse(USER + section("capture", read_output("tcpdump/4.5.1/about.txt"), 1), TURTLEBOT)
    assert old_tcpdump.versions == {Tool.CAPTURE: "tcpdump version 4.5.1"}
    assert (old_tcpdump.immediate_mode, old_tcpdump.root) == (False, False)


def test_an_output_without_sections_is_rejected() -> None:
    with pytest.raises(RobotError, match="its tools cannot be identified: This account is closed"):
        tools.parse(b"This account is closed.\n", TURTLEBOT)


def test_tools_that_were_not_probed_have_the_expected_variant() -> None:
    profile = with_tools(netcat="/usr/bin/nc.openbsd", ping="/opt/busybox/ping")
    assert tools.parse(USER, profile) == variants.expected(profile)
    assert variants.expected(profile).netcat is Netcat.OPENBSD
    assert variants.expected(profile).ping is PingTool.BUSYBOX
    assert variants.expected(with_tools(netcat="nc")).netcat is Netcat.TRADITIONAL
    assert variants.expected(profile).recorder is Recorder.ROSBAG


output_parts = st.sampled_from(
    [b"==> ", b" <==\n", b"netcat", b"user", b"ping", b"exit ", b"0", b"\n", b"[v1.1", b"\xff", b"BusyBox v"]
)


@given(st.one_of(st.binary(), st.lists(output_parts, max_size=40).map(b"".join)))
def test_arbitrary_output_raises_no_other_error_than_a_robot_error(output: bytes) -> None:
    with contextlib.suppress(RobotError):
        assert all(text.isprintable() for text in tools.parse(output, TURTLEBOT).versions.values())


SHELLS = {"dash": ("dash",), "bash": ("bash",), "ash": ("busybox", "ash")}


def run(profile: RobotProfile, shell: str = "dash") -> bytes:
    """Return the output of the probe on this machine."""
    _, *probe_args = tools.probe(profile)
    return subprocess.run(
        (*SHELLS[shell], *probe_args), capture_output=True, check=False, timeout=tools.PROBE_S
    ).stdout


@pytest.mark.emulated
@pytest.mark.parametrize("shell", SHELLS)
@pytest.mark.parametrize("netcat", Netcat)
def test_the_probe_finds_this_machines_tools_in_every_shell(shell: str, netcat: Netcat, tmp_path: Path) -> None:
    programs = {Netcat.TRADITIONAL: "nc.traditional", Netcat.OPENBSD: "nc.openbsd", Netcat.NCAT: "ncat"}
    link = tmp_path / "nc"
    link.symlink_to("/bin/busybox")
    profile = with_tools(netcat=programs.get(netcat, str(link)))
    detected = tools.parse(run(profile, shell), profile)
    assert (detected.netcat, detected.ping, detected.immediate_mode, detected.root) == (
        netcat,
        PingTool.IPUTILS,
        True,
        True,
    )
    assert detected.versions.keys() == {Tool.NETCAT, Tool.PING, Tool.CAPTURE}


@pytest.mark.emulated
def test_a_tool_that_does_not_exit_is_killed(tmp_path: Path) -> None:
    program = tmp_path / "nc"
    program.write_text("#!/bin/sh\necho $$ >>pid\nexec sleep 1000\n")
    program.chmod(0o755)
    profile = with_tools(netcat=str(program))
    _, *probe_args = tools.probe(profile, [Tool.NETCAT])
    output = subprocess.run(
        ("sh", *probe_args),
        stdin=subprocess.PIPE,
        capture_output=True,
        check=False,
        timeout=tools.PROBE_S,
        cwd=tmp_path,
    ).stdout
    with pytest.raises(RobotError, match="nc did not exit in time"):
        tools.parse(output, profile)
    with pytest.raises(ProcessLookupError):
        os.kill(int((tmp_path / "pid").read_text()), 0)


def test_output_of_a_tool_may_look_like_a_section_header() -> None:
    output_text = b"OpenBSD netcat\n==> ping <==\nmore"
    detected = tools.parse(USER + section("netcat", output_text, 1) + b"==> capture <==\nno end", TURTLEBOT)
    assert (detected.netcat, set(detected.versions)) == (Netcat.OPENBSD, {Tool.NETCAT})
