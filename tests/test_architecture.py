"""The imports point one way, and one dependency has one importing module (design, section 2; style, rule 11)."""

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent

# A package may import itself and what stands to its right; `basics` are the single modules of fieldkit.
BASICS = {
    "model",
    "units",
    "errors",
    "deadline",
    "documents",
    "events",
    "columns",
    "config",
    "files",
    "geometry",
    "catalog",
    "profiles",
    "prompts",
    "site_file",
    "text",
}
MAY_IMPORT = {
    "cli": {
        "campaign",
        "trial",
        "analysis",
        "report",
        "export",
        "remote",
        "backends",
        "procedures",
        "lab",
        "playground",
    },
    "campaign": {"trial", "backends", "procedures"},
    "trial": {"analysis", "steps", "remote", "measure", "backends", "procedures"},
    "lab": {"playground"},
    "playground": {"backends"},
    "report": {"analysis", "measure", "trial", "playground"},
    "export": {"analysis", "measure", "trial"},
    "analysis": set(),
    "measure": set(),
    "procedures": {"steps"},
    "steps": {"remote", "backends"},
    "backends": {"remote"},
    "field": {"backends", "remote"},
    "remote": set(),
}
# A leaf measures and computes: it must not even know how a profile is read.
LEAVES = {"analysis": {"model", "units", "errors", "columns"}, "measure": {"model", "units", "errors", "columns"}}

ONE_IMPORTER = {
    "yaml": "fieldkit/documents.py",
    "pydantic": "fieldkit/config.py",
    "pydantic_core": "fieldkit/config.py",
    # Two formats, one of each: CSV is read into columns, columns are written as Parquet.
    "pyarrow": "fieldkit/analysis/parsing.py fieldkit/export/table.py",
    "mcap": "fieldkit/export/mcap.py",
    "matplotlib": "fieldkit/report/figures.py",
    "jinja2": "fieldkit/report/page.py",
    "paramiko": "fieldkit/remote/link.py",
    "ruamel": "fieldkit/site_file.py",
    "keyring": "fieldkit/remote/passwords.py",
    "rich": "fieldkit/cli/display.py",
    "cryptography": "sim_backends/emulated/keys.py",
}


def modules(package: str) -> list[Path]:
    return sorted((ROOT / package).rglob("*.py"))


def imported(path: Path) -> Iterator[str]:
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            yield f"{node.module}"
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def room(dotted: str) -> str:
    parts = dotted.split(".")
    return parts[1] if len(parts) > 1 else ""


@pytest.mark.parametrize("path", modules("fieldkit"), ids=lambda path: str(path.relative_to(ROOT)))
def test_imports_point_one_way(path: Path) -> None:
    own = path.relative_to(ROOT / "fieldkit").parts[0].removesuffix(".py")
    for name in imported(path):
        assert not name.startswith("sim_backends"), f"{path} imports {name}"
        target = room(name)
        if not name.startswith("fieldkit.") or not target or target in {own, "__version__"}:
            continue
        if own in LEAVES:
            assert target in LEAVES[own], f"{path} imports {name}"
        elif own in MAY_IMPORT:
            assert target in BASICS | MAY_IMPORT[own], f"{path} imports {name}"
        else:
            assert target in BASICS | {"cli"}, f"{path} imports {name}"


@pytest.mark.parametrize("path", modules("sim_backends"), ids=lambda path: str(path.relative_to(ROOT)))
def test_backends_import_only_the_seams(path: Path) -> None:
    for name in imported(path):
        if name.startswith("fieldkit."):
            assert room(name) in BASICS | {"backends", "playground", "remote"}, f"{path} imports {name}"


@pytest.mark.parametrize(("package", "importer"), ONE_IMPORTER.items())
def test_one_dependency_has_one_importing_module(package: str, importer: str) -> None:
    importers = {
        str(path.relative_to(ROOT))
        for path in modules("fieldkit") + modules("sim_backends")
        if any(name.split(".")[0] == package for name in imported(path))
    }
    assert importers == set(importer.split())


def test_no_sentence_in_the_library_says_emulated() -> None:
    """Steps, trial and remote run unchanged on every backend, so none of them may ask which one it is."""
    for folder in ("steps", "trial", "remote", "measure", "analysis"):
        for path in modules(f"fieldkit/{folder}"):
            assert "emulated" not in path.read_text(encoding="utf-8"), path
