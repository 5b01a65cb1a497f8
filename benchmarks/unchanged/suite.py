"""Compare the tests of two commits, except for imports, names and labels.

Functions are compared by their shape: the syntax tree without names, docstrings, annotations and imports. Only the
digits of a string are compared. A function is matched with one of the same shape anywhere in the other tests, so it
may move; the remaining functions are matched by name. Inside an `assert` statement equal names must remain equal, so
that `assert a == b` differs from `assert a == a`. Elsewhere, as in `pytest.raises`, a replaced name is not detected.
"""

import ast
from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

_SKIPPED: Final = frozenset(("ctx", "annotation", "returns", "type_comment", "type_params", "type_ignores"))
_CHECKS: Final = frozenset(("raises", "warns", "fail", "approx"))
"""Functions of pytest that check something, or set a tolerance."""


@dataclass(frozen=True)
class Unit:
    """A function or method, or the other statements of a module.

    Attributes:
        file: Its file, relative to the folder of tests.
        name: Its name, preceded by that of its class.
        shape: Its syntax tree without names.
        assertions: The shape of each assertion.
        sources: Line and source of each assertion, by the assertion's shape.
        numbers: Its numbers, including the numbers in strings.
    """

    file: str
    name: str
    shape: str
    assertions: Counter[str] = field(compare=False)
    sources: dict[str, str] = field(compare=False)
    numbers: Counter[str] = field(compare=False)

    @property
    def is_test(self) -> bool:
        """True if pytest runs it."""
        return self.name.rpartition(".")[2].startswith("test")

    def __str__(self) -> str:
        return f"{self.file}::{self.name}"


@dataclass
class Changes:
    """Differences between the tests of two commits, except for names.

    Attributes:
        same: Number of tests that are the same.
        added: Number of tests that the second commit adds.
        removed: Tests, and helpers with assertions, that the second commit does not have.
        assertions: Assertions that are missing in a function of the second commit, and the new ones of this function.
        bodies: Functions without a missing assertion, but with other statements, numbers or additional assertions.
    """

    same: int = 0
    added: int = 0
    removed: list[str] = field(default_factory=list)
    assertions: list[str] = field(default_factory=list)
    bodies: list[str] = field(default_factory=list)

    @property
    def has_differences(self) -> bool:
        """True if anything differs except for added tests."""
        return bool(self.removed or self.assertions or self.bodies)

    def summary(self) -> str:
        """Return one line with counts."""
        return (
            f"{'tests:':40} {self.same:5} the same except for names, {self.added:4} added,"
            f" {len(self.removed):4} removed,"
            f" {len(self.assertions):4} assertions and {len(self.bodies):4} bodies changed"
        )

    def lines(self) -> Iterator[str]:
        """Yield a line for each difference."""
        yield from (f"removed: {line}" for line in self.removed)
        yield from (f"assertion: {line}" for line in self.assertions)
        yield from (f"body: {line}" for line in self.bodies)


def compare(before: Path, after: Path) -> Changes:
    """Compare two folders of tests.

    Raises:
        SyntaxError: A file is not valid Python.
    """
    old_units, new_units = list(units(before)), list(units(after))
    pairs, old_units, new_units = _match_by_shape(old_units, new_units)
    changes = Changes(same=sum(old.is_test for old in pairs))
    named, old_units, new_units = _match_by_name(old_units, new_units)
    for old, new in named:
        _add_differences(changes, old, new)
    changes.removed = [str(old) for old in old_units if old.is_test or old.assertions]
    changes.added = sum(new.is_test for new in new_units)
    return changes


def _match_by_shape(
    old_units: Sequence[Unit], new_units: Sequence[Unit]
) -> tuple[list[Unit], list[Unit], list[Unit]]:
    """Return the old units that have a partner of the same shape, and the unmatched units of both."""
    # Units of the same name are matched first, so that a remaining copy is the removed one. A test is matched
    # only with a test, because pytest does not run functions with other names.
    partners: defaultdict[tuple[str, bool], list[Unit]] = defaultdict(list)
    for new in new_units:
        partners[new.shape, new.is_test].append(new)
    matched: list[Unit] = []
    unmatched = old_units
    for is_match in (lambda a, b: str(a) == str(b), lambda a, b: a.name == b.name, lambda *_: True):
        still_unmatched = []
        for old in unmatched:
            partner = next((new for new in partners[old.shape, old.is_test] if is_match(old, new)), None)
            if partner is None:
                still_unmatched.append(old)
            else:
                partners[old.shape, old.is_test].remove(partner)
                matched.append(old)
        unmatched = still_unmatched
    return matched, list(unmatched), [new for group in partners.values() for new in group]


def _match_by_name(
    old_units: Sequence[Unit], new_units: Sequence[Unit]
) -> tuple[list[tuple[Unit, Unit]], list[Unit], list[Unit]]:
    """Return pairs of units with the same file and name, or with the same name, and the unmatched units of both."""
    pairs = []
    unmatched_new_units = list(new_units)
    unmatched: list[Unit] = list(old_units)
    for key in (str, lambda unit: unit.name if unit.is_test else None):
        still_unmatched = []
        for old in unmatched:
            partner = next(
                (new for new in unmatched_new_units if key(old) is not None and key(old) == key(new)), None
            )
            if partner is None:
                still_unmatched.append(old)
            else:
                unmatched_new_units.remove(partner)
                pairs.append((old, partner))
        unmatched = still_unmatched
    return pairs, unmatched, unmatched_new_units


