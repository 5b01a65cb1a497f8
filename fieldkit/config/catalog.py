"""Robots and procedures by name: YAML files of the lab's own folder first, then those that ship with fieldkit."""

from typing import TypeVar

from fieldkit.config import schema
from fieldkit.config.locations import Kind, find
from fieldkit.config.schema import Strict
from fieldkit.core.errors import ConfigurationError


class Named(Strict):
    """Base of what a catalog file holds.

    Attributes:
        name: The file's name without `.yaml`.
        summary: One line for people.
    """

    name: str
    summary: str


Item = TypeVar("Item", bound=Named)


def load(kind: Kind, name: str, model: type[Item]) -> Item:
    """Return the file of `name` as a frozen `model`.

    Raises:
        ConfigurationError: As `find` and `schema.load`, or the file's `name` is another than the file has.
    """
    path = find(kind, name)
    document = schema.read(path)
    loaded = schema.validate(document, model)
    if loaded.name != path.stem:
        raise ConfigurationError(
            f"name is {loaded.name!r}, the file is called {path.stem!r}",
            where=document.where(("name",)),
            remedy="make them equal",
        )
    return loaded
