"""The JSON schema of scenario files, by which editors complete keys, explain them and mark what is wrong.

An editor with a YAML language server takes it from a comment in the file's first line, see docs/cosim-api.md.
"""

import inspect
import re
from collections.abc import Iterator
from typing import Any, Final

from fieldkit.config.schema import Strict
from sim_backends.cosim.scenario.schema import CosimScenario

_ENTRY: Final = re.compile(r"^    (?P<key>\w+): (?P<said>.*(?:\n {8}.*)*)", re.MULTILINE)


def editor_schema() -> dict[str, Any]:
    """Return the JSON schema (draft 2020-12) of a scenario file, each key with what it means."""
    whole = CosimScenario.model_json_schema()
    models = {model.__name__: model for model in _models(Strict)}
    for part in (whole, *whole["$defs"].values()):
        model = models.get(part["title"])
        if model is None:
            continue  # an enumeration
        part["description"] = inspect.getdoc(model).partition("\n\nAttributes:")[0]  # type: ignore[union-attr]
        said = meanings(model)
        for key, value in part["properties"].items():
            value.pop("title", None)
            value["description"] = said[key]
            if not isinstance(value.get("default"), str) and "string" in _types(value):
                value.pop("default", None)  # in SI units, and the file has text
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", **whole}


def meanings(model: type[Strict]) -> dict[str, str]:
    """Return what each key of a model means, by its docstring and those of the classes that it has keys of."""
    found: dict[str, str] = {}
    for kind in reversed(model.__mro__):
        said = (inspect.getdoc(kind) or "").partition("Attributes:")[2]
        found |= {match["key"]: " ".join(match["said"].split()) for match in _ENTRY.finditer(said)}
    return found


def _models(base: type[Strict]) -> Iterator[type[Strict]]:
    for model in base.__subclasses__():
        yield model
        yield from _models(model)


def _types(value: dict[str, Any]) -> set[str]:
    return {str(one.get("type")) for one in (value, *value.get("anyOf", ()))}
