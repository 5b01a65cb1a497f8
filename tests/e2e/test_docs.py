"""What the documentation says is so: its commands run, its keys, options, codes and links exist."""

import argparse
import inspect
import os
import re
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Annotated, Any, cast, get_args, get_origin

import pytest
from pydantic import TypeAdapter
from pydantic.fields import FieldInfo

from fieldkit import cli
from fieldkit.campaign.plan import CampaignFile
from fieldkit.cli.parser import Parser
from fieldkit.config import schema
from fieldkit.config.profiles import RobotProfile
from fieldkit.config.schema import Strict
from fieldkit.config.site import Site
from fieldkit.core import errors
from fieldkit.steps.base import Step, known
from fieldkit.trial.procedure import Procedure
from sim_backends.cosim.scenario.faults import Fault
from sim_backends.cosim.scenario.motions import MotionPlan
from sim_backends.cosim.scenario.schema import CosimScenario
from sim_backends.cosim.scenario.traffic import Traffic
from sim_backends.emulated.options import EmulatedOptions
from tests.helpers.paths import ROOT

PAGES = sorted([*(ROOT / "docs").glob("*.md"), *ROOT.glob("*.md")])
REFERENCE = (ROOT / "docs" / "reference.md").read_text(encoding="utf-8")
COMMAND_S = 600.0

MEASURES_NOTHING = re.compile(r"^ls |--dry-run| show | verify ")
"""Commands whose output has the same lines each time, numbers apart."""

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
    """A command as a reader types it, here-document included, and the exit code and output that the page shows."""

    text: str
    exit_code: int
    shown: str


def shape(output: str) -> list[str]:
    """Return the lines of an output without what differs from run to run: numbers, widths of columns, order."""
    return sorted(re.sub(r"[ ─]+", " ", re.sub(r"[0-9a-f]{12,}|[0-9][0-9.T]*Z?", "N", output)).splitlines())


def commands(page: Path) -> Iterator[Command]:
    for block in blocks(page, "console"):
        lines = iter(block.splitlines())
        texts: list[list[str]] = []
        codes: list[int] = []
        shown: list[list[str]] = []
        for line in lines:
            if line.startswith("$ "):
                texts.append([line.removeprefix("$ ")])
                codes.append(0)
                shown.append([])
                if line.endswith("<<'EOF'"):
                    while texts[-1][-1] != "EOF":
                        texts[-1].append(next(lines))
            elif announced := re.fullmatch(r"# exit code (\d+)", line):
                codes[-1] = int(announced[1])
            else:
                shown[-1].append(f"{line}\n")
        for text, code, output in zip(texts, codes, shown, strict=True):
            yield Command("\n".join(text), code, "".join(output))