def _add_differences(changes: Changes, old: Unit, new: Unit) -> None:
    lost = old.assertions - new.assertions
    if lost:
        gained = [new.sources[shape] for shape in new.assertions - old.assertions]
        changes.assertions += [f"{old}: {old.sources[shape]}" for shape in lost.elements()]
        changes.assertions += [f"  now {new}: {source}" for source in gained]
    else:
        fewer, more = old.numbers - new.numbers, new.numbers - old.numbers
        numbers = f"numbers {sorted(fewer.elements())} -> {sorted(more.elements())}"
        changes.bodies.append(f"{old}: {numbers if fewer or more else 'other statements'}")


def units(folder: Path) -> Iterator[Unit]:
    """Yield the units of all modules in a folder of tests."""
    for path in sorted(folder.rglob("*.py")):
        yield from module_units(path.read_text(encoding="utf-8"), str(path.relative_to(folder)))


def module_units(source: str, file: str) -> Iterator[Unit]:
    """Yield the units of a module."""
    module = ast.parse(source, file)
    imports = {
        (alias.asname or alias.name).partition(".")[0]
        for node in ast.walk(module)
        if isinstance(node, ast.Import | ast.ImportFrom)
        for alias in node.names
    }
    yield from _units_in(module.body, "", file, imports)


def _units_in(body: Sequence[ast.stmt], prefix: str, file: str, imports: set[str]) -> Iterator[Unit]:
    statements: list[ast.stmt] = []
    for node in body:
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            yield _unit([node], f"{prefix}{node.name}", file, imports)
        elif isinstance(node, ast.ClassDef):
            yield from _units_in(node.body, f"{prefix}{node.name}.", file, imports)
            statements += [ast.Expr(value) for value in (*node.bases, *node.decorator_list)]
        else:
            statements.append(node)
    if statements := [
        node for node in statements if not isinstance(node, ast.Import | ast.ImportFrom) and not _is_docstring(node)
    ]:
        yield _unit(statements, f"{prefix}(statements)", file, imports)


def _is_docstring(node: ast.stmt) -> bool:
    """Return True if a statement is only a string: a docstring, also of a constant."""
    return isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str)


def _unit(nodes: Sequence[ast.stmt], name: str, file: str, imports: set[str]) -> Unit:
    shaper = _Shaper(imports)
    shape = ";".join(shaper.shape(node) for node in nodes)
    assertions: Counter[str] = Counter()
    sources = {}
    for top in nodes:
        for node in ast.walk(top):
            if _is_assertion(node):
                assertion_shape = _Shaper(imports).shape(node)
                assertions[assertion_shape] += 1
                sources[assertion_shape] = (
                    f"line {getattr(node, 'lineno', '?')}: {' '.join(ast.unparse(node).split())[:200]}"
                )
    return Unit(file, name, shape, assertions, sources, shaper.numbers)


def _is_assertion(node: ast.AST) -> bool:
    if isinstance(node, ast.Call):
        called = node.func.attr if isinstance(node.func, ast.Attribute) else getattr(node.func, "id", "")
        return called in _CHECKS or called.startswith("assert_")
    return isinstance(node, ast.Assert)


class _Shaper:
    """Writes syntax trees without names, and collects numbers.

    Args:
        imports: Names that imports bind: `module.name` of these counts as one name, because imports may change.
    """

    def __init__(self, imports: set[str]) -> None:
        self.numbers: Counter[str] = Counter()
        self._imports = imports
        self._indices: dict[str, int] | None = None

    def shape(self, node: ast.AST) -> str:
        """Return the shape of a tree."""
        if isinstance(node, ast.Assert) and self._indices is None:
            self._indices = {}
            try:
                return self._shape(node)
            finally:
                self._indices = None
        return self._shape(node)

    def _shape(self, node: ast.AST) -> str:
        if isinstance(node, ast.Constant):
            return self._constant(node.value)
        if isinstance(node, ast.Name):
            return self._name(node.id)
        if isinstance(node, ast.Attribute):
            dotted = self._dotted(node)
            return self._name(dotted) if dotted else f"{self.shape(node.value)}.{self._name(node.attr)}"
        if isinstance(node, ast.AnnAssign) and node.value is not None:
            return self._shape(ast.Assign([node.target], node.value))
        return f"{type(node).__name__}({','.join(self._fields(node))})"

    def _fields(self, node: ast.AST) -> Iterator[str]:
        for name, value in ast.iter_fields(node):
            if name in _SKIPPED:
                continue
            if isinstance(value, ast.AST):
                yield self.shape(value)
            elif isinstance(value, list):
                parts = [
                    self.shape(part)
                    for part in value
                    if isinstance(part, ast.AST)
                    and not isinstance(part, ast.Import | ast.ImportFrom)
                    and not (isinstance(part, ast.stmt) and _is_docstring(part))
                ]
                yield f"[{','.join(parts)}]"
            elif not isinstance(value, str):
                yield repr(value)

    def _constant(self, value: object) -> str:
        if isinstance(value, str | bytes):
            text = value.decode("latin-1") if isinstance(value, bytes) else value
            digits = "".join(character if character.isdigit() else " " for character in text).split()
            self.numbers.update(digits)
            return f"'{' '.join(digits)}'"
        if isinstance(value, int | float | complex) and not isinstance(value, bool):
            self.numbers[repr(value)] += 1
        return repr(value)

    def _dotted(self, node: ast.Attribute) -> str:
        """Return `module.name` if the module is imported, or an empty string."""
        parts = [node.attr]
        inner: ast.expr = node.value
        while isinstance(inner, ast.Attribute):
            parts.append(inner.attr)
            inner = inner.value
        if isinstance(inner, ast.Name) and inner.id in self._imports and len(parts) == 1:
            return f"{inner.id}.{node.attr}"
        return ""

    def _name(self, name: str) -> str:
        if self._indices is None:
            return "n"
        return f"n{self._indices.setdefault(name, len(self._indices))}"
