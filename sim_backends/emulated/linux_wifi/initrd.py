"""The initial file system of the virtual machine: busybox, kernel modules and a start script, in a cpio archive.

Everything else is the root file system of the host, which the machine mounts read-only over 9p, below a layer in
memory that contains all changes. The archive has the format `newc` (Linux,
Documentation/driver-api/early-userspace/buffer-format.rst). This module writes the archive itself, because the
program `cpio` would have to be installed, and would need a copy of each file.
"""

import gzip
import lzma
import re
import stat
import subprocess
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Final

from fieldkit.core.errors import ConfigurationError

MODULES: Final = (
    *(
        "virtio_pci",
        "9pnet_virtio",
        "9p",
        "overlay",
        "virtio_rng",
        "virtio_console",
        "mac80211_hwsim",
        "crc32c_generic",
        "nf_tables",
        "bridge",
    ),
    *("ccm", "ctr", "cmac", "gcm"),
)
"""Modules that the machine loads, after their dependencies.

libcrc32c, on which nf_tables depends, needs crc32c_generic; ccm, cmac and gcm are the ciphers of WPA2 and WPA3, and
ccm and gcm need ctr.
"""

_DECOMPRESSORS: Final[Mapping[str, Callable[[bytes], bytes]]] = {
    ".ko": bytes,
    ".ko.xz": lzma.decompress,
    ".ko.gz": gzip.decompress,
}
"""Functions that decompress a module, by the end of its file name. Debian 13 uses xz, 12 nothing."""

_DEPENDS: Final = re.compile(rb"\0depends=([^\0]*)\0")

_SIGNED: Final = b"~Module signature appended~\n"
_SIGNATURE_HEADER_BYTES: Final = 12
"""Length of the header after the signature; its last four bytes are the size of the signature."""

_START: Final = """\
#!/bin/busybox sh
export PATH=/bin
for name in mount insmod chroot poweroff mkdir cat; do /bin/busybox ln -s busybox /bin/$name; done
mount -t proc proc /proc
mount -t sysfs sys /sys
mount -t devtmpfs dev /dev
for name in $(cat /modules); do
    options=
    [ $name != mac80211_hwsim ] || options=radios={radios}
    insmod /lib/$name.ko $options || poweroff -f
done
mkdir /memory
mount -t 9p -o ro,trans=virtio,version=9p2000.L,msize=524288,cache=loose host /host || poweroff -f
mount -t tmpfs memory /memory
mkdir /memory/upper /memory/work
mount -t overlay -o lowerdir=/host,upperdir=/memory/upper,workdir=/memory/work root /changed || poweroff -f
mount -t 9p -o trans=virtio,version=9p2000.L,msize=524288 lab /changed/mnt || poweroff -f
mount -t tmpfs run /changed/run
for place in proc sys dev; do mount -o move /$place /changed/$place; done
mkdir -p /changed/dev/pts /changed/dev/shm /changed/run/netns
mount -t devpts devpts /changed/dev/pts
mount -t tmpfs shm /changed/dev/shm
chroot /changed /bin/sh /mnt/{job} </changed/dev/null >/changed/mnt/{output} 2>&1
echo $? >/changed/mnt/{output}.code
poweroff -f
"""


def build_initrd(modules: Path, extra_modules: Iterable[str] = (), *, radios: int, job: str, output: str) -> bytes:
    """Return the archive.

    Args:
        modules: Folder of the kernel's modules, `/lib/modules/VERSION`.
        extra_modules: Names of modules that the machine loads in addition to `MODULES`.
        radios: Number of radios of hwsim.
        job: Name of a shell script in the folder that the machine shares; it runs on the host's files, and the
            machine switches off at its end.
        output: Name of the file in that folder with its output. A second one, with `.code` added to its name, has the
            exit code; it is written last.

    Raises:
        ConfigurationError: A program, library or module is missing.
    """
    ordered = module_order(modules, (*MODULES, *extra_modules))
    files = {"init": (0o755, _START.format(radios=radios, job=job, output=output).encode())}
    files["modules"] = 0o644, "\n".join(ordered).encode()
    files |= {f"lib/{name}.ko": (0o644, without_signature(module)) for name, module in ordered.items()}
    busybox = _program("busybox")
    files["bin/busybox"] = 0o755, busybox.read_bytes()
    files |= {str(path).lstrip("/"): (0o755, path.read_bytes()) for path in shared_libraries(busybox)}
    return cpio_archive(files, ("bin", "lib", "proc", "sys", "dev", "host", "changed"))


