"""The commands `fieldkit init` and `enroll` with a real sshd, from an empty folder to a pinned robot."""

import subprocess
from pathlib import Path

import pytest

from fieldkit.cli import main
from fieldkit.config.site import load_site
from fieldkit.remote.identity import HostKey
from tests.helpers.sshd import Server, make_key

pytestmark = pytest.mark.emulated

SITE = """\
robots:
  turtlebot-1:
    profile: turtlebot3_burger   # the blue one
    host: 127.0.0.1
    port: {port}
roles:
  masterless: {{sender: turtlebot-1}}
"""


@pytest.fixture
def lab(tmp_path: Path, server: Server, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "fieldkit.yaml").write_text(SITE.format(port=server.port), encoding="utf-8")
    return tmp_path / "fieldkit.yaml"


def key_of(server: Server) -> str:
    return " ".join(server.host_key.split()[:2])


def fingerprint(folder: Path, name: str = "host") -> str:
    argv = ("ssh-keygen", "-lf", str(folder / f"{name}.pub"))
    return subprocess.run(argv, capture_output=True, text=True, check=True).stdout.split()[1]


def type_answers(monkeypatch: pytest.MonkeyPatch, *lines: str) -> None:
    answers = list(lines)
    monkeypatch.setattr("sys.stdin.isatty", lambda: True)
    monkeypatch.setattr("builtins.input", lambda: answers.pop(0))


def test_key_is_shown_and_pinned_after_confirmation(
    lab: Path, server: Server, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    before = lab.read_text(encoding="utf-8")
    type_answers(monkeypatch, "maybe", "yes")
    assert main(["enroll", "turtlebot-1"]) == 0
    output = capsys.readouterr().out
    assert f"turtlebot-1 at 127.0.0.1 port {server.port} offers: ssh-ed25519 {fingerprint(server.folder)}" in output
    assert "ssh-keygen -lf /etc/ssh/ssh_host_ed25519_key.pub" in output
    line = f"    host_key: {key_of(server)}\n"
    assert lab.read_text(encoding="utf-8") == before.replace("roles:", f"{line}roles:")
    assert main(["enroll", "turtlebot-1"]) == 0
    assert "already pinned" in capsys.readouterr().out


def test_answer_no_pins_nothing(lab: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before = lab.read_text(encoding="utf-8")
    type_answers(monkeypatch, "no")
    assert main(["enroll", "turtlebot-1"]) == 1
    assert lab.read_text(encoding="utf-8") == before


def test_without_a_terminal_option_yes_is_required(
    lab: Path, server: Server, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["enroll", "turtlebot-1"]) == 2
    assert "add --yes" in capsys.readouterr().err
    assert main(["enroll", "turtlebot-1", "--yes"]) == 0
    site, _ = load_site(lab)
    assert site.robots["turtlebot-1"].host_key == key_of(server)


def test_changed_key_is_an_error_with_both_fingerprints_without_replace(
    lab: Path, server: Server, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    other_key = " ".join(make_key(tmp_path / "other").split()[:2])
    text = lab.read_text(encoding="utf-8").replace("    port:", f"    host_key: {other_key}  # of May\n    port:")
    lab.write_text(text, encoding="utf-8")
    assert main(["enroll", "turtlebot-1", "--yes"]) == 3
    message = capsys.readouterr().err
    assert fingerprint(tmp_path, "other") in message
    assert fingerprint(server.folder) in message
    assert "fieldkit enroll turtlebot-1 --replace" in message
    assert lab.read_text(encoding="utf-8") == text
    assert main(["enroll", "turtlebot-1", "--yes", "--replace"]) == 0
    assert lab.read_text(encoding="utf-8") == text.replace(other_key, key_of(server))


def test_invalid_pinned_key_is_only_replaced_with_option_replace(lab: Path, server: Server) -> None:
    text = lab.read_text(encoding="utf-8").replace("    port:", "    host_key: nonsense\n    port:")
    lab.write_text(text, encoding="utf-8")
    assert main(["enroll", "turtlebot-1", "--yes"]) == 2
    assert main(["enroll", "turtlebot-1", "--yes", "--replace"]) == 0
    assert lab.read_text(encoding="utf-8") == text.replace("nonsense", key_of(server))


def test_unreachable_robot_is_exit_3(lab: Path, capsys: pytest.CaptureFixture[str]) -> None:
    lab.write_text(SITE.format(port=1), encoding="utf-8")
    assert main(["enroll", "turtlebot-1", "--yes"]) == 3
    assert "nothing listens on port 1" in capsys.readouterr().err


def test_init_suggests_enroll(
    tmp_path: Path, server: Server, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["init", "--out", "lab.yaml"]) == 0
    message = capsys.readouterr().out
    assert "fieldkit enroll duckiedrone-1 --site lab.yaml" in message
    assert "fieldkit trial los 30ft --repeats 1 --site lab.yaml" in message
    path = tmp_path / "lab.yaml"
    text = path.read_text(encoding="utf-8").replace("10.0.0.2\n", "127.0.0.1\n").replace("22\n", f"{server.port}\n")
    path.write_text(text, encoding="utf-8")
    assert main(["enroll", "turtlebot-1", "--site", "lab.yaml", "--yes"]) == 0
    assert load_site(path)[0].robots["turtlebot-1"].host_key == key_of(server)


def test_fingerprint_command_of_dropbear() -> None:
    text = "ssh-ed25519 AAAAC3NzaC1lZDI1NTE5AAAAIJcfoHM2b/TjeUycyd/kMkG5id0whvOnW10xYBLAo4SR"
    dropbear, openssh = HostKey(text, "SSH-2.0-dropbear_2022.83"), HostKey(text, "SSH-2.0-OpenSSH_9.2p1")
    assert dropbear == openssh == HostKey(text)
    assert dropbear.fingerprint_command == "dropbearkey -y -f /etc/dropbear/dropbear_ed25519_host_key"
    assert openssh.fingerprint_command == "ssh-keygen -lf /etc/ssh/ssh_host_ed25519_key.pub"
