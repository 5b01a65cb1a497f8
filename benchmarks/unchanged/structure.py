"""Numbers of the structure of a tree: lines, files, methods, words, and sizes of pages."""

import ast
import json
import re
import subprocess
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Final

from benchmarks.unchanged.trees import Tree, python

PACKAGES: Final = ("fieldkit", "sim_backends")
_COUNT_IN_DRY_RUN: Final = """
import sys
from pathlib import Path
from fieldkit.cli import main
main(["trial", "los", "30ft", "--dry-run"])
own = {n: m.__file__ for n, m in sys.modules.items() if n.split(".")[0] in {"fieldkit", "sim_backends"}}
print(sum(Path(path).read_text(encoding="utf-8").count(chr(10)) for path in own.values() if path))
"""
MAX_METHODS: Final = 12
MAX_LINES: Final = 400
MAX_PAGE_BYTES: Final = 20_000
MAX_NAMESAKES: Final = 2

AVOIDED_WORDS: Final = {
    "tell, told": r"\b(tells?|told|telling)\b",
    "who, whoever": r"\bwho(ever|se|m)?\b",
    "nobody, somebody, anybody": r"\b(nobody|somebody|anybody)\b",
    "mend": r"\bmend(s|ed|ing)?\b",
    "stand": r"\bst(ands?|ood)\b",
    "is none": r"\b(is|are|was|were|where) none\b",
    "so long, so much, so many": r"\bso (long|much|many)\b",
    "at once": r"\bat once\b",
    "goes on": r"\b(goes?|went|gone|going) on\b",
    "is to": r"\b(is|are|was|were) to\b",
    "return what, whether, how": r"(?i:\breturns? (what|whether|how)\b)",
}
"""Words and phrases that plain technical English does not need, with the expression that finds them."""


def table(base: Tree, head: Tree) -> str:
    """Return a line per number, with its values of both trees, then the files and classes counted in `head`."""
    olds, news = ({**imported(tree), **dict(numbers(tree.code))} for tree in (base, head))
    lines = [f"{'structure':40} {'base':>9} {'head':>9}  target"]
    for name, new in news.items():
        value, _, target = new.partition("; ")
        old = olds[name].partition("; ")[0]
        lines.append(f"{name:40} {old:>9} {value:>9}  {target}".rstrip())
    return "\n".join([*lines, *_details(head.code)])


def imported(tree: Tree) -> dict[str, str]:
    """Return the number of this project's lines imported by a dry run, and by the emulated trial per package.

    The number for the emulated trial is unknown if that part of the comparison was not run.
    """
    command = (*python(), "-c", _COUNT_IN_DRY_RUN)
    completed = subprocess.run(
        command, cwd=tree.folder, env=tree.environment(), capture_output=True, text=True, check=True
    )
    shown = {"own lines in `trial los 30ft --dry-run`": f"{completed.stdout.splitlines()[-1]}; at most 25000"}
    path = tree.results / "imported_lines.json"
    lines = json.loads(path.read_text(encoding="ascii")) if path.exists() else {}
    return shown | {
        f"lines of {package} in an emulated trial": f"{lines.get(package, 'unknown')}" for package in PACKAGES
    }


def numbers(tree: Path) -> Iterator[tuple[str, str]]:
    """Yield the name of each number, and the number, followed by a semicolon and its target if it has one."""
    paths = modules(tree)
    texts = [path.read_text(encoding="utf-8") for path in paths]
    count = sum(text.count("\n") for text in texts)
    yield "lines of code", f"{count}"
    files = [path for path, text in zip(paths, texts, strict=True) if not _is_empty_package(path, text)]
    yield "files per 1,000 lines, without empty `__init__`", f"{1000 * len(files) / count:.2f}; below 6"
    yield "empty `__init__` files", f"{len(paths) - len(files)}"
    yield f"files over {MAX_LINES} lines", f"{sum(text.count(chr(10)) > MAX_LINES for text in texts)}"
    yield "file names used more than twice", f"{len(namesakes(tree))}; 0"
    yield "classes with over 12 public methods", f"{len(large_classes(tree))}; 0"
    pages = sorted((tree / "docs").rglob("*.md"))
    sizes = [path.stat().st_size for path in pages]
    yield "documentation, kB", f"{sum(sizes) / 1000:.0f}; at most 300"
    yield "pages over 20 kB", f"{sum(size > MAX_PAGE_BYTES for size in sizes)}; 0"
    prose = [page.read_text(encoding="utf-8") for page in pages]
    for name, expression in AVOIDED_WORDS.items():
        pattern = re.compile(expression)
        in_code, in_docs = (sum(len(pattern.findall(text)) for text in group) for group in (texts, prose))
        yield f"'{name}' in code", f"{in_code}"
        yield f"'{name}' in documentation", f"{in_docs}"
    bound = Counter(name for text in texts for name in bound_names(text))
    yield "loop variables named one", f"{bound['one']}; 0"
    yield "assignments to found", f"{bound['found']}; 0"


def _details(tree: Path) -> Iterator[str]:
    for name, count in sorted(namesakes(tree).items(), key=lambda pair: -pair[1]):
        yield f"  {count} files named {name}"
    yield from (f"  {methods} public methods: {name}" for name, methods in large_classes(tree).items())


def modules(tree: Path) -> list[Path]:
    """Return the modules of the shipped packages."""
    return sorted(path for package in PACKAGES for path in (tree / package).rglob("*.py"))


def _is_empty_package(path: Path, text: str) -> bool:
    """Return True for an `__init__.py` that contains only a docstring, which Python needs for the package."""
    return path.name == "__init__.py" and all(isinstance(part, ast.Expr) for part in ast.parse(text).body)


def namesakes(tree: Path) -> dict[str, int]:
    """Return file names that are used too often, with their counts."""
    names = Counter(path.name for path in modules(tree) if path.name != "__init__.py")
    return {name: count for name, count in names.items() if count > MAX_NAMESAKES}


def large_classes(tree: Path) -> dict[str, int]:
    """Return the classes that add too many public methods to those of their base classes, with their counts."""
    large = {}
    for path in modules(tree):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ClassDef):
                methods = {
                    part.name
                    for part in node.body
                    if isinstance(part, ast.FunctionDef | ast.AsyncFunctionDef) and _is_new_and_public(part)
                }
                if len(methods) > MAX_METHODS:
                    large[f"{path.relative_to(tree)}: {node.name}"] = len(methods)
    return large


def _is_new_and_public(method: ast.FunctionDef | ast.AsyncFunctionDef) -> bool:
    """Return False for private methods and for overrides, which are counted in the base class."""
    overrides = any(isinstance(mark, ast.Name) and mark.id == "override" for mark in method.decorator_list)
    return not overrides and not method.name.startswith("_")


def bound_names(source: str) -> Iterator[str]:
    """Yield `one` for each loop variable of this name, and `found` for each assignment to that name."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.For | ast.AsyncFor | ast.comprehension):
            yield from (name for name in _names(node.target) if name == "one")
        elif isinstance(node, ast.Assign | ast.AnnAssign | ast.NamedExpr):
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            yield from (name for target in targets for name in _names(target) if name == "found")


def _names(target: ast.expr) -> Iterator[str]:
    for node in ast.walk(target):
        if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            yield node.id
