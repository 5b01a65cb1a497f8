"""The documentation is correct: its commands run, and its keys, options, exit codes and links exist."""

import ast
import inspect
import os
import re
import runpy
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Any

import pytest
from typing_extensions import get_protocol_members

from docs.generator import pages as reference
from docs.generator.commands import GUIDES
from docs.generator.models import rows
from fieldkit import cli
from fieldkit.backends.protocols import Backend, Testbed
from fieldkit.config import documentation
from fieldkit.steps.base import Step
from fieldkit.steps.kinds.run import RunStep
from tests.helpers.labs import built_in_ros
from tests.helpers.paths import ROOT
from tests.helpers.runs import run_here

PAGES = sorted([*(ROOT / "docs").rglob("*.md"), *ROOT.glob("*.md")])
COMMAND_S = 600.0
DEBIAN_ROS = {"README.md", "tutorial.md"}
"""Pages whose trials use Debian's ROS if it is installed; the other pages use the built-in ROS to save time."""
NEEDS_NO_SITE = re.compile(r"fieldkit\.yaml|^ls|fieldkit (init|lab)|fieldkit --?")
"""Commands that need a folder without a site file."""

PLAIN = re.compile(r"fieldkit (?!lab (?:up|shell))(?P<words>[^|<>;&$'\"\n]*)(?P<shell_part>[|>][^\n]*)?")
"""A command that this process can run. `fieldkit lab up` would leave a fork of the process in the background, and
`lab shell` would replace the process."""

TOPIC = re.compile(r"fieldkit docs ([a-z][a-z0-9_-]*)")
MARKDOWN_FILE = re.compile(r"[\w/-]+\.md\b")

REPRODUCIBLE = re.compile(r"^ls |--dry-run| show | verify ")
"""Commands whose output has the same lines each time, except for numbers."""

BLOCK = re.compile(r"^```(?P<language>\w+)\n(?P<body>.*?)^```$", re.MULTILINE | re.DOTALL)
LINK = re.compile(r"\]\((?P<target>[^)\s#]+)")


def page_id(page: Path) -> str:
    return str(page.relative_to(ROOT))


def blocks(page: Path, language: str) -> list[str]:
    return [
        match["body"] for match in BLOCK.finditer(page.read_text(encoding="utf-8")) if match["language"] == language
    ]


@dataclass(frozen=True)
class Command:
    """A command with its here-document, and the exit code and output shown on the page."""

    text: str
    exit_code: int
    output: str


def shape(output: str) -> list[str]:
    """Return the sorted lines of an output without the parts that differ between runs: numbers and column widths."""
    return sorted(re.sub(r"[ ─]+", " ", re.sub(r"[0-9a-f]{12,}|[0-9][0-9.T]*Z?", "N", output)).splitlines())


def commands(page: Path) -> Iterator[Command]:
    for block in blocks(page, "console"):
        lines = iter(block.splitlines())
        texts: list[list[str]] = []
        codes: list[int] = []
        outputs: list[list[str]] = []
        for line in lines:
            if line.startswith("$ "):
                texts.append([line.removeprefix("$ ")])
                codes.append(0)
                outputs.append([])
                if line.endswith("<<'EOF'"):
                    while texts[-1][-1] != "EOF":
                        texts[-1].append(next(lines))
            elif declared_code := re.fullmatch(r"# exit code (\d+)", line):
                codes[-1] = int(declared_code[1])
            else:
                outputs[-1].append(f"{line}\n")
        for text, code, output in zip(texts, codes, outputs, strict=True):
            yield Command("\n".join(text), code, "".join(output))


