"""Tab completion in real shells."""

import os
import pty
import select
import subprocess
import sys
from pathlib import Path

import pytest

from fieldkit.cli import main
from fieldkit.cli.commands import completion
from fieldkit.core.deadline import Deadline
from fieldkit.trial.plan import PLAN_FILE
from tests.helpers.paths import ROOT

LIMIT_S = 60.0
BIN = Path(sys.executable).parent

# The typed line, and the line after the Tab key.
LINES = {
    "fieldkit tria": "fieldkit trial ",
    "fieldkit trial driv": "fieldkit trial driveaway ",
    "fieldkit trial los 30ft --topo": "fieldkit trial los 30ft --topology ",
    "fieldkit robots show duckied": "fieldkit robots show duckiedrone ",
    "fieldkit resume trials/on": "fieldkit resume trials/one ",
}


@pytest.fixture
def lab(tmp_path: Path) -> Path:
    (tmp_path / "trials" / "one").mkdir(parents=True)
    (tmp_path / "trials" / "one" / PLAN_FILE).touch()
    (tmp_path / "trials" / "campaign").mkdir()
    (tmp_path / "trials" / ".trash").mkdir()
    (tmp_path / "rows.csv").touch()
    (tmp_path / "notes.txt").touch()
    (tmp_path / "fieldkit.yaml").write_text("robots: {leader: {}, follower: {}}\n", encoding="utf-8")
    return tmp_path


def environment(lab: Path) -> dict[str, str]:
    return {"PATH": f"{BIN}:{os.environ['PATH']}", "HOME": str(lab), "TERM": "dumb", "PS1": "$ "}


def completions(lab: Path, line: str) -> list[str]:
    """Return the completions of a line, obtained by the protocol of argcomplete."""
    out = lab / "answer"
    variables = {"_ARGCOMPLETE": "1", "_ARGCOMPLETE_IFS": "\n", "COMP_LINE": line, "COMP_POINT": str(len(line))}
    variables |= {"_ARGCOMPLETE_STDOUT_FILENAME": str(out), "_ARGCOMPLETE_SUPPRESS_SPACE": "1"}
    subprocess.run([BIN / "fieldkit"], cwd=lab, env=environment(lab) | variables, check=True, timeout=LIMIT_S)
    return out.read_text(encoding="utf-8").split("\n")


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("fieldkit re", ["resume", "report", "rebuild"]),
        ("fieldkit lab s", ["shell", "sdf", "ssh-config"]),
        (
            "fieldkit trial ",
            sorted(path.stem for path in (ROOT / "procedures").glob("*.yaml")),
        ),
        ("fieldkit trial los ", [""]),
        ("fieldkit trial los 30ft --topology ", ["master", "masterless"]),
        ("fieldkit check los --backend ", ["emulated", "field"]),
        ("fieldkit enroll ", ["leader", "follower"]),
        ("fieldkit lab shell ", [""]),
        ("fieldkit lab up --profile ", sorted(path.stem for path in (ROOT / "robots").glob("*.yaml"))),
        ("fieldkit resume ", ["trials/", "trials/campaign/", "trials/one"]),
        ("fieldkit report trials/", ["trials/campaign/", "trials/one"]),
        ("fieldkit compare trials/one r", ["rows.csv"]),
        ("fieldkit aggregate --quantity rtt", ["rtt_loss", "rtt_median_s"]),
        ("fieldkit columns show rtt_mea", ["rtt_mean_s"]),
        ("fieldkit campaign n", ["notes.txt"]),
    ],
)
def test_values_of_arguments_are_completed(lab: Path, line: str, expected: list[str]) -> None:
    assert completions(lab, line) == expected


def test_a_damaged_site_file_completes_nothing(lab: Path) -> None:
    (lab / "fieldkit.yaml").write_text("robots: [", encoding="utf-8")
    assert completions(lab, "fieldkit enroll ") == [""]


def test_name_of_the_plan_file_equals_that_of_trials() -> None:
    assert completion.PLAN_FILE == PLAN_FILE


def test_unsupported_shell_is_rejected(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["completion", "tcsh"]) == 2
    assert "SHELL cannot be 'tcsh'; it is one of: bash, zsh, fish" in capsys.readouterr().err


def output_after_tab(lab: Path, shell: list[str], setup: str, line: str) -> str:
    """Type a line and the Tab key into a shell at a pseudo-terminal; return the shell's output."""
    pid, terminal = pty.fork()
    if pid == 0:
        os.chdir(lab)
        os.execvpe(shell[0], shell, environment(lab))
    deadline = Deadline.after(LIMIT_S)
    output = ""

    def await_text(text: str) -> None:
        nonlocal output
        while text not in output:
            assert select.select([terminal], [], [], deadline.remaining_s)[0], output
            output += os.read(terminal, 4096).decode(errors="replace")

    try:
        # Text that is typed before the shell has configured the terminal and printed its prompt can be lost. The
        # shell joins the parts of the word, so that the echo of the input does not match.
        os.write(terminal, f"{setup}; PS1=re''ady\n".encode())
        await_text("ready")
        output = ""
        os.write(terminal, f"{line}\t".encode())
        await_text(LINES[line].removeprefix(line))
        os.write(terminal, b"\x15exit\n")
        return output
    finally:
        os.close(terminal)
        os.waitpid(pid, 0)


@pytest.mark.emulated
@pytest.mark.parametrize("line", LINES)
@pytest.mark.parametrize(
    ("shell", "setup"),
    [
        (["bash", "--norc", "--noprofile", "-i"], 'eval "$(fieldkit completion bash)"'),
        (["zsh", "-f", "-i"], 'autoload -U compinit; compinit -u -D; eval "$(fieldkit completion zsh)"'),
    ],
    ids=["bash", "zsh"],
)
def test_the_tab_key_completes_a_line(lab: Path, shell: list[str], setup: str, line: str) -> None:
    assert LINES[line].removeprefix(line) in output_after_tab(lab, shell, setup, line)


@pytest.mark.emulated
@pytest.mark.parametrize("line", LINES)
def test_fish_completes_a_line(lab: Path, line: str) -> None:
    script = f"fieldkit completion fish | source; complete --do-complete '{line}'"
    completed = subprocess.run(
        ["fish", "--no-config", "--command", script],
        cwd=lab,
        env=environment(lab),
        capture_output=True,
        text=True,
        check=True,
        timeout=LIMIT_S,
    )
    assert [word.split("\t")[0] for word in completed.stdout.splitlines()] == [LINES[line].split()[-1]]
