"""Programs in C++ that are compiled on first use, against libraries that the user has installed."""

import fcntl
import hashlib
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from fieldkit.core.errors import ConfigurationError

_LIMIT_S: Final = 900.0
"""Timeout of a compilation, and of the wait for another process that compiles the same program."""
_POLL_S: Final = 0.1
"""Interval of attempts to lock the file."""
_SHOWN_LINES: Final = 15
"""Largest number of lines of the compiler that an error contains."""
_HEADERS: Final = Path(__file__).parent / "cpp"
"""Include path of the headers for federates in C++: `#include "fieldkit/frames.h"`."""
_INCLUDE: Final = re.compile(r'^\s*#\s*include\s*"([^"]+)"', re.MULTILINE)


@dataclass(frozen=True)
class CompiledProgram:
    """A program in one C++ file, and the headers that it includes.

    Attributes:
        name: Its name in messages and file names.
        source: The file. Headers that only it includes are in the same folder; headers for all federates are in
            `sim_backends/federates/cpp`.
        packages: Names of its libraries for pkg-config.
        install: Command that installs the compiler and the libraries.
        flags: Other options of the compiler.
        libraries: Options that link the libraries; None for the options from pkg-config.
        duration_text: Usual time of a compilation, for the message: `about 30 s`.
    """

    name: str
    source: Path
    packages: Sequence[str]
    install: str
    flags: Sequence[str] = ("-O2", "-std=c++17")
    libraries: Sequence[str] | None = None
    duration_text: str = "about 30 s"

    def path(self) -> Path:
        """Return the path of the program, and compile it if necessary.

        It is compiled unless the cache contains a program for this source, these options, this compiler, and these
        versions of the libraries.

        Raises:
            ConfigurationError: The compiler or a library is not installed, or the compilation failed or took too
                long, here or in another process.
        """
        compiler, libraries = self._versions()
        digest = hashlib.sha256()
        for file in included_files(self.source):
            digest.update(file.read_bytes())
        digest.update("\0".join((*self.flags, *(self.libraries or ()), compiler, *libraries)).encode())
        folder = cache_folder()
        folder.mkdir(parents=True, exist_ok=True)
        program = folder / f"{self.name}-{digest.hexdigest()[:16]}"
        if program.exists():
            return program
        with _locked(folder / f"{program.name}.lock", self.name):
            if not program.exists():
                self._compile(program)
        return program

    def _versions(self) -> tuple[str, list[str]]:
        """Return the versions of the compiler and of the libraries.

        Raises:
            ConfigurationError: The compiler or a library is not installed.
        """
        for tool in ("g++", "pkg-config"):
            if shutil.which(tool) is None:
                raise ConfigurationError(f"{self.name} needs {tool}, which is not installed", remedy=self.install)
        libraries = []
        for package in self.packages:
            version = _run("pkg-config", "--modversion", package)
            if version.returncode:
                raise ConfigurationError(
                    f"{self.name} needs the library {package}, which is not installed", remedy=self.install
                )
            libraries.append(f"{package} {version.stdout.strip()}")
        return _run("g++", "--version").stdout.partition("\n")[0], libraries

    def _compile(self, program: Path) -> None:
        sys.stderr.write(
            f"note: compiling {self.name}; this takes {self.duration_text}, once per version of its libraries\n"
        )
        options = self.libraries
        if options is None:
            arguments = ("--cflags", "--libs", *self.packages)
            options = _run("pkg-config", *arguments).stdout.split() if self.packages else []
        with tempfile.TemporaryDirectory(dir=program.parent, prefix=f".{self.name}-") as folder:
            result = Path(folder) / "program"
            words = ["g++", *self.flags, f"-I{_HEADERS}", "-o", str(result), str(self.source), *options]
            try:
                compilation = _run(*words)
            except subprocess.TimeoutExpired as error:
                raise ConfigurationError(
                    f"{self.name} was not compiled within {_LIMIT_S:g} s",
                    remedy="run the command again when the machine is less busy",
                ) from error
            if compilation.returncode:
                lines = compilation.stderr.splitlines()[:_SHOWN_LINES]
                raise ConfigurationError(
                    "\n".join((f"{self.name} cannot be compiled:", *lines)),
                    where=str(self.source),
                    remedy="report this with the versions of the compiler and of the libraries",
                )
            result.replace(program)


def included_files(source: Path) -> list[Path]:
    """Return a C++ file and the headers of fieldkit that it includes, directly or through another header."""
    files = [source.resolve()]
    for file in files:  # the loop appends to the list
        for name in _INCLUDE.findall(file.read_text(encoding="utf-8")):
            candidates = ((folder / name).resolve() for folder in (file.parent, _HEADERS))
            header = next((candidate for candidate in candidates if candidate.is_file()), None)
            if header is not None and header not in files:
                files.append(header)
    return files


def cache_folder() -> Path:
    """Return the folder of compiled programs: `fieldkit/programs` in `XDG_CACHE_HOME`, by default `~/.cache`."""
    base = Path(os.environ.get("XDG_CACHE_HOME", ""))
    return (base if base.is_absolute() else Path.home() / ".cache") / "fieldkit" / "programs"


def _run(*words: str) -> "subprocess.CompletedProcess[str]":
    return subprocess.run(words, capture_output=True, text=True, timeout=_LIMIT_S, check=False)


@contextmanager
def _locked(path: Path, name: str) -> Iterator[None]:
    """Hold the lock of a file, so that only one of several processes compiles the program.

    Raises:
        ConfigurationError: Another process held the lock until the timeout.
    """
    deadline_s = time.monotonic() + _LIMIT_S
    with path.open("wb") as file:
        while True:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                break
            except BlockingIOError as error:
                if time.monotonic() > deadline_s:
                    raise ConfigurationError(
                        f"another process has been compiling {name} for {_LIMIT_S:g} s",
                        where=str(path),
                        remedy="wait until it has finished, or terminate it",
                    ) from error
                time.sleep(_POLL_S)
        yield
