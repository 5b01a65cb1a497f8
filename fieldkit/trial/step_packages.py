"""Packages of the kinds of step that do not ship with fieldkit; a plan contains their versions and code hashes."""

import hashlib
from collections.abc import Iterable
from importlib.util import find_spec
from pathlib import Path
from typing import Final

from fieldkit.config.schema import Strict
from fieldkit.core import plugins
from fieldkit.steps import kinds

_HASH_DIGITS: Final = 16


class StepPackage(Strict):
    """The package that contains a kind of step.

    Attributes:
        package: Name of the package.
        version: Version of the package.
        code_sha256: First 16 hex digits of the SHA-256 hash of the names and contents of the Python files of its
            top-level module; empty if there are no such files.
    """

    package: str
    version: str
    code_sha256: str = ""


def packages_of_kinds(names: Iterable[str]) -> dict[str, StepPackage]:
    """Return the packages of the kinds of step with these names, by name.

    Kinds that ship with fieldkit, and kinds that no installed package declares, are omitted.
    """
    kinds_of_packages = set(names) - kinds.shipped_names()
    return {
        point.name: StepPackage(
            package=point.dist.name, version=point.dist.version, code_sha256=_code_hash(point.module)
        )
        for point in plugins.entry_points(plugins.STEPS)
        if point.name in kinds_of_packages and point.dist is not None
    }


def _code_hash(module: str) -> str:
    """Return `StepPackage.code_sha256` for a module (the top-level module that contains it is hashed)."""
    spec = find_spec(module.partition(".")[0])
    if spec is None:
        return ""
    roots = [Path(folder) for folder in spec.submodule_search_locations or ()]
    files = [(path.relative_to(root).as_posix(), path) for root in roots for path in root.rglob("*.py")]
    if not roots and spec.origin is not None and Path(spec.origin).is_file():
        files = [(Path(spec.origin).name, Path(spec.origin))]
    digest = hashlib.sha256()
    for name, path in sorted(files):
        digest.update(f"{name}\0".encode() + path.read_bytes() + b"\0")
    return digest.hexdigest()[:_HASH_DIGITS] if files else ""
