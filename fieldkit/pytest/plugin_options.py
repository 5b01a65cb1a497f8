"""Options of the pytest plugin: the lab that tests need."""

import re
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Final, TypeVar

import pytest

from fieldkit.core.errors import ConfigurationError, did_you_mean

Word = TypeVar("Word", bound=StrEnum)

OUTPUT: Final = "fieldkit-results"


class Keep(StrEnum):
    """Which evidence is kept."""

    FAILED = "failed"
    ALL = "all"
    NONE = "none"


@dataclass(frozen=True)
class LabOptions:
    """The lab that a test module needs.

    Attributes:
        backend: Name of the backend; None for the backend of the site file, or `emulated` without a site file.
        site: The site file; None for `fieldkit.yaml` in the current folder, if there is one.
        topology: `master` or `masterless`; None for the first topology of the site file, or `master` without one, and
            in a trial for the topology of its procedure.
        distance: Initial distance of emulated robots, in line of sight.
        seed: Seed of all random numbers in the lab.
        yes: Whether no person is asked: real robots are already at the required places.
    """

    backend: str | None = None
    site: Path | None = None
    topology: str | None = None
    distance: str = "5m"
    seed: int = 1
    yes: bool = False


def read_lab_options(config: pytest.Config) -> LabOptions:
    """Return the options of the lab in pytest's command line and configuration."""
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
    """Return the option that selects the evidence to keep."""
    return Keep(_text(config, "keep") or Keep.FAILED)


_SHARED_OPTION: Final = re.compile(r"(?<![\w-])--(?=(?:backend|site|topology|yes)\b)")
_COMMAND: Final = re.compile(r"(\bfieldkit [a-z][^;,\n`]*)")


def as_pytest_option(remedy: str) -> str:
    """Return a remedy with the options of the plugin, such as `--fieldkit-topology`; commands are unchanged."""
    parts = _COMMAND.split(remedy)
    return "".join(part if _COMMAND.fullmatch(part) else _SHARED_OPTION.sub("--fieldkit-", part) for part in parts)


def one_of(words: type[Word], text: str, what: str) -> Word:
    """Return the member of an enumeration with this text.

    Raises:
        ConfigurationError: There is no such member.
    """
    try:
        return words(text)
    except ValueError as error:
        remedy = did_you_mean(text, words, f"choose from {', '.join(words)}")
        raise ConfigurationError(f"{what}: there is no {text!r}", remedy=remedy) from error


def _text(config: pytest.Config, name: str) -> str | None:
    return config.getoption(f"fieldkit_{name}") or config.getini(f"fieldkit_{name}") or None


def _path(config: pytest.Config, name: str) -> Path | None:
    """Return the path in an option, or None if the option is not set.

    On the command line it is relative to the current folder, in the configuration to pytest's root folder.
    """
    option, configured = config.getoption(f"fieldkit_{name}"), config.getini(f"fieldkit_{name}")
    if option:
        return Path(config.invocation_params.dir, option)
    return Path(config.rootpath, configured) if configured else None
