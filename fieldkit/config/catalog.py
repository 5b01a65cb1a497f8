"""Robots and procedures by name: YAML files in the lab's folder first, then the files that ship with fieldkit."""

from typing import TypeVar

from fieldkit.config import schema
from fieldkit.config.locations import Kind, find
from fieldkit.config.schema import Strict
from fieldkit.core.errors import ConfigurationError


class Named(Strict):
    """Base of the models of catalog files.

    Attributes:
        name: The file's name without `.yaml`.
        summary: Description in one line.
    """

    name: str
    summary: str


Item = TypeVar("Item", bound=Named)


def load(kind: Kind, name: str, model: type[Item]) -> Item:
    """Return the file of `name` as a frozen `model`.

    Raises the same errors as `find`, `schema.read` and `validate_named`.
    """
    path = find(kind, name)
    return validate_named(schema.read(path), model, path.stem)


def validate_named(document: schema.Document, model: type[Item], name: str) -> Item:
    """Return a document as a frozen `model` with this name.

    Raises:
        ConfigurationError: For the same reasons as `schema.validate`, or because the `name` in the file is not its
            file name.
    """
    loaded = schema.validate(document, model)
    if loaded.name != name:
        raise ConfigurationError(
            f"name is {loaded.name!r}, but the file name is {name!r}",
            where=document.where(("name",)),
            remedy="change one of them, so that both are equal",
        )
    return loaded
