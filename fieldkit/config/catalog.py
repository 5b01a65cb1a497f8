"""Find named YAML files: the lab's own folder first, then those that ship with fieldkit."""

from pathlib import Path
from typing import Final, Literal, TypeVar

from fieldkit.config import schema
from fieldkit.config.schema import Strict
from fieldkit.core.errors import ConfigurationError, nearest

Kind = Literal["robots", "procedures"]


class Named(Strict):
    """Base of what a catalog file holds.

    Attributes:
        name: The file's name without `.yaml`.
        summary: One line for people.
    """

    name: str
    summary: str


Item = TypeVar("Item", bound=Named)

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


def load(kind: Kind, name: str, model: type[Item]) -> Item:
    """Return the file of `name` as a frozen `model`.

    Raises:
        ConfigurationError: As `find` and `schema.load`, or the file's `name` is another than the file has.
    """
    path = find(kind, name)
    loaded = schema.load(path, model)
    if loaded.name != path.stem:
        raise ConfigurationError(
            f"name is {loaded.name!r}, the file is called {path.stem!r}",
            where=f"{path}:1",
            remedy="make them equal",
        )
    return loaded


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