def find_modules(folder: Path, pattern: str = "*") -> dict[str, Path]:
    """Return the files of modules in a folder and its subfolders, by name with `_` for `-`; names match a pattern."""
    return {_module_name(path): path for suffix in _DECOMPRESSORS for path in folder.rglob(f"{pattern}{suffix}")}


def _module_name(path: Path) -> str:
    """Return the name of a module: that of its file, without suffixes and with `_` for `-`."""
    return path.name.partition(".")[0].replace("-", "_")


def module_order(folder: Path, names: Iterable[str]) -> dict[str, bytes]:
    """Return the decompressed modules and their dependencies, by name; a module follows its dependencies.

    Modules that are built into the kernel (`modules.builtin`) are omitted.

    Raises:
        ConfigurationError: A module is missing.
    """
    paths = find_modules(folder)
    builtin_list = folder / "modules.builtin"
    builtin = set()
    if builtin_list.exists():
        builtin = {_module_name(Path(line)) for line in builtin_list.read_text(encoding="ascii").split()}
    ordered: dict[str, bytes] = {}

    def add(name: str) -> None:
        """Add a module after its dependencies."""
        if name in ordered or name in builtin:
            return
        if name not in paths:
            raise ConfigurationError(
                f"the kernel module {name} is missing in {folder}",
                remedy="install the distribution's standard kernel, on Debian: apt-get install linux-image-amd64",
            )
        path = paths[name]
        module = _DECOMPRESSORS["." + path.name.partition(".")[2]](path.read_bytes())
        depends = _DEPENDS.search(module)
        for dependency in depends[1].decode().split(",") if depends else []:
            if dependency:
                add(dependency.replace("-", "_"))
        ordered[name] = module

    for name in names:
        add(name.replace("-", "_"))
    return ordered


def without_signature(module: bytes) -> bytes:
    """Return a module without the signature at its end (Linux, scripts/sign-file.c): checking it takes seconds."""
    if not module.endswith(_SIGNED):
        return module
    end = len(module) - len(_SIGNED)
    size = int.from_bytes(module[end - 4 : end], "big")
    return module[: max(0, end - _SIGNATURE_HEADER_BYTES - size)]


def shared_libraries(program: Path) -> list[Path]:
    """Return the libraries of a program, including the dynamic linker, as `ldd` lists them; empty if it has none."""
    result = subprocess.run(("/usr/bin/ldd", program), capture_output=True, text=True, check=False, timeout=60)
    return [Path(match) for match in re.findall(r"(/\S+) \(0x", result.stdout)]


def cpio_archive(files: Mapping[str, tuple[int, bytes]], folders: Iterable[str]) -> bytes:
    """Return a cpio archive in the format `newc`.

    Args:
        files: Permissions and content of each file, by path without a slash at the start.
        folders: Additional folders; the folders of files are included.
    """
    # The parents of PATH/x include PATH, so this set contains the folders in `folders`, and the files, which the next
    # line removes.
    parents = {str(parent) for path in (*files, *folders) for parent in (Path(path) / "x").parents}
    parents -= {".", *files}
    entries = [(path, stat.S_IFDIR | 0o755, b"") for path in sorted(parents)]
    entries += [(path, stat.S_IFREG | mode, content) for path, (mode, content) in sorted(files.items())]
    entries.append(("TRAILER!!!", 0, b""))
    archive = bytearray()
    for number, (path, mode, content) in enumerate(entries, start=1):
        name = path.encode() + b"\0"
        # Inode, mode, uid, gid, links, time, size, four device numbers, length of the name, checksum.
        fields = (number, mode, 0, 0, 1, 0, len(content), 0, 0, 0, 0, len(name), 0)
        archive += b"070701" + b"".join(b"%08X" % value for value in fields) + name
        archive += bytes(-len(archive) % 4)
        archive += content
        archive += bytes(-len(archive) % 4)
    return bytes(archive)


def _program(name: str) -> Path:
    for folder in ("/bin", "/usr/bin", "/sbin", "/usr/sbin"):
        if (path := Path(folder, name)).exists():
            return path.resolve()
    raise ConfigurationError(f"{name} is missing", remedy=f"on Debian: apt-get install {name}")
