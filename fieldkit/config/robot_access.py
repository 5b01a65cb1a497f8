"""Read the SSH settings of the robots of a site file, for `fieldkit stop`.

This module does not import pydantic, which takes 80 ms. Only the keys that the connection needs are checked. An error
elsewhere in the file, or in the entry of another robot, must not prevent a robot from being stopped.
"""

from dataclasses import dataclass
from typing import Any, Final

from fieldkit.config.documents import Document
from fieldkit.config.locations import default_backend
from fieldkit.core.errors import ConfigurationError

_PASSWORDS: Final = (None, "ask", "keyring")
_REMEDY: Final = "correct it; fieldkit check reports errors of the whole file"


@dataclass(frozen=True)
class RobotAccess:
    """SSH access to a robot; attributes are as in `fieldkit.config.site.SiteRobot`."""

    host: str
    user: str
    host_key: str
    port: int = 22
    key: str | None = None
    password: str | None = None


def read_access(document: Document) -> dict[str, RobotAccess | ConfigurationError]:
    """Return the access to each robot of a site file by its name, or the error of its entry.

    Raises:
        ConfigurationError: The document has no mapping `robots`.
    """
    data = document.data
    robots = data.get("robots") if isinstance(data, dict) else None
    if not isinstance(robots, dict):
        raise ConfigurationError(
            "the site file has no robots", where=document.where(("robots",)), remedy="add robots: to it"
        )
    return {name: _access(document, name, entry) for name, entry in robots.items()}


def configured_backend(document: Document) -> str:
    """Return the name of the backend in a site file, or the default."""
    name = document.data.get("backend", default_backend(document.data)) if isinstance(document.data, dict) else None
    return name if isinstance(name, str) else "field"


def _access(document: Document, name: str, entry: Any) -> RobotAccess | ConfigurationError:  # noqa: ANN401 (any YAML)
    """Return the access in the entry of a robot, or the error of its first wrong key."""
    if not isinstance(entry, dict):
        return ConfigurationError(
            "this entry is not a mapping", where=document.where(("robots", name)), remedy=_REMEDY
        )
    values: dict[str, Any] = {"port": 22, "key": None, "password": None} | entry
    for key, is_valid, what in (
        ("host", _is_text(values.get("host")), "a text"),
        ("user", _is_text(values.get("user")), "a text"),
        ("host_key", _is_text(values.get("host_key")), f"a text: fieldkit enroll {name}"),
        ("port", type(values["port"]) is int and 0 < values["port"] < 1 << 16, "a number from 1 to 65535"),
        ("key", values["key"] is None or _is_text(values["key"]), "the path of a file"),
        ("password", values["password"] in _PASSWORDS, "ask or keyring"),
    ):
        if not is_valid:
            where = document.where(("robots", name, key))
            return ConfigurationError(f"{key} of {name} must be {what}", where=where, remedy=_REMEDY)
    return RobotAccess(**{key: values[key] for key in ("host", "user", "host_key", "port", "key", "password")})


def _is_text(value: object) -> bool:
    return isinstance(value, str) and bool(value)
