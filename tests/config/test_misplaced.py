"""A key that is valid at another level is reported as an indentation error, not as a misspelling."""

import copy
import re
from pathlib import Path

import pytest

from fieldkit.config import documents, schema
from fieldkit.config.profiles import RobotProfile
from fieldkit.config.site import Site
from fieldkit.core.errors import ConfigurationError
from fieldkit.trial.procedure import Procedure
from tests.helpers.paths import ROOT

SITE = """\
robots:
  a:
    profile: x
  b: {profile: x}
roles:
  master: {sender: a, receiver: b}
emulated:
  ros: builtin
"""
STEPS = """\
name: p
summary: x
scenario: los
topology: master
protocols: [udp]
repeats: 1
steps:
  - capture:
      during:
        - ping:
            from: sender
            to: receiver
  - run:
      robot: sender
      command: a
"""


def error_of(text: str, model: type[schema.Strict]) -> ConfigurationError:
    with pytest.raises(ConfigurationError) as error_info:
        schema.validate(schema.parse(text, source="f.yaml"), model)
    return error_info.value


@pytest.mark.parametrize(
    ("model", "old", "new", "line", "message"),
    [
        (
            Site,
            "  ros:",
            "ros:",
            8,
            "unknown key ros; valid keys: .*; if it is a key of emulated, indent it below emulated:",
        ),
        (Site, "  ros: builtin", "backnd: x", 8, "did you mean 'backend'. if it is a key of emulated"),
        (
            Site,
            "    profile: x",
            "    profile: x\n    patience: 3s",
            4,
            "patience here; it is a key of the whole file: indent it like robots:",
        ),
        (Site, "    profile: x", "  profile: x", 2, "indent the keys that belong to this line more than this line"),
        (
            Procedure,
            "to: receiver",
            "to: receiver\n            attempts: 3",
            13,
            "of the whole file: indent it like steps:",
        ),
        (
            Procedure,
            "to: receiver",
            "to: receiver\n            robots: []",
            13,
            "of capture: indent it like during:",
        ),
        (Procedure, "            to:", "          to:", 12, "unknown key to; it is a key of ping: write it inside"),
        (Procedure, "            to: receiver", "          robots: []", 12, "of capture: indent it like during:"),
        (
            Procedure,
            "command: a",
            "command: a\n      code: [1]",
            16,
            "it is a key of expect: indent it below expect:",
        ),
        (
            Procedure,
            "command: a",
            "command: a\n      expect:\n        limit: 3s",
            17,
            "of run: indent it like expect:",
        ),
        (Procedure, "command: a", "comand: a", 15, "did you mean 'command'"),
    ],
)
def test_message_gives_the_correct_indentation(
    model: type[schema.Strict], old: str, new: str, line: int, message: str
) -> None:
    text = SITE if model is Site else STEPS
    assert text.count(old) == 1
    error = error_of(text.replace(old, new), model)
    assert error.where == f"f.yaml:{line}"
    assert re.search(message, error.what), error.what


PROFILES = sorted((ROOT / "robots").glob("*.yaml"))


@pytest.mark.parametrize("path", PROFILES, ids=lambda path: path.stem)
def test_every_key_outside_its_section_is_reported_with_the_section(path: Path) -> None:
    document = documents.read(path).data
    fields = {field.alias or name: field.annotation for name, field in RobotProfile.model_fields.items()}
    sections = {**fields, **RobotProfile.section_types()}
    misplaced_keys = [
        (section, key)
        for section, section_data in document.items()
        if isinstance(section_data, dict) and hasattr(sections[section], "model_fields")
        for key in section_data
        if key not in sections
    ]
    assert misplaced_keys
    for section, key in misplaced_keys:
        data = copy.deepcopy(document)
        value = data[section].pop(key)
        index = list(data).index(section) + 1
        items = list(data.items())
        text = documents.to_text(dict([*items[:index], (key, value), *items[index:]]))
        assert (
            f"unknown key {key}; it is a key of {section}: indent it below {section}:"
            in error_of(text, RobotProfile).what
        )
