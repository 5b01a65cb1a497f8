"""Build the trial request, the backend and the operator from options that several commands share."""

import argparse
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final, TextIO

from fieldkit.backends.protocols import Backend, Relocating
from fieldkit.backends.registry import load_backend
from fieldkit.cli.sites import backend_name, lab_site
from fieldkit.config.locations import SITE_FILE
from fieldkit.core import permissions
from fieldkit.core.errors import ConfigurationError
from fieldkit.core.events import Note, Sink
from fieldkit.core.model import Distance, Protocol, Topology
from fieldkit.core.prompts import Operator, Unattended
from fieldkit.core.units import parse_duration_s
from fieldkit.trial.procedure import load_procedure
from fieldkit.trial.request import TrialRequest

_STANDARD_INPUT: Final = "-"


def request(arguments: argparse.Namespace, distance: Distance, *, seed: int = 1, notes: str = "") -> TrialRequest:
    """Return the trial request at one distance.

    Raises:
        ConfigurationError: There is no such procedure, or the duration of the recording is not valid.
    """
    record_s = None if arguments.record is None else parse_duration_s(arguments.record, "--record")
    if record_s == 0:
        raise ConfigurationError("a recording of 0 s records nothing", remedy="write for example --record 2s")
    return TrialRequest(
        procedure=load_procedure(arguments.procedure),
        distance=distance,
        topology=None if arguments.topology is None else Topology(arguments.topology),
        protocols=tuple(dict.fromkeys(Protocol(protocol) for protocol in arguments.protocol or ())),
        repeats=arguments.repeats,
        record_s=record_s,
        seed=seed,
        notes=notes,
    )


@contextmanager
def operator(arguments: argparse.Namespace, sink: Sink) -> Iterator[Operator]:
    """Yield the operator: the person at the terminal, a file or pipe with answers, or no person with `--yes`.

    Raises:
        ConfigurationError: The answers cannot be read.
    """
    if arguments.yes:
        yield Unattended()
        return
    from fieldkit.cli.operators import Script, Terminal  # noqa: PLC0415 (not needed with --yes)

    if arguments.answers is None:
        yield Terminal(sink)
    elif arguments.answers == _STANDARD_INPUT:
        yield Script(sys.stdin, "standard input", sink)
    else:
        with _open_answers(arguments.answers) as file:
            yield Script(file, arguments.answers, sink)


def _open_answers(path: str) -> TextIO:
    try:
        return Path(path).open(encoding="utf-8", errors="replace")
    except OSError as error:
        raise ConfigurationError(
            f"the answers cannot be read: {error.strerror}", where=path, remedy="correct --answers"
        ) from error


def run_elsewhere(selected_backend: Backend, arguments: argparse.Namespace, results: Path) -> int | None:
    """Run this command line in a virtual machine if the backend requires one.

    Returns:
        The exit code, or None if the command must run in this process.

    Args:
        selected_backend: The backend.
        arguments: The arguments of the command.
        results: Folder of the results.

    Raises:
        ConfigurationError: The command would write a file outside of the folder of the results.
    """
    if not isinstance(selected_backend, Relocating) or not selected_backend.must_relocate:
        return None
    junit: Path | None = getattr(arguments, "junit", None)
    if junit is not None and not junit.resolve().is_relative_to(results.resolve()):
        raise ConfigurationError(
            f"with this backend, the command can write only files below {results}",
            where="--junit",
            remedy=f"write for example --junit {results / junit.name}",
        )
    return selected_backend.run_elsewhere(arguments.words, results)


def backend(arguments: argparse.Namespace, sink: Sink) -> tuple[str, Backend]:
    """Return the name of the backend that the options and the site file select, and the backend.

    Raises:
        ConfigurationError: For the same reasons as `load_site` and `load_backend`.
    """
    site, document = lab_site(arguments)
    if site is None and arguments.backend is None:
        sink(Note(f"no site file {SITE_FILE} here: using emulated robots"))
    name = backend_name(arguments, site)
    selected_backend = load_backend(name, site, document)
    selected_backend.permissions = permissions.granted(arguments)
    return name, selected_backend
