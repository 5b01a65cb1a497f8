"""What preflight looks for on robots that forward for each other."""

import shlex
import shutil
import subprocess
from pathlib import Path

import pytest

from fieldkit.core.model import Protocol, Role, Verdict
from fieldkit.steps import routing
from fieldkit.steps.kinds.ping import PingStep
from fieldkit.steps.scene import Said, Scene
from tests.helpers.casts import CAST

SCENE = Scene(Protocol.UDP, CAST, "f")


def test_a_ping_that_is_forwarded_asks_each_robot_of_the_trial_those_that_no_step_names_too() -> None:
    plain = {"from": "sender", "to": "receiver"}
    step = PingStep.model_validate(plain | {"forwarded": True})
    assert [need.role for need in step.needs(SCENE)] == list(CAST)
    assert Role.RELAY in CAST.keys() - step.roles()
    assert not [*PingStep.model_validate(plain).needs(SCENE)]


@pytest.mark.emulated
@pytest.mark.parametrize("shell", ["dash", "bash", "busybox sh"])
@pytest.mark.parametrize("daemon", ["babeld", "olsrd", "nobabeld", ""])
def test_a_daemon_is_found_by_its_whole_name_in_any_shell(tmp_path: Path, shell: str, daemon: str) -> None:
    need = next(routing.needs(SCENE))
    assert need.argv[:2] == ("sh", "-c")
    look = f"{shell} {shlex.join(need.argv[1:])}"
    if daemon:
        shutil.copy("/usr/bin/sleep", tmp_path / daemon)
        look = f"./{daemon} 60 & until grep -qx {daemon} /proc/$!/comm; do :; done; {look}"
    alone = ("unshare", "--pid", "--fork", "--kill-child", "--mount", "--mount-proc")
    done = subprocess.run((*alone, "sh", "-c", look), cwd=tmp_path, capture_output=True, text=True, check=False)
    words = done.stdout.split()
    # A module of the kernel is this machine's, whatever runs in the namespace.
    assert [word for word in words if word != "batman-adv"] == ([daemon] if daemon in routing.DAEMONS else [])
    assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.parametrize(
    ("said", "verdict", "told"),
    [
        (Said("babeld\n", 0), Verdict.OK, "babeld"),
        (Said("babeld\nbabeld\nbatman-adv\n", 0), Verdict.OK, "babeld, batman-adv"),
        (Said("", 0), Verdict.FAIL, "no routing protocol runs on it"),
        (Said("sh: not found", 127), Verdict.FAIL, "no routing protocol runs on it"),
    ],
)
def test_what_was_found_is_told(said: Said, verdict: Verdict, told: str) -> None:
    found, detail, remedy = routing.judged(said)
    assert found is verdict
    assert detail.startswith(told)
    assert ("fieldkit docs mesh" in remedy) == (verdict is Verdict.FAIL)
