"""Write the settings of a step `topics` in the configuration format of its middleware.

Formats: CycloneDDS, docs/manual/config/config_file_reference.rst (`CYCLONEDDS_URI`); Fast DDS, "XML profiles"
(`FASTDDS_DEFAULT_PROFILES_FILE`); Zenoh, DEFAULT_CONFIG.json5 (`ZENOH_SESSION_CONFIG_URI` of rmw_zenoh).
"""

import json
import re
from collections.abc import Mapping, Sequence
from typing import Any, Final
from xml.etree import ElementTree as ET

from fieldkit.core.errors import ConfigurationError

FILES: Final[Mapping[str, str]] = {"dds": "cyclonedds.xml", "ros2": "fastdds.xml", "zenoh": "zenoh.json5"}
"""File name by middleware, which is a value of the key `over`."""
VARIABLES: Final[Mapping[str, str]] = {
    "dds": "CYCLONEDDS_URI",
    "ros2": "FASTDDS_DEFAULT_PROFILES_FILE",
    "zenoh": "ZENOH_SESSION_CONFIG_URI",
}
"""Environment variable with the path of the file, by middleware."""
_TRANSPORTS: Final = "FASTDDS_BUILTIN_TRANSPORTS"
_NAMESPACE: Final = "http://www.eprosima.com"


def configuration_text(middleware: str, transport: str, settings: Mapping[str, str], comment: Sequence[str]) -> str:
    """Return the text of a configuration file with the measured settings, and the evidence in a comment.

    Args:
        middleware: `dds`, `zenoh` or `ros2` for Fast DDS.
        transport: Transport of Zenoh.
        settings: The middleware's settings by their path.
        comment: Lines of the comment.

    Raises:
        ConfigurationError: The middleware has no such file, or the file cannot contain one of the settings.
    """
    if middleware == "dds":
        return _xml(_cyclonedds(settings), comment)
    if middleware == "ros2":
        return _xml(_fastdds(settings), comment)
    if middleware == "zenoh":
        lines = "".join(f"// {line}\n" for line in _printable(comment))
        return lines + json.dumps(_zenoh(transport, settings), indent=2) + "\n"
    raise ConfigurationError(
        f"{middleware} has no configuration file", remedy="apply the measured settings in your nodes"
    )


def _printable(comment: Sequence[str]) -> list[str]:
    """Return lines without control characters, so that names of trials cannot end the comment."""
    return ["".join(letter if letter.isprintable() else "?" for letter in line) for line in comment]


def _xml(root: ET.Element, comment: Sequence[str]) -> str:
    # `--` is not permitted in a comment (XML 1.0, section 2.5).
    text = "\n".join(f"  {re.sub('-(?=-)', '- ', line)}" for line in _printable(comment))
    ET.indent(root)
    return f'<?xml version="1.0" encoding="UTF-8"?>\n<!--\n{text}\n-->\n{ET.tostring(root, encoding="unicode")}\n'


def _cyclonedds(settings: Mapping[str, str]) -> ET.Element:
    """Return the XML of settings, whose paths have the form `Element/Element@attribute`."""
    root = ET.Element("CycloneDDS")
    domain = ET.SubElement(root, "Domain", Id="any")
    for path, value in settings.items():
        *names, last_name = path.split("/")
        element = domain
        for name in names:
            element = _child(element, name)
        element_name, _, attribute = last_name.partition("@")
        element = _child(element, element_name)
        if attribute:
            element.set(attribute, value)
        else:
            element.text = value
    return root


def _child(element: ET.Element, name: str) -> ET.Element:
    existing = element.find(name)
    return ET.SubElement(element, name) if existing is None else existing


def _fastdds(settings: Mapping[str, str]) -> ET.Element:
    unsupported = settings.keys() - {_TRANSPORTS, "RMW_IMPLEMENTATION"}
    rmw = settings.get("RMW_IMPLEMENTATION", "rmw_fastrtps_cpp")
    if unsupported or not rmw.startswith("rmw_fastrtps"):
        raise ConfigurationError(
            f"profiles of Fast DDS cannot contain {', '.join(sorted(unsupported)) or rmw}",
            remedy="set the same environment variables on your robots",
        )
    root = ET.Element("profiles", xmlns=_NAMESPACE)
    participant = ET.SubElement(root, "participant", profile_name="measured", is_default_profile="true")
    transports = ET.SubElement(ET.SubElement(participant, "rtps"), "builtinTransports")
    transports.text = settings.get(_TRANSPORTS, "DEFAULT")
    return root


def _zenoh(transport: str, settings: Mapping[str, str]) -> dict[str, Any]:
    """Return nested settings: the measured ones, and the transport of the listener."""
    tree: dict[str, Any] = {"mode": "peer", "listen": {"endpoints": [f"{transport}/0.0.0.0:0"]}}
    for path, text in settings.items():
        *names, last_name = path.split("/")
        node = tree
        for name in names:
            node = node.setdefault(name, {})
        try:
            node[last_name] = json.loads(text)
        except ValueError:
            node[last_name] = text
    return tree
