"""Pages are short, introduce their terms, and name existing commands."""

import ast
import re
import shlex
from collections.abc import Iterator
from pathlib import Path

import pytest
import yaml

from fieldkit import cli
from fieldkit.core.errors import ConfigurationError
from tests.helpers.paths import ROOT

DOCS = ROOT / "docs"
MAX_PAGE_BYTES = 20_000
TOTAL_BYTES = 300_000
CHANGELOG_BYTES = 6_000
GENERATED = {"reference.md", "errors.md", "evidence.md"}
CITATION = "index.md#how-to-cite"
PAGES = sorted([*DOCS.rglob("*.md"), *ROOT.glob("*.md")])
HAND_WRITTEN = [page for page in DOCS.rglob("*.md") if page.name not in GENERATED and page.parent.name != "reference"]

FENCE = re.compile(r"^```.*?^```$", re.MULTILINE | re.DOTALL)
IN_TABLE = re.compile(r"`(fieldkit [a-z][^`]*)`")
END_OF_COMMAND = re.compile(r" (?:\||>|&&|2>|;) ")
PLACEHOLDER = re.compile(r"\.\.\.|[|\[<{]|\bROBOT\b.*\.\.\.")
EXTERNAL = {"worst", "docs"}
"""Commands of packages that are not installed here."""


def page_id(page: Path) -> str:
    return str(page.relative_to(ROOT))


def untested_commands(page: Path) -> Iterator[str]:
    """Yield the commands of fieldkit in indented blocks and tables; no other test runs them."""
    text = FENCE.sub("", page.read_text(encoding="utf-8"))
    lines = re.sub(r"\\\n\s*", " ", text).splitlines()
    commands = [line.strip() for line in lines if re.match(r" {4,}fieldkit [a-z-]", line)]
    if page.name == "cheat-sheet.md":
        commands += IN_TABLE.findall(text)
    for command in commands:
        yield END_OF_COMMAND.split(command)[0]


def command_words(command: str) -> list[str]:
    return shlex.split(command, comments=True)[1:]


COMMANDS = [
    pytest.param(command, id=f"{page_id(page)}: {command}")
    for page in PAGES
    for command in dict.fromkeys(untested_commands(page))
    if page_id(page) != "docs/reference/commands.md" and not PLACEHOLDER.search(command)
]


@pytest.mark.parametrize("command", COMMANDS)
def test_the_parser_accepts_commands_that_no_test_runs(command: str) -> None:
    arguments = command_words(command)
    if arguments[0] in EXTERNAL:
        pytest.skip("a command of another package")
    cli.parser().parse_args(arguments)


def test_the_parser_rejects_a_wrong_option() -> None:
    with pytest.raises(ConfigurationError):
        cli.parser().parse_args(command_words("fieldkit trial los 30ft --repeat 3x --nope"))


@pytest.mark.parametrize("page", HAND_WRITTEN, ids=page_id)
def test_a_hand_written_page_has_a_limited_length(page: Path) -> None:
    assert page.stat().st_size <= MAX_PAGE_BYTES


WRITTEN_BY_PROGRAMS = re.compile(rb"<!-- written by [\w.:/ ]*-->.*?<!-- (?:written by|end of)[^>]*-->", re.DOTALL)
"""Tables of measurements that a benchmark writes into its page."""


def test_all_hand_written_pages_have_a_limited_total_length() -> None:
    texts = [WRITTEN_BY_PROGRAMS.sub(b"", page.read_bytes()) for page in HAND_WRITTEN]
    assert sum(map(len, texts)) <= TOTAL_BYTES


def test_the_changelog_is_one_page() -> None:
    changelog = ROOT / "CHANGELOG.md"
    assert changelog.stat().st_size <= CHANGELOG_BYTES
    assert re.findall(r"^## (.*)$", changelog.read_text(encoding="utf-8"), re.MULTILINE) == ["[Unreleased]: 0.1.0"]


@pytest.mark.parametrize("page", HAND_WRITTEN, ids=page_id)
def test_the_paper_is_introduced_where_it_is_first_mentioned(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    mention = re.search(r"\bthe \[?paper\b(?!'s loss \(eq)", text, re.IGNORECASE)
    if mention is None or page.name == "index.md":
        return
    beginning, citation, _ = text.partition(CITATION)
    assert citation, f"{page.name} mentions the paper and has no link to {CITATION}"
    mentions_before = re.findall(r"\bthe \[?paper\b", beginning, re.IGNORECASE)
    assert len(mentions_before) <= 2, "the link is in the same paragraph as the first mention"


def labels() -> tuple[set[str], set[str]]:
    """Return the constant labels of all figures in the code, and the longest constant part of the other labels."""
    all_labels, parts = set(), set()
    for path in (ROOT / "fieldkit").rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if not (isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "Figure"):
                continue
            match node.args:
                case [ast.Constant(value=str(label)), *_]:
                    all_labels.add(label)
                case [ast.JoinedStr(values=values), *_]:
                    texts = [value.value for value in values if isinstance(value, ast.Constant)]
                    parts.add(max((str(text) for text in texts), key=len).strip(" ,"))
    return all_labels, parts


def test_the_glossary_has_every_row_of_tables() -> None:
    names = "glossary.md", "reference/table-rows.md"
    page = "".join((DOCS / name).read_text(encoding="utf-8") for name in names)
    first_cells = [line.split(" | ")[0].removeprefix("| ") for line in page.splitlines() if line.startswith("| ")]
    rows = {row for cell in first_cells for row in cell.split("; ")}
    all_labels, parts = labels()
    assert len(all_labels) > 50
    assert sorted(label for label in all_labels if label not in rows) == []
    assert sorted(part for part in parts if not any(part in row for row in rows)) == []


@pytest.mark.parametrize("name", ["github-trial.yml", "gitlab-ci.yml"])
def test_ci_files_of_the_installation_page_are_yaml(name: str) -> None:
    data = yaml.safe_load((DOCS / "examples" / "ci" / name).read_text(encoding="utf-8"))
    text = yaml.safe_dump(data, width=1000)
    commands = [line[line.index("fieldkit trial") :] for line in text.splitlines() if "fieldkit trial" in line]
    assert commands
    for command in commands:
        cli.parser().parse_args(command_words(command))
