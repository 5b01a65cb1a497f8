"""`wifi: linux` on the command line and in a site file, up to the start of the virtual machine."""

import shlex
from pathlib import Path

import pytest

from fieldkit.cli import main
from sim_backends.emulated.linux_wifi import guest, virtual_machine
from sim_backends.emulated.linux_wifi.virtual_machine import JobResult, Kernel
from sim_backends.emulated.robot.mesh_options import MeshOptions

SITE = """\
backend: emulated
robots:
  ground-1: {profile: turtlebot3_burger}
  ground-2: {profile: turtlebot3_burger}
  ground-3: {profile: turtlebot3_burger}
roles:
  master: {sender: ground-1, receiver: ground-2, relay: ground-3}
"""


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    path = tmp_path / "a lab"
    path.mkdir()
    monkeypatch.chdir(path)
    return path


def write_site(emulated: str, other_lines: str = "") -> None:
    Path("fieldkit.yaml").write_text(f"{SITE}emulated: {emulated}\n{other_lines}")


def test_lab_up_lists_all_missing_requirements(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(virtual_machine, "kernel_roots", lambda: (tmp_path,))
    assert main(["lab", "up", "--foreground", "--wifi", "linux", "--robots", "2"]) == 2
    text = capsys.readouterr().err
    assert "a kernel with mac80211_hwsim" in text
    assert "apt-get install --no-install-recommends" in text
    for package in ("hostapd", "iw", "linux-image-amd64", "nftables", "qemu-system-x86", "wpasupplicant"):
        assert f" {package}" in text


@pytest.mark.parametrize(
    ("emulated", "other_lines", "cause"),
    [
        ("{wifi: linux, physics: kinematic}", "", "`physics`"),
        ("{wifi: linux, linux_wifi: {mesh: true}, mesh: {protocol: babel}}", "", "`mesh`"),
        ("{mesh: {protocol: batman-adv}}", "", "needs `wifi: linux`"),
        ("{wifi: linux, record_air: true}", "", "`record_air`"),
        ("{wifi: linux, radio: {loss: 10%}}", "", "fixed link"),
        ("{wifi: linux}", "control: radio\n", "no radio"),
    ],
)
def test_options_that_linux_wifi_excludes_are_refused(
    emulated: str, other_lines: str, cause: str, capsys: pytest.CaptureFixture[str]
) -> None:
    write_site(emulated, other_lines)
    assert main(["trial", "los", "30ft", "--dry-run"]) == 2
    text = capsys.readouterr().err
    assert cause in text
    assert "fieldkit.yaml:" in text


def test_the_option_of_lab_up_is_checked_with_the_site_file(capsys: pytest.CaptureFixture[str]) -> None:
    write_site("{network: builtin}")
    assert main(["lab", "up", "--foreground", "--wifi", "linux"]) == 2
    assert "`wifi: linux` cannot be combined with `network`" in capsys.readouterr().err


def test_a_backend_with_one_kind_of_wifi_refuses_the_option(capsys: pytest.CaptureFixture[str]) -> None:
    write_site("{}")
    assert main(["lab", "up", "--foreground", "--backend", "field", "--wifi", "linux"]) == 2


def test_a_trial_runs_its_command_line_in_the_machine_and_returns_its_exit_code(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The machine itself is tested by `test_virtual_machine`; here its call is recorded."""
    calls = record_calls(monkeypatch)
    write_site("{wifi: linux}")
    words = ["trial", "los", "30ft", "--repeats", "1", "--notes", "it's windy", "--out", "my results"]
    assert main(words) == 4
    assert "1 void" in capsys.readouterr().out
    assert calls["radios"] == 3
    assert calls["results"] == folder / "my results"
    assert (folder / "my results").is_dir()
    assert calls["mesh"] is None
    script = str(calls["script"])
    assert shlex.split(script.splitlines()[-1])[-len(words) :] == words
    assert f"cd {shlex.quote(str(folder))} || exit" in script


def record_calls(monkeypatch: pytest.MonkeyPatch) -> dict[str, object]:
    """Return the options of later calls of `run_in_machine`, which return exit code 4."""
    calls: dict[str, object] = {}

    def run_in_machine(kernel: Kernel, script: str, deadline: object, **options: object) -> JobResult:
        calls.update(options, script=script)
        on_output = options["on_output"]
        assert callable(on_output)
        on_output(b"1 void\n")
        return JobResult(4, "")

    def require_machine(*, mesh: MeshOptions | None) -> Kernel:
        calls["mesh"] = mesh
        return Kernel(Path("vmlinuz"), Path("modules"))

    monkeypatch.setattr(guest, "require_machine", require_machine)
    monkeypatch.setattr(guest, "run_in_machine", run_in_machine)
    return calls


def test_the_machine_gets_what_the_mesh_needs(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    calls = record_calls(monkeypatch)
    write_site("{wifi: linux, mesh: {protocol: batman-adv, hello: 2s}}")
    assert main(["check", "los"]) == 4
    assert calls["mesh"] == MeshOptions.model_validate({"protocol": "batman-adv", "hello": "2s"})


def test_in_a_mesh_of_batman_the_interface_under_test_is_bat0(capsys: pytest.CaptureFixture[str]) -> None:
    for mesh, interface in (("batman-adv", "bat0"), ("babel", "wlan0")):
        write_site(f"{{wifi: linux, mesh: {{protocol: {mesh}}}}}")
        assert main(["trial", "los", "30ft", "--dry-run"]) == 0
        assert f"tcpdump -i {interface} " in capsys.readouterr().out


def test_check_and_campaign_run_in_the_machine_too(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    calls = record_calls(monkeypatch)
    write_site("{wifi: linux}")
    assert main(["check", "los"]) == 4
    assert calls["results"] == folder / "trials"
    Path("lab.yaml").write_text("name: lab\nprocedures: [los]\ntopologies: [master]\ndistances: [30ft]\nseed: 1\n")
    assert main(["campaign", "lab.yaml", "--out", "other"]) == 4
    assert calls["results"] == folder / "other"


def test_a_report_that_the_machine_would_lose_is_refused(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    record_calls(monkeypatch)
    write_site("{wifi: linux}")
    assert main(["trial", "los", "30ft", "--junit", "report.xml"]) == 2
    assert "--junit trials/report.xml" in capsys.readouterr().err
    assert main(["trial", "los", "30ft", "--junit", "report.xml", "--out", "."]) == 4
