"""Loads scenarios by name or by the path of a file, and creates the JSON schema of scenario files for editors."""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Final

from fieldkit.config import catalog, schema
from fieldkit.config.documentation import attribute_meanings, class_description, without_links
from fieldkit.config.schema import Document, Location, Strict
from fieldkit.core.errors import ConfigurationError, did_you_mean
from sim_backends.cosim.scenario.checks import check
from sim_backends.cosim.scenario.federate_choice import add_options, drop_options_of_replaced_federates
from sim_backends.cosim.scenario.schema import CosimScenario, NetworkOptions, PhysicsOptions
from sim_backends.world.world import load_world


def editor_schema() -> dict[str, Any]:
    """Return the JSON schema (draft 2020-12) of a scenario file, with the meaning of each key."""
    scenario_schema = CosimScenario.model_json_schema()
    add_options(scenario_schema["$defs"], {"physics": PhysicsOptions.__name__, "network": NetworkOptions.__name__})
    models = {model.__name__: model for model in _models(Strict)}
    for part in (scenario_schema, *scenario_schema["$defs"].values()):
        model = models.get(part.get("title", ""))
        if model is None:
            continue  # an enumeration, or any JSON value
        part["description"] = without_links(class_description(model))
        meanings = attribute_meanings(model)
        for key, value in part.get("properties", {}).items():
            value.pop("title", None)
            value["description"] = without_links(meanings[key])
            if not isinstance(value.get("default"), str) and "string" in _types(value):
                value.pop("default", None)  # the default is a number in SI units, but files have texts with units
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", **scenario_schema}


def _models(base: type[Strict]) -> Iterator[type[Strict]]:
    for model in base.__subclasses__():
        yield model
        yield from _models(model)


def _types(value: dict[str, Any]) -> set[str]:
    return {str(variant.get("type")) for variant in (value, *value.get("anyOf", ()))}


_SHIPPED: Final = Path(__file__).parent / "scenarios"


def scenario_files() -> dict[str, Path]:
    """Return the files of all scenarios by name: shipped files, and files in the folder `scenarios/` of the lab."""
    folders = (_SHIPPED, Path("scenarios"))
    files = {path.stem: path for folder in folders for path in folder.glob("*.yaml")}
    return dict(sorted(files.items()))


def load_scenario(name_or_path: str | Path, changes: Mapping[str, Any] | None = None) -> CosimScenario:
    """Return a scenario.

    Args:
        name_or_path: Its name, or the path of a file that ends in `.yaml`.
        changes: Values that replace values of the file, by their keys: `{"policy.window": "2ms",
            "agents.husky-2.along": "40m"}`; None for no changes.

    Raises:
        ConfigurationError: The scenario does not exist, or it is invalid; the message states the line in the file.
    """
    path = _path(str(name_or_path))
    document = schema.read(path)
    try:
        drop_options_of_replaced_federates(document.data, changes or {})
        for key, value in (changes or {}).items():
            _change(document, key.split("."), value)
        scenario = catalog.validate_named(document, CosimScenario, path.stem)
        with document.locating_errors("world"):
            world = load_world(scenario.world)
        check(scenario, world, document.where)
    except ConfigurationError as error:
        error.where = error.where or str(path)
        if changes:
            error.where += f" with {', '.join(f'{key}={value}' for key, value in changes.items())}"
            error.remedy = error.remedy.replace(
                "correct this line", "correct the option with this value, or the line"
            )
        raise
    return scenario


def parse_value(text: str, option: str) -> Any:  # noqa: ANN401 (any YAML value)
    """Return the value in an option, parsed as YAML, as in the file: a number, a list, or a text.

    Raises:
        ConfigurationError: The text is not a YAML value, or it continues with another key.
    """
    data = schema.parse(f"value: {text}", source=option).data
    if len(data) > 1:
        raise ConfigurationError(
            f"{text!r} is more than one value", where=option, remedy="give each key with a separate option"
        )
    return data["value"]


def _change(document: Document, keys: list[str], value: Any) -> None:  # noqa: ANN401 (any YAML value)
    """Set the value of a key; missing parent mappings are created, and get the line number of their parent.

    Raises:
        ConfigurationError: A parent key has a value without keys, or an index is beyond the end of a list.
    """
    location: Location = ()
    data = document.data
    try:
        for number, key in enumerate(keys, start=1):
            # Keys of mappings are texts, also if they consist of digits.
            part = int(key) if isinstance(data, list) else key
            location = (*location, part)
            if number == len(keys):
                data[part] = value
            else:
                data = data.setdefault(part, {}) if isinstance(data, dict) else data[part]
    except (IndexError, TypeError, ValueError):
        raise ConfigurationError(
            f"the key {'.'.join(keys)} cannot be changed, because it does not exist",
            remedy="use the keys of the scenario's file, and numbers from 0 for the items of a list",
        ) from None
    for depth in range(1, len(location) + 1):
        document.lines.setdefault(location[:depth], document.lines.get(location[: depth - 1], 1))


def _path(name_or_path: str) -> Path:
    if name_or_path.endswith(".yaml"):
        return Path(name_or_path)
    files = scenario_files()
    if name_or_path not in files:
        hint = did_you_mean(name_or_path, files, f"scenarios: {', '.join(files)}; or give a file that ends in .yaml")
        raise ConfigurationError(f"there is no scenario {name_or_path!r}", remedy=hint)
    return files[name_or_path]
