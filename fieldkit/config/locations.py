"""Names of files: the site file of a lab, and robots and procedures of the lab or of fieldkit itself.

This module imports no YAML reader, so that the command line can list and complete the names quickly.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final, Literal

from fieldkit.core.errors import ConfigurationError, did_you_mean

Kind = Literal["robots", "procedures"]

SITE_FILE: Final = "fieldkit.yaml"
_PACKAGE: Final = Path(__file__).resolve().parents[1]


def default_backend(site: Mapping[str, Any]) -> str:
    """Return the backend of a site file that names none.

    A file with the section `emulated`, but without robots and roles, is for the emulated backend's default robots.
    """
    return "emulated" if "emulated" in site and "robots" not in site and "roles" not in site else "field"


def folders(kind: Kind) -> tuple[Path, ...]:
    """Return the folders searched for `kind`; the first match is used.

    The lab's folder is in the current directory. In a source checkout the shipped files are next to the package; in a
    wheel they are inside the package.
    """
    shipped = _PACKAGE / "data" / kind
    if not shipped.is_dir():
        shipped = _PACKAGE.parent / kind
    lab_folder = Path(kind)
    return (shipped,) if lab_folder.resolve() == shipped else (lab_folder, shipped)


def names(kind: Kind) -> dict[str, Path]:
    """Return every name of `kind` with its file, sorted by name.

    An empty file does not replace a shipped file, because the shell creates an empty file before `fieldkit robots
    show NAME > robots/NAME.yaml` runs.
    """
    paths: dict[str, Path] = {}
    for folder in folders(kind):
        for path in folder.glob("*.yaml"):
            if path.stem not in paths or _is_empty(paths[path.stem]):
                paths[path.stem] = path
    return dict(sorted(paths.items()))


def _is_empty(path: Path) -> bool:
    return path.is_file() and not path.stat().st_size


def copy_profile_command(name: str) -> str:
    """Return the command that copies a robot profile into the lab, where it can be edited."""
    return f"mkdir -p robots; fieldkit robots show {name} > robots/{name}.yaml; then edit that copy"


def find(kind: Kind, name: str) -> Path:
    """Return the file of `name`.

    Raises:
        ConfigurationError: There is no such file; the remedy contains the most similar name.
    """
    paths = names(kind)
    if name in paths:
        return paths[name]
    singular = kind.removesuffix("s")
    raise ConfigurationError(
        f"there is no {'robot profile' if kind == 'robots' else singular} {name!r}",
        remedy=did_you_mean(name, paths, f"names: {', '.join(paths)}; see fieldkit {kind}"),
    )
