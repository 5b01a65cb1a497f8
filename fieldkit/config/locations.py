"""Names of a lab's files: its site file, and the robots and procedures of its own beside those that ship.

It imports no reader of YAML, so that the command line can name and complete them at once.
"""

from pathlib import Path
from typing import Final, Literal

from fieldkit.core.errors import ConfigurationError, nearest

Kind = Literal["robots", "procedures"]

SITE_FILE: Final = "fieldkit.yaml"
_PACKAGE: Final = Path(__file__).resolve().parents[1]


def folders(kind: Kind) -> tuple[Path, ...]:
    """Return the folders searched for `kind`, first match wins.

    The lab's own folder is the one in the current directory. In a source checkout the shipped files stand beside
    the package; a wheel carries them inside it.
    """
    shipped = _PACKAGE / "data" / kind
    if not shipped.is_dir():
        shipped = _PACKAGE.parent / kind
    own = Path(kind)
    return (shipped,) if own.resolve() == shipped else (own, shipped)


def names(kind: Kind) -> dict[str, Path]:
    """Return every name of `kind` with its file, sorted by name.

    An empty file hides no other: a shell makes it before `fieldkit robots show NAME > robots/NAME.yaml` runs.
    """
    found: dict[str, Path] = {}
    for folder in folders(kind):
        for path in folder.glob("*.yaml"):
            if path.stem not in found or _is_empty(found[path.stem]):
                found[path.stem] = path
    return dict(sorted(found.items()))


def _is_empty(path: Path) -> bool:
    return path.is_file() and not path.stat().st_size


def own_copy(name: str) -> str:
    """Return the command that makes a lab's own copy of a robot profile, to be edited."""
    return f"mkdir -p robots; fieldkit robots show {name} > robots/{name}.yaml; then edit that copy"


def find(kind: Kind, name: str) -> Path:
    """Return the file of `name`.

    Raises:
        ConfigurationError: There is none; the message gives the nearest name.
    """
    known = names(kind)
    if name in known:
        return known[name]
    singular = kind.removesuffix("s")
    raise ConfigurationError(
        f"there is no {'robot profile' if kind == 'robots' else singular} {name!r}",
        remedy=nearest(name, known, f"known: {', '.join(known)}; see fieldkit {kind}"),
    )
