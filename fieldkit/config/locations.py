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
    """Return every name of `kind` with its file, sorted by name."""
    found: dict[str, Path] = {}
    for folder in folders(kind):
        for path in folder.glob("*.yaml"):
            found.setdefault(path.stem, path)
    return dict(sorted(found.items()))


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
