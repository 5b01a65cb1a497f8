"""What the options say: the lab that tests want."""

from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Final, TypeVar

import pytest

from fieldkit.core.errors import ConfigurationError, nearest
from fieldkit.core.model import Topology

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
    site = _path(config, "site")
    return LabOptions(
        backend=_text(config, "backend"),
        site=site,
        topology=_text(config, "topology"),
        yes=config.getoption("fieldkit_yes"),
    )


def output(config: pytest.Config) -> Path:
    """Return the folder for evidence."""
    return _path(config, "output") or config.rootpath / OUTPUT


def keep(config: pytest.Config) -> Keep:
    """Return whose evidence is kept.

    Raises:
        pytest.UsageError: There is no such word.
    """
    try:
        return one_of(Keep, _text(config, "keep") or Keep.FAILED, "--fieldkit-keep")
    except ConfigurationError as error:
        raise pytest.UsageError(str(error)) from error


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


def topology_of(text: str) -> Topology:
    """Return the topology that a text names; errors as `one_of`."""
    return one_of(Topology, text, "topology")


def _text(config: pytest.Config, name: str) -> str | None:
    return config.getoption(f"fieldkit_{name}") or config.getini(f"fieldkit_{name}") or None


def _path(config: pytest.Config, name: str) -> Path | None:
    """Return a path: from the command line below the current folder, from the configuration beside that."""
    if given := config.getoption(f"fieldkit_{name}"):
        return Path(config.invocation_params.dir, given)
    return next(iter(config.getini(f"fieldkit_{name}")), None)
