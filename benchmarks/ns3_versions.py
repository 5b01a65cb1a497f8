"""Test the ns-3 network simulator of fieldkit with other versions of ns-3.

Usage: `python -m benchmarks.ns3_versions [trixie] [sid] [wheel]`. The name of a Debian release selects libns3-dev of
that release with all libraries that it needs, from the Debian mirror in apt's sources; `wheel` selects the headers
and libraries in the PyPI package `ns3`. They are extracted into a folder (about 1 GB per release), and nothing is
installed. This machine's g++ compiles fieldkit's C++ program for ns-3 against them, and the program runs with their
libraries. Then the conformance suite and the tests in `tests/sim_backends/ns3` run.
Each line of the output states the version of ns-3 according to pkg-config, and the results. The exit code is 1 if
something failed.
"""

import argparse
import os
import re
import subprocess
import sys
import zipfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Final

from sim_backends.federates.compiling import cache_folder

NAMES: Final = ("trixie", "sid", "wheel")
PACKAGES: Final = ("libns3-dev", "nlohmann-json3-dev", "libc6-dev")
TESTS: Final = "tests/sim_backends/ns3"
LIBRARIES: Final = "usr/lib/x86_64-linux-gnu"
_MIRROR: Final = re.compile(r"^(?:URIs:|deb(?: \[[^\]]*\])?) *(https?://\S+/debian)/?(?:\s|$)", re.MULTILINE)


def run(*words: str | Path) -> None:
    """Run a command; raise if it fails."""
    subprocess.run(words, check=True, stdout=subprocess.DEVNULL)


def mirror() -> str:
    """Return the URL of the Debian mirror in apt's sources.

    Raises:
        RuntimeError: They contain no Debian mirror.
    """
    folder = Path("/etc/apt")
    for file in (folder / "sources.list", *sorted(folder.glob("sources.list.d/*"))):
        if file.is_file() and (match := _MIRROR.search(file.read_text(encoding="utf-8"))):
            return match[1]
    raise RuntimeError("apt's sources contain no Debian mirror")


def extract_release(release: str, folder: Path) -> None:
    """Extract `PACKAGES` of a Debian release, and all packages that they need, into the subfolder `root`."""
    apt, root = folder / "apt", folder / "root"
    for name in ("etc/apt/sources.list.d", "etc/apt/preferences.d", "state/lists/partial", "cache/archives/partial"):
        (apt / name).mkdir(parents=True, exist_ok=True)
    (apt / "status").touch()
    source = f"deb [signed-by=/usr/share/keyrings/debian-archive-keyring.gpg] {mirror()} {release} main\n"
    (apt / "etc/apt/sources.list").write_text(source, encoding="utf-8")
    apt_directories = {
        "Dir::Etc": "etc/apt",
        "Dir::State": "state",
        "Dir::State::status": "status",
        "Dir::Cache": "cache",
    }
    options = [word for name, path in apt_directories.items() for word in ("-o", f"{name}={apt / path}")]
    # Without root privileges apt cannot acquire its locks, and the user `_apt` might not be able to read the folder.
    options += ["-o", "Debug::NoLocking=1", "-o", "APT::Sandbox::User=root", "-q"]
    run("apt-get", *options, "update")
    run("apt-get", *options, "install", "--download-only", "--no-install-recommends", "-y", *PACKAGES)
    for link in ("bin", "lib", "lib64", "sbin"):  # a merged /usr, which base-files creates in an installed system
        (root / "usr" / link).mkdir(parents=True, exist_ok=True)
        if not (root / link).is_symlink():
            (root / link).symlink_to(f"usr/{link}")
    for package in sorted((apt / "cache/archives").glob("*.deb")):
        archive = subprocess.run(("dpkg-deb", "--fsys-tarfile", package), check=True, stdout=subprocess.PIPE).stdout
        words = ("tar", "-x", "--keep-directory-symlink", "--no-same-owner", "--exclude=./dev/*", "-C", str(root))
        subprocess.run(words, check=True, input=archive)


