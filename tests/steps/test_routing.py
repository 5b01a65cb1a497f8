"""The preflight check for routing protocols on robots that forward packets for each other."""

import shlex
import shutil
import subprocess
from pathlib import Path

import pytest

from fieldkit.core.model import Protocol, Role, Verdict
from fieldkit.steps import routing
from fieldkit.steps.kinds.ping import PingStep
from fieldkit.steps.scene import CommandResult, Scene
from tests.helpers.casts import CAST

SCENE = Scene(Protocol.UDP, CAST, "f")


def test_forwarded_ping_checks_all_robots_of_the_trial() -> None:
    keys = {"from": "sender", "to": "receiver"}
    step = PingStep.model_validate(keys | {"forwarded": True})
    assert [need.role for need in step.needs(SCENE)] == list(CAST)
    assert Role.RELAY in CAST.keys() - step.roles()
    assert not [*PingStep.model_validate(keys).needs(SCENE)]


@pytest.mark.emulated
@pytest.mark.parametrize("shell", ["dash", "bash", "busybox sh"])
@pytest.mark.parametrize("daemon", ["babeld", "olsrd", "nobabeld", ""])
def test_daemon_is_found_by_exact_name_in_each_shell(tmp_path: Path, shell: str, daemon: str) -> None:
    need = next(routing.needs(SCENE))
    assert need.argv[:2] == ("sh", "-c")
    search = f"{shell} {shlex.join(need.argv[1:])}"
    if daemon:
        shutil.copy("/usr/bin/sleep", tmp_path / daemon)
        search = f"./{daemon} 60 & until grep -qx {daemon} /proc/$!/comm; do :; done; {search}"
    namespace = ("unshare", "--pid", "--fork", "--kill-child", "--mount", "--mount-proc")
    completed = subprocess.run(
        (*namespace, "sh", "-c", search), cwd=tmp_path, capture_output=True, text=True, check=False
    )
    names = completed.stdout.split()
    # The kernel modules of this machine are visible in each namespace.
    assert [name for name in names if name != "batman-adv"] == ([daemon] if daemon in routing.DAEMONS else [])
    assert (completed.returncode, completed.stderr) == (0, "")


@pytest.mark.parametrize(
    ("result", "verdict", "detail"),
    [
        (CommandResult("babeld\n", 0), Verdict.OK, "babeld"),
        (CommandResult("babeld\nbabeld\nbatman-adv\n", 0), Verdict.OK, "babeld, batman-adv"),
        (CommandResult("", 0), Verdict.FAIL, "no routing protocol runs on it"),
        (CommandResult("sh: not found", 127), Verdict.FAIL, "no routing protocol runs on it"),
    ],
)
def test_a_missing_routing_protocol_fails_with_a_remedy(result: CommandResult, verdict: Verdict, detail: str) -> None:
    actual, detail_text, remedy = routing.judge(result)
    assert actual is verdict
    assert detail_text.startswith(detail)
    assert ("fieldkit docs mesh" in remedy) == (verdict is Verdict.FAIL)
