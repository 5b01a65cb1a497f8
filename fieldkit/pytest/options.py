"""Options of pytest: the lab that tests want."""

import re
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Final, TypeVar

import pytest

from fieldkit.core.errors import ConfigurationError, nearest

Word = TypeVar("Word", bound=StrEnum)

OUTPUT: Final = "fieldkit-results"


class Keep(StrEnum):
    """Whose evidence is kept."""

    FAILED = "failed"
    ALL = "all"
    NONE = "none"


@dataclass(frozen=True)
class LabOptions:
    """The lab that a file of tests wants.

    Attributes:
        backend: Name of the backend; None as the site file says, `emulated` without one.
        site: The site file; None for `fieldkit.yaml` in the current folder, if there is one.
        topology: Whose robots are brought up, `master` or `masterless`; None for the first of the site file, and for
            a trial that of its procedure.
        distance: How far apart robots stand at first that nobody carries, in line of sight.
        seed: Seed of everything random in the lab.
        yes: Whether nobody is asked to carry anything: real robots stand where they are wanted.
    """

    backend: str | None = None
    site: Path | None = None
    topology: str | None = None
    distance: str = "5m"
    seed: int = 1
    yes: bool = False


def of(config: pytest.Config) -> LabOptions:
    """Return the lab that pytest's command line and configuration ask for."""
    return LabOptions(
        backend=_text(config, "backend"),
        site=_path(config, "site"),
        topology=_text(config, "topology"),
        yes=config.getoption("fieldkit_yes"),
    )


def output(config: pytest.Config) -> Path:
    """Return the folder for evidence."""
    return _path(config, "output") or config.rootpath / OUTPUT


def keep(config: pytest.Config) -> Keep:
    """Return whose evidence is kept."""
    return Keep(_text(config, "keep") or Keep.FAILED)


_SAME: Final = re.compile(r"(?<![\w-])--(?=(?:backend|site|topology|yes)\b)")
_COMMAND: Final = re.compile(r"(\bfieldkit [a-z][^;,\n`]*)")


def as_pytest_option(remedy: str) -> str:
    """Return a remedy with the options as pytest takes them: `--fieldkit-topology`; commands of fieldkit stay."""
    parts = _COMMAND.split(remedy)
    return "".join(part if _COMMAND.fullmatch(part) else _SAME.sub("--fieldkit-", part) for part in parts)


def one_of(words: type[Word], text: str, what: str) -> Word:
    """Return the word of an enumeration that a text names.

    Raises:
        ConfigurationError: It names none.
    """
    try:
        return words(text)
    except ValueError as error:
        remedy = nearest(text, words, f"choose from {', '.join(words)}")
        raise ConfigurationError(f"{what}: there is no {text!r}", remedy=remedy) from error


def _text(config: pytest.Config, name: str) -> str | None:
    return config.getoption(f"fieldkit_{name}") or config.getini(f"fieldkit_{name}") or None


def _path(config: pytest.Config, name: str) -> Path | None:
    """Return a path: one of the command line from the current folder on, one of the configuration from its own."""
    given, written = config.getoption(f"fieldkit_{name}"), config.getini(f"fieldkit_{name}")
    if given:
        return Path(config.invocation_params.dir, given)
    return Path(config.rootpath, written) if written else None