def extract_wheel(folder: Path) -> None:
    """Extract the headers and libraries of the PyPI package `ns3`."""
    run(sys.executable, "-m", "pip", "download", "-q", "--no-deps", "--only-binary=:all:", "-d", folder, "ns3")
    (wheel,) = folder.glob("ns3-*.whl")
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(folder / "root")
    for library in (folder / "root/ns3/lib64").glob("libns3.*-*.so"):
        link = library.with_name(re.sub(r"^libns3\.\d+(-default)?-", "libns3-", library.name))
        link.unlink(missing_ok=True)
        link.symlink_to(library.name)


def environment(folder: Path, *, is_wheel: bool) -> dict[str, str]:
    """Write a `g++` that uses the extracted headers and libraries, and return the environment that finds it."""
    root = folder / "root"
    if is_wheel:
        libraries = root / "ns3/lib64"
        flags = f'-I{root}/ns3/include "$@" -L{libraries} -Wl,-rpath,{libraries} -Wl,--allow-shlib-undefined'
        pkg_config_path = f"{libraries}/pkgconfig:/usr/share/pkgconfig"
    else:
        libraries = root / LIBRARIES
        loader = root / "lib64/ld-linux-x86-64.so.2"
        paths = [libraries, *sorted({path.parent for path in libraries.glob("*/*.so*")})]
        flags = (
            # With --sysroot alone, g++ would search its own folders first, and link the ns-3 of this machine.
            f'--sysroot={root} -L{libraries} "$@" -Wl,--dynamic-linker={loader} -Wl,--allow-shlib-undefined'
            f" -Wl,--disable-new-dtags -Wl,-rpath,{':'.join(map(str, paths))}"
        )
        pkg_config_path = f"{libraries}/pkgconfig:{root}/usr/share/pkgconfig"
    wrapper = folder / "bin/g++"
    wrapper.parent.mkdir(exist_ok=True)
    wrapper.write_text(
        f'#!/bin/sh\ncase "$*" in --version) exec /usr/bin/g++ "$@";; esac\nexec /usr/bin/g++ {flags}\n'
    )
    wrapper.chmod(0o755)
    return {
        **os.environ,
        "PATH": f"{wrapper.parent}:{os.environ['PATH']}",
        "PKG_CONFIG_LIBDIR": pkg_config_path,
        "XDG_CACHE_HOME": str(folder / "cache"),
    }


def check(name: str, folder: Path) -> bool:
    """Extract a version if necessary, test it, and print the results; return True if all passed."""
    folder.mkdir(parents=True, exist_ok=True)
    if not (folder / "root/usr/include").is_dir() and not (folder / "root/ns3").is_dir():
        if name == "wheel":
            extract_wheel(folder)
        else:
            extract_release(name, folder)
    variables = environment(folder, is_wheel=name == "wheel")
    conformance = _last_line(folder, variables, "-m", "fieldkit", "cosim", "conform", "ns3")
    tests = _last_line(folder, variables, "-m", "pytest", "-q", "-n0", "-p", "no:cacheprovider", TESTS)
    version = _output(variables, "pkg-config", "--modversion", "ns3-core")
    print(f"{name}: ns-3 {version}: conformance {conformance[1]}; tests: {tests[1]}", flush=True)
    return conformance[0] and tests[0]


def _output(variables: Mapping[str, str], *words: str) -> str:
    return subprocess.run(words, env=dict(variables), capture_output=True, text=True, check=True).stdout.strip()


def _last_line(folder: Path, variables: Mapping[str, str], *words: str) -> tuple[bool, str]:
    """Run a Python module and save its output to a file.

    Returns:
        True if it succeeded, and the last line of its output.
    """
    completed = subprocess.run(
        (sys.executable, *words), env=dict(variables), capture_output=True, text=True, check=False
    )
    (folder / f"{words[1]}.txt").write_text(completed.stdout + completed.stderr, encoding="utf-8")
    return not completed.returncode, (completed.stdout.strip() or completed.stderr.strip()).rpartition("\n")[2]


def main(arguments: Sequence[str] | None = None) -> int:
    """Test the versions; return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", default=NAMES, metavar="NAME", help="trixie, sid, wheel; by default all")
    parser.add_argument(
        "--folder",
        type=Path,
        default=cache_folder().parent / "ns3-versions",
        help="folder of the extracted files and of the test logs (default: %(default)s)",
    )
    options = parser.parse_args(arguments)
    passed = [check(name, options.folder.resolve() / name) for name in options.names]
    return 0 if all(passed) else 1


if __name__ == "__main__":
    sys.exit(main())
