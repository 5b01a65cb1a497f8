"""Packages of step kinds that do not ship with fieldkit; their versions and code hashes are part of a plan."""

import hashlib
from collections.abc import Iterable, Iterator, Mapping
from importlib.util import find_spec
from pathlib import Path
from typing import Final

from fieldkit.config.schema import Strict
from fieldkit.core import plugins
from fieldkit.steps import base, kinds

_HASH_DIGITS: Final = 16


class StepPackage(Strict):
    """The package that a kind of step comes from.

    Attributes:
        package: Its name.
        version: Its version.
        code_sha256: Hash over the Python files of its top-level module; empty if there are none.
    """

    package: str
    version: str
    code_sha256: str = ""


def of_kinds(names: Iterable[str]) -> dict[str, StepPackage]:
    """Return the package of each kind of step that does not ship with fieldkit."""
    others = set(names) - kinds.shipped()
    return {
        point.name: StepPackage(
            package=point.dist.name, version=point.dist.version, code_sha256=_code_hash(point.module)
        )
        for point in plugins.entry_points(plugins.STEPS)
        if point.name in others and point.dist is not None
    }


def changes(planned: Mapping[str, StepPackage]) -> Iterator[str]:
    """Yield a sentence for each kind of step whose code differs from the plan although the version is equal."""
    for kind, current in of_kinds(planned).items():
        frozen = planned[kind]
        if (frozen.package, frozen.version) == (
            current.package,
            current.version,
        ) and frozen.code_sha256 != current.code_sha256:
            yield (
                f"the code of the step {kind} ({current.package} {current.version}) has changed since the trial "
                "started: its repeats are measured by two versions of it"
            )


def missing(document: object) -> str | None:
    """Return a sentence that names the kinds of step of a frozen plan that are not installed; None if all are.

    Args:
        document: The plan as plain data, before it is validated.
    """
    packages = document.get("step_packages") if isinstance(document, dict) else None
    if not isinstance(packages, dict):
        return None
    absent = [kind for kind in packages if kind not in base.step_types()]
    if not absent:
        return None
    sources = (packages[kind] if isinstance(packages[kind], dict) else {} for kind in absent)
    descriptions = (
        f"step kind `{kind}` from {source.get('package', 'an unknown package')} {source.get('version', '')}".strip()
        for kind, source in zip(absent, sources, strict=True)
    )
    return f"{', '.join(descriptions)} {'is' if len(absent) == 1 else 'are'} not installed"


def _code_hash(module: str) -> str:
    """Return the hash over the names and contents of the Python files of a module's top-level package."""
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
