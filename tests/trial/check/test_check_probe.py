"""The script of the probe in the shells that robots have."""

import subprocess

import pytest

from fieldkit.steps.scene import CommandResult
from fieldkit.trial.check.probe import parse, script

SPECIAL_CHARACTERS = 'it\'s $(touch x) `y` "z" \\ *'
SHELLS = [("dash",), ("bash",), ("busybox", "ash")]


@pytest.mark.parametrize("shell", SHELLS, ids=" ".join)
def test_every_command_has_a_section_with_its_output(shell: tuple[str, ...]) -> None:
    commands = {
        "program it's": ("printf", "%s", SPECIAL_CHARACTERS),
        "no such": ("no-such-tool",),
        "reads": ("cat",),
        "fails": ("sh", "-c", "echo text; exit 3"),
    }
    argv = (*shell, "-s", "lo")
    completed = subprocess.run(argv, input=script(commands).encode(), capture_output=True, timeout=60, check=True)
    sections = parse(completed.stdout.decode())
    assert sections["program it's"].text == SPECIAL_CHARACTERS
    assert sections["no such"].code == CommandResult.MISSING
    assert (sections["reads"].text, sections["reads"].code) == ("", 0), (
        "commands must not read the script from standard input"
    )
    assert (sections["fails"].text, sections["fails"].code) == ("text", 3)
    assert "LOOPBACK" in sections["interface"].text
    assert sections["disk"].ok
    assert sections["user"].text.isdigit()
    assert set(sections["user-tools"].text.split()) <= {"sudo", "apt-get", "setcap", "ss", "netstat"}
    assert "Linux" in sections["system"].text
    assert {"offloads", "wifi-info", "wifi-link", "wifi-stations", "wifi-power-save"} < sections.keys()
    assert completed.stderr == b""