def make_targets() -> set[str]:
    return set(re.findall(r"^([a-z]+):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE))


def rows(section: str) -> dict[str, str]:
    """Return the first column (bare) and the second of every table row in a section of the reference."""
    found = re.search(rf"^##+ {re.escape(section)}$(.*?)(?=^## |^### |\Z)", REFERENCE, re.MULTILINE | re.DOTALL)
    assert found, f"docs/reference.md has no section {section!r}"
    cells = (line.split(" | ") for line in found[1].splitlines() if line.startswith("| `"))
    return {first.removeprefix("| `").partition("`")[0]: second for first, second, *_ in cells}


def models_in(annotation: object) -> Iterator[tuple[str, type[Strict]]]:
    """Yield the models in an annotation, each with what stands between its name and that of its field."""
    if inspect.isclass(annotation) and issubclass(annotation, Strict):
        yield "", annotation
        return
    if any(isinstance(part, FieldInfo) and part.discriminator for part in get_args(annotation)):
        return  # kinds have tables of their own
    origin = get_origin(annotation)
    mark = "[]" if origin is tuple else ".*" if origin is dict else ""
    for part in get_args(annotation):
        yield from ((mark + inner, model) for inner, model in models_in(part))


def keys(model: type[Strict], prefix: str = "") -> Iterator[tuple[str, FieldInfo]]:
    """Yield every key that a file of `model` may have, as the reference writes it; steps have tables of their own."""
    for name, field in model.model_fields.items():
        key = prefix + (field.alias or name)
        yield key, field
        if field.discriminator:
            continue
        for mark, inner in models_in(field.annotation):
            yield from keys(inner, f"{key}{mark}.")


SITE = [(key, field) for key, field in keys(Site)] + list(keys(EmulatedOptions, "emulated."))
FILES = {
    "Robot profile": list(keys(RobotProfile)),
    "Procedure": list(keys(Procedure)),
    "Campaign": list(keys(CampaignFile)),
    "Site file": SITE,
}
SCENARIO = {"Scenario file": [one for one in keys(CosimScenario) if not one[0].startswith("radio.")]}
KINDS = {
    f"{what} {model.model_fields['kind'].annotation.__args__[0]}": list(keys(model))
    for what, union in {"Motion": MotionPlan, "Traffic": Traffic, "Fault": Fault}.items()
    for model in get_args(get_args(union)[0])
}
EVERY_STEP = dict(keys(Step))
STEPS = {"Every step": list(EVERY_STEP.items())} | {
    f"Step {kind}": [
        (key, field)
        for key, field in keys(model)
        if key not in EVERY_STEP or field.default != EVERY_STEP[key].default
    ]
    for kind, model in known().items()
}
TABLES = FILES | STEPS | SCENARIO | KINDS


@pytest.mark.emulated
@pytest.mark.parametrize("page", [page for page in PAGES if any(commands(page))], ids=page_id)
def test_every_command_of_a_page_runs(page: Path, tmp_path: Path) -> None:
    environment = os.environ | {"PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}"}
    for command in commands(page):
        if target := re.fullmatch(r"make ([a-z]+)", command.text):
            assert target[1] in make_targets()
            continue
        done = subprocess.run(
            ("bash", "-euc", command.text),
            cwd=tmp_path,
            env=environment,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            timeout=COMMAND_S,
            check=False,
        )
        assert done.returncode == command.exit_code, f"$ {command.text}\n{done.stdout}"
        if command.shown and MEASURES_NOTHING.search(command.text):
            assert shape(command.shown) == shape(done.stdout), f"$ {command.text}\n{done.stdout}"


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
        steps = [one for one in names.values() if inspect.isclass(one) and issubclass(one, Step) and one is not Step]
        assert not [step for step in steps if inspect.isabstract(step)]


@pytest.mark.parametrize("section", TABLES)
def test_the_reference_names_every_key_and_no_other(section: str) -> None:
    assert sorted(rows(section)) == sorted(key for key, _ in TABLES[section])


@pytest.mark.parametrize(
    ("section", "key", "field"),
    [(section, key, field) for section, table in TABLES.items() for key, field in table],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_the_reference_gives_the_default(section: str, key: str, field: FieldInfo) -> None:
    said = rows(section)[key]
    if field.is_required():
        assert said == "required"
        return
    default = field.get_default(call_default_factory=True)
    if default is None or field is EVERY_STEP["name"]:
        assert said in {"none", "all defaults", "its `host`"}
    elif isinstance(default, Strict):
        assert default == type(default)(), "the default of a section is all its defaults"
        assert said in {"all defaults", "as below"}
    else:
        written = schema.parse(said.strip("`"), source="docs/reference.md").data
        # Without its alias, which has no meaning outside of its model.
        bare = Annotated[field.annotation, *field.metadata] if field.metadata else field.annotation
        wanted: TypeAdapter[Any] = TypeAdapter(cast("Any", bare))
        assert wanted.validate_python(written) == default


def subcommands(parser: argparse.ArgumentParser) -> dict[str, argparse.ArgumentParser]:
    actions = (action for action in parser._actions if isinstance(action, argparse._SubParsersAction))
    return {name: parser for action in actions for name, parser in action.choices.items()}


def test_the_reference_names_every_command_with_its_options() -> None:
    command_line = REFERENCE.partition("## Command line")[2].partition("## Exit codes")[0]
    for name, parser in subcommands(cli.parser()).items():
        if isinstance(parser, Parser):
            parser.complete()
        heading = re.search(rf"^### .*fieldkit {name}\b.*$", command_line, re.MULTILINE)
        assert heading, f"docs/reference.md has no section on fieldkit {name}"
        section = command_line[heading.end() :].partition("\n### ")[0]
        for inner in subcommands(parser):
            assert f"fieldkit {name} {inner}" in section
        for action in chain(*(one._actions for one in (parser, *subcommands(parser).values()))):
            for option in action.option_strings:
                assert option in {"-h", "--help"} or f"`{option}`" in section, f"{option} of fieldkit {name}"


def test_the_reference_names_every_exit_code() -> None:
    section = REFERENCE.partition("## Exit codes")[2].partition("\n## ")[0]
    families: list[type[errors.FieldkitError]] = [errors.FieldkitError, *errors.FieldkitError.__subclasses__()]
    codes = {0, cli.INTERRUPTED} | {family.exit_code for family in families}
    assert {int(code) for code in re.findall(r"^\| (\d+) \|", section, re.MULTILINE)} == codes
