"""The JSON schema of scenario files, with which editors complete, explain and check keys.

An editor with a YAML language server finds it through a comment in the file's first line, see docs/cosim-api.md.
"""

from collections.abc import Iterator
from typing import Any

from fieldkit.config.documentation import attribute_meanings, class_description, without_links
from fieldkit.config.schema import Strict
from sim_backends.cosim.scenario.schema import CosimScenario


def editor_schema() -> dict[str, Any]:
    """Return the JSON schema (draft 2020-12) of a scenario file, with the meaning of each key."""
    whole = CosimScenario.model_json_schema()
    models = {model.__name__: model for model in _models(Strict)}
    for part in (whole, *whole["$defs"].values()):
        model = models.get(part["title"])
        if model is None:
            continue  # an enumeration
        part["description"] = without_links(class_description(model))
        meanings = attribute_meanings(model)
        for key, value in part["properties"].items():
            value.pop("title", None)
            value["description"] = without_links(meanings[key])
            if not isinstance(value.get("default"), str) and "string" in _types(value):
                value.pop("default", None)  # it is a number in SI units, but files have texts with units
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", **whole}


def _models(base: type[Strict]) -> Iterator[type[Strict]]:
    for model in base.__subclasses__():
        yield model
        yield from _models(model)


def _types(value: dict[str, Any]) -> set[str]:
    return {str(variant.get("type")) for variant in (value, *value.get("anyOf", ()))}