def make_targets() -> set[str]:
    return set(re.findall(r"^([a-z]+):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE))


def run_command(text: str, folder: Path) -> tuple[int, str]:
    """Run a command in a folder; return its exit code and its output.

    `fieldkit` with plain words runs in this process, and a shell runs only the remainder of its line, `| grep 'x'`.
    """
    if (plain := PLAIN.fullmatch(text)) is None:
        return run_in_shell(text, folder)
    words = [path for word in plain["words"].split() for path in expand(word, folder)]
    with Path(os.devnull).open(encoding="utf-8") as empty_file, pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "stdin", empty_file)
        run = run_here(folder, *words)
    if not plain["shell_part"]:
        return run.code, run.err + run.out
    code, output = run_in_shell(f"cat {plain['shell_part']}", folder, run.out)
    return code, run.err + output


def expand(word: str, folder: Path) -> list[str]:
    """Return the paths that match a pattern, relative to the folder; the word itself if no path matches."""
    paths = sorted(folder.glob(word)) if "*" in word else []
    return [str(path.relative_to(folder)) for path in paths] or [word]


def run_in_shell(text: str, folder: Path, stdin: str = "") -> tuple[int, str]:
    process = subprocess.run(
        ("bash", "-euc", text),
        cwd=folder,
        env=os.environ | {"PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}"},
        input=stdin,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        timeout=COMMAND_S,
        check=False,
    )
    return process.returncode, process.stdout


def run_commands(page: Path, folder: Path) -> None:
    """Run the commands of a page in an empty folder."""
    if page.name not in DEBIAN_ROS and not any(NEEDS_NO_SITE.search(command.text) for command in commands(page)):
        built_in_ros(folder)
    for command in commands(page):
        if target := re.fullmatch(r"make ([a-z]+)", command.text):
            assert target[1] in make_targets()
            continue
        code, output = run_command(command.text, folder)
        assert code == command.exit_code, f"$ {command.text}\n{output}"
        if command.output and REPRODUCIBLE.search(command.text):
            assert shape(command.output) == shape(output), f"$ {command.text}\n{output}"


COMMAND_PAGES = sorted(
    (page for page in PAGES if any(commands(page))), key=lambda page: len(list(commands(page))), reverse=True
)


# pytest-xdist runs the tests of a class in one process. Two classes distribute the pages, sorted by their number of
# commands, over two processes.
@pytest.mark.emulated
class TestFirstHalf:
    @pytest.mark.parametrize("page", COMMAND_PAGES[::2], ids=page_id)
    def test_every_command_of_a_page_runs(self, page: Path, tmp_path: Path) -> None:
        run_commands(page, tmp_path)


@pytest.mark.emulated
class TestSecondHalf:
    @pytest.mark.parametrize("page", COMMAND_PAGES[1::2], ids=page_id)
    def test_every_command_of_a_page_runs(self, page: Path, tmp_path: Path) -> None:
        run_commands(page, tmp_path)


def test_a_command_keeps_its_here_document_and_its_exit_code(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    page.write_text(
        "```console\n$ cat > a <<'EOF'\n$ no prompt\nEOF\n$ false\n# exit code 1\nerror: said\n```\n",
        encoding="utf-8",
    )
    assert list(commands(page)) == [
        Command("cat > a <<'EOF'\n$ no prompt\nEOF", 0, ""),
        Command("false", 1, "error: said\n"),
    ]


@pytest.mark.parametrize("page", PAGES, ids=page_id)
def test_every_link_resolves(page: Path) -> None:
    targets = (match["target"] for match in LINK.finditer(page.read_text(encoding="utf-8")))
    missing = [target for target in targets if "://" not in target and not (page.parent / target).exists()]
    assert not missing


@pytest.mark.parametrize("page", [page for page in PAGES if blocks(page, "python")], ids=page_id)
def test_python_examples_import_and_are_complete(page: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(ROOT)
    for source in blocks(page, "python"):
        names: dict[str, Any] = {"__name__": "example"}
        exec(compile(source, page.name, "exec"), names)
        example_classes = [
            value for value in names.values() if inspect.isclass(value) and value.__module__ == "example"
        ]
        assert not [kind for kind in example_classes if issubclass(kind, Step) and inspect.isabstract(kind)]


def test_the_example_of_a_backend_has_the_members_of_its_protocols() -> None:
    module = runpy.run_path(str(ROOT / "docs" / "examples" / "fieldkit-bench" / "bench.py"))
    for protocol, kind in ((Backend, module["BenchBackend"]), (Testbed, module["BenchTestbed"])):
        assert not set(get_protocol_members(protocol)) - set(dir(kind))


def test_the_reference_is_up_to_date() -> None:
    generated = reference.pages()
    assert {path.name for path in reference.FOLDER.glob("*.md")} == set(generated)
    differing_pages = [
        name for name, text in generated.items() if (reference.FOLDER / name).read_text("utf-8") != text
    ]
    assert not differing_pages, "write them again: .venv/bin/python -m docs.generator"


def test_every_row_of_the_reference_has_a_meaning() -> None:
    for name, text in reference.pages().items():
        incomplete_rows = [line for line in text.splitlines() if line.startswith("| ") and line.endswith("|  |")]
        assert not incomplete_rows, name


def test_a_key_has_the_meaning_of_its_field_and_not_of_an_attribute_of_the_base_class() -> None:
    meanings = {key: meaning for key, _, meaning in rows(RunStep)}
    assert meanings["`columns`"] == "Columns of `trial.csv`, each read from the output."


def test_every_page_is_in_the_sidebar() -> None:
    navigation = (ROOT / ".ci" / "mkdocs.yml").read_text(encoding="utf-8").partition("\nnav:\n")[2]
    listed_pages = re.findall(r"([\w/-]+\.md)$", navigation, re.MULTILINE)
    pages = [str(page.relative_to(ROOT / "docs")) for page in PAGES if page.is_relative_to(ROOT / "docs")]
    assert sorted(listed_pages) == sorted(pages)


def test_every_guide_named_by_a_command_exists() -> None:
    assert not [guide for guide in GUIDES.values() if not (ROOT / "docs" / guide).is_file()]
    assert not set(GUIDES) - set(cli.parser().subcommands())


def visible_texts() -> Iterator[tuple[str, str]]:
    """Yield every user-visible text and its location: strings in code, and shipped YAML."""
    for path in chain((ROOT / "fieldkit").rglob("*.py"), (ROOT / "sim_backends").rglob("*.py")):
        tree = ast.parse(path.read_text(encoding="utf-8"))
        docstrings = {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}
        for node in ast.walk(tree):
            if isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in docstrings:
                yield f"{path.relative_to(ROOT)}:{node.lineno}", node.value
    for folder in ("fieldkit", "sim_backends", "robots", "procedures"):
        for path in (ROOT / folder).rglob("*.yaml"):
            text = path.read_text(encoding="utf-8")
            # Comments of profiles name files of other projects as the sources of their values.
            yield str(path.relative_to(ROOT)), re.sub(r"#.*", "", text) if folder == "robots" else text


def test_messages_refer_only_to_installed_pages() -> None:
    texts = list(visible_texts())
    topics = [(place, topic) for place, text in texts for topic in TOPIC.findall(text)]
    assert len(topics) > 10
    unknown_topics = [(place, topic) for place, topic in topics if topic not in documentation.topics()]
    files = [(place, name) for place, text in texts for name in MARKDOWN_FILE.findall(text)]
    assert (unknown_topics, files) == ([], [])
