"""Queries of telemetry sources by the laptop during the steps of an attempt.

The laptop runs the same program as a robot: `poll` in telemetry.sh.
"""

import os
import shutil
import signal
import subprocess
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Final

from fieldkit.backends.protocols import Cast
from fieldkit.remote.script import SCRIPT
from fieldkit.telemetry import source_readings, telemetry_queries
from fieldkit.telemetry.telemetry_section import TelemetrySource

_EXIT_TIMEOUT_S: Final = 2.0
"""Time after SIGTERM within which a query must exit; then it is killed."""
_MARGIN_S: Final = 10.0
"""Time in addition to the limit of a query, in which the shell starts and exits."""
ONCE: Final = "0"
"""Interval with which `poll` runs a query once."""


@contextmanager
def querying(cast: Cast, folder: Path) -> Iterator[None]:
    """Query the sources of the laptop while the body runs.

    Args:
        cast: The robot in each role.
        folder: Folder for the outputs.
    """
    with ExitStack() as stack:
        processes = []
        for role, name, source in telemetry_queries.sources(cast, "laptop"):
            file = folder / source_readings.file(role, name, source)
            argv = _argv(source, stack.enter_context(credentials_file(source, os.environ)))
            with file.open("wb") as output:
                # The working directory is not the folder of the trial, which is on a disk that may be removed.
                process = subprocess.Popen(
                    argv,
                    stdin=subprocess.DEVNULL,
                    stdout=output,
                    stderr=subprocess.DEVNULL,
                    cwd=stack.enter_context(_temporary_folder()),
                    start_new_session=True,
                )
            processes.append(process)
        try:
            yield
        finally:
            for process in processes:
                process.terminate()
            for process in processes:
                _wait_or_kill(process)


def _argv(source: TelemetrySource, credentials: str | None, interval: str | None = None) -> tuple[str, ...]:
    """Return the command that runs `poll` on the laptop.

    Args:
        source: The source.
        credentials: File with the credentials; None for the file of the profile, if any.
        interval: Time between two queries in s, `ONCE` for a single query; None for the interval of the source.
    """
    address, tested_interface, source_interval, *remaining_words = source.poll_words("-", credentials)
    # The queries stop when this process has exited; no lock (-) is checked.
    words = (f"/proc/{os.getpid()}", "-", address, tested_interface, interval or source_interval, *remaining_words)
    return ("sh", "-c", SCRIPT.decode(), "job.sh", "poll", *words)


def query_once(source: TelemetrySource, environment: Mapping[str, str]) -> bytes:
    """Return the output of one query on this computer, in the format of `source_readings`; empty after a timeout."""
    with credentials_file(source, environment) as credentials, _temporary_folder() as folder:
        process = subprocess.Popen(
            _argv(source, credentials, ONCE),
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            cwd=folder,
            start_new_session=True,
        )
        try:
            output, _ = process.communicate(timeout=source.limit + _MARGIN_S)
        except subprocess.TimeoutExpired:
            output = b""
        finally:
            process.terminate()
            _wait_or_kill(process)
    return output


def _wait_or_kill(process: "subprocess.Popen[bytes]") -> None:
    """Wait until a terminated query has exited. After a timeout, kill it together with its running command."""
    with suppress(subprocess.TimeoutExpired):
        process.wait(_EXIT_TIMEOUT_S)
        return
    with suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL)
    process.wait()


@contextmanager
def credentials_file(source: TelemetrySource, environment: Mapping[str, str]) -> Iterator[str | None]:
    """Yield a temporary file with the credentials of an environment variable; None if the source uses no variable."""
    credentials = source.credentials
    if credentials is None or credentials.environment is None:
        yield None
        return
    with _temporary_folder() as folder:
        file = Path(folder, "snmp.conf")  # curl accepts any name
        file.touch(mode=0o600)
        file.write_text(f"{environment.get(credentials.environment, '')}\n", encoding="utf-8")
        yield str(file)


@contextmanager
def _temporary_folder() -> Iterator[str]:
    folder = tempfile.mkdtemp(prefix="fieldkit-telemetry-")
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)
