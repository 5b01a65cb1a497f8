"""A virtual machine with Linux's Wi-Fi, made of the distribution's kernel and the files of this host.

It boots the kernel with mac80211_hwsim, mounts the root file system of the host read-only below a layer in memory,
runs one shell script as root, and switches off. It has no network. It uses the programs of the host: Python with
fieldkit, iw, hostapd.

Without KVM, the clock of the machine counts its instructions, and time passes at the rate of the host only while the
machine is idle. On a busy host a clock that runs at the rate of the host is too fast: the machine cannot process the
beacons of its radios before the next ones are due, and its queues overflow.
"""

import lzma
import os
import shlex
import shutil
import socket
import struct
import subprocess
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

from fieldkit.core.deadline import Deadline
from fieldkit.core.errors import ConfigurationError, TestbedLostError
from sim_backends.emulated.linux_wifi.initrd import build_initrd, find_modules
from sim_backends.emulated.process.worker import PATH
from sim_backends.emulated.robot.mesh_options import MeshOptions

PACKAGE_OF: Final = {
    "qemu-system-x86_64": "qemu-system-x86",
    "busybox": "busybox",
    "setpriv": "util-linux",
    "iw": "iw",
    "nft": "nftables",
    "hostapd": "hostapd",
    "wpa_supplicant": "wpasupplicant",
}
"""Debian package of each program that every machine needs."""

MESH_PACKAGE_OF: Final = {"babeld": "babeld", "batctl": "batctl"}
"""Debian package of each program that only a mesh needs."""
_BATMAN_MODULE: Final = "batman_adv"

ROOT_VARIABLE: Final = "FIELDKIT_WIFI_ROOT"
"""Environment variable with a folder in which packages were extracted instead of being installed."""

# Offsets of fields in the header of a boot image (Linux, Documentation/arch/x86/boot.rst).
_BOOT_SECTORS_OFFSET: Final = 0x1F1
_BOOT_MAGIC_OFFSET: Final = 0x202
_BOOT_PAYLOAD_OFFSET: Final = 0x248
_BOOT_HEADER_END: Final = 0x250

_JOB, _OUTPUT = "job.sh", "output"
INTERRUPT: Final = "/mnt/interrupt"
"""A file that appears in the machine when the caller is interrupted."""
CHANNEL: Final = "/dev/vport*p1"
"""Pattern of the device in the machine that is connected to a socket of the host."""
_RESULTS: Final = "results"
_POLL_S: Final = 0.2
_MAX_OUTPUT_BYTES: Final = 16 << 20
# An overloaded host misses the timer interrupts by which the kernel checks its IO-APIC, and the kernel would panic.
# Mitigations of processor faults, self-tests of ciphers, read-only pages and the routing of interrupts by ACPI need
# seconds of emulation, and protect nothing here.
_KERNEL_OPTIONS: Final = (
    "console=ttyS0 rdinit=/init panic=-1 quiet no_timer_check mitigations=off cryptomgr.notests rodata=off acpi=noirq"
)
_INSTRUCTION_CLOCK: Final = "fieldkit.clock=instructions"
"""Kernel option that marks a machine whose clock counts instructions."""
_EMULATED_PROCESSOR: Final = "Nehalem"
"""The oldest processor of QEMU with all instructions that numpy needs. Emulation of newer ones, for example with
AVX2, is slower."""
_NS_PER_INSTRUCTION_EXPONENT: Final = 1
"""An emulated instruction takes 2^1 ns: 500 million instructions per second, like a slow processor."""


@dataclass(frozen=True)
class Kernel:
    """A kernel of the distribution.

    Attributes:
        image: Its boot image.
        modules: Folder of its modules.
        extra_modules: Modules that a machine loads in addition to `initrd.MODULES`.
    """

    image: Path
    modules: Path
    extra_modules: tuple[str, ...] = ()


@dataclass(frozen=True)
class JobResult:
    """Result of a script in the machine.

    Attributes:
        code: Exit code.
        output: Standard output and standard error; at most the last 16 MiB.
    """

    code: int
    output: str


def kernel_roots() -> tuple[Path, ...]:
    """Return the folders with `boot/`, `lib/modules/` and programs: the folder in `ROOT_VARIABLE` if set, and `/`."""
    packages_folder = os.environ.get(ROOT_VARIABLE)
    return (Path(packages_folder).absolute(), Path("/")) if packages_folder else (Path("/"),)


def find_program(name: str, roots: Sequence[Path]) -> str | None:
    """Return the path of a program in the program folders below one of `roots`, or None."""
    folders = (str(root / folder.lstrip("/")) for root in roots for folder in PATH.split(":"))
    return shutil.which(name, path=":".join(folders))


def find_kernel(roots: Sequence[Path] = (Path("/"),)) -> Kernel | None:
    """Return the newest kernel with hwsim of the first folder that has one in `boot/` and `lib/modules/`, or None."""
    for root in roots:
        for image in sorted(root.glob("boot/vmlinuz-*"), key=_version, reverse=True):
            modules = root / "lib/modules" / image.name.removeprefix("vmlinuz-")
            if find_modules(modules, "mac80211_hwsim"):
                return Kernel(image, modules)
    return None


def uncompressed_kernel(image: bytes) -> bytes:
    """Return the ELF file in a boot image (Linux, Documentation/arch/x86/boot.rst), which QEMU boots by PVH.

    The machine would need seconds to decompress it. An image with a compression other than xz, or without a header,
    is returned unchanged.
    """
    if len(image) < _BOOT_HEADER_END or image[_BOOT_MAGIC_OFFSET:][:4] != b"HdrS":
        return image
    offset, size = struct.unpack_from("<II", image, _BOOT_PAYLOAD_OFFSET)
    start = (image[_BOOT_SECTORS_OFFSET] + 1) * 512 + offset
    payload = image[start : start + size]
    if not payload.startswith(b"\xfd7zXZ\0"):
        return image
    # The payload ends with its uncompressed size, which the decompressor does not expect.
    return lzma.LZMADecompressor(lzma.FORMAT_XZ).decompress(payload)


def require_machine(roots: Sequence[Path] | None = None, *, mesh: MeshOptions | None = None) -> Kernel:
    """Return the kernel of the machine.

    Args:
        roots: Folders with `boot/`, `lib/modules/` and programs; None for the folders of `kernel_roots`.
        mesh: The robots' mesh, which needs further programs or modules.

    Raises:
        ConfigurationError: The kernel or a program is missing; the message lists everything that is missing.
    """
    roots = kernel_roots() if roots is None else roots
    mesh_programs = () if mesh is None else (mesh.program,)
    package_of = PACKAGE_OF | {program: MESH_PACKAGE_OF[program] for program in mesh_programs}
    missing = {name: package for name, package in package_of.items() if find_program(name, roots) is None}
    kernel = find_kernel(roots)
    if kernel is None:
        missing["a kernel with mac80211_hwsim"] = "linux-image-amd64"
    if kernel is None or missing:
        packages = " ".join(sorted(missing.values()))
        raise ConfigurationError(
            f"Linux's Wi-Fi needs programs that are not installed: {', '.join(missing)}",
            remedy=f"on Debian, as root: apt-get install --no-install-recommends {packages}",
        )
    if mesh is not None and mesh.protocol == "batman-adv":
        return replace(kernel, extra_modules=(_BATMAN_MODULE,))
    return kernel


class Machine:
    """A machine that runs its script, or has switched off; `started_machine` creates it.

    Args:
        process: The process of QEMU.
        folder: Folder with the files of the machine.
    """

    def __init__(self, process: subprocess.Popen[bytes], folder: Path) -> None:
        self._process = process
        self._folder = folder
        self._reported_bytes = 0

    def wait(self, deadline: Deadline, on_output: Callable[[bytes], None] = lambda _data: None) -> JobResult:
        """Wait until the machine has switched off, and return the result of its script.

        The first KeyboardInterrupt creates the file `INTERRUPT` in the machine.

        Args:
            deadline: Time by which the machine must have switched off.
            on_output: Called several times per second with the new output of the script, which may be empty.

        Raises:
            TestbedLostError: The machine ended before its script, or did not switch off before the deadline.
            KeyboardInterrupt: A second KeyboardInterrupt arrived.
        """
        is_interrupted = False
        while not self._has_ended(min(_POLL_S, deadline.remaining_s), is_interrupted=is_interrupted):
            on_output(self.new_output())
            if deadline.expired:
                raise self.lost_error("did not switch off in time")
            is_interrupted = is_interrupted or (self._folder / "shared" / Path(INTERRUPT).name).exists()
        on_output(self.new_output())
        code = self._folder / "shared" / f"{_OUTPUT}.code"
        if not code.exists():
            raise self.lost_error("ended before its script")
        return JobResult(int(code.read_text(encoding="ascii")), _read_text(self._folder / "shared" / _OUTPUT))

    def check_alive(self) -> None:
        """Raise TestbedLostError if the machine has ended."""
        if self._process.poll() is not None:
            raise self.lost_error("ended")

    def new_output(self) -> bytes:
        """Return the output of the script since the last call."""
        output = self._folder / "shared" / _OUTPUT
        if not output.exists():
            return b""
        with output.open("rb") as file:
            file.seek(self._reported_bytes)
            data = file.read()
        self._reported_bytes += len(data)
        return data

    def lost_error(self, cause: str) -> TestbedLostError:
        """Return the error for a machine that cannot be used.

        It has the last line of the script's output; if there is none, that of the console, or of QEMU's errors.
        """
        texts = [_read_text(self._folder / name).strip() for name in (f"shared/{_OUTPUT}", "console", "errors")]
        last_line = next((text.rsplit("\n", 1)[-1] for text in texts if text), "")
        return TestbedLostError(
            f"{cause}; its last output: {last_line}" if last_line else cause,
            where="the virtual machine with Linux's Wi-Fi",
            remedy="use a host that is less busy, or that has KVM",
        )

    def _has_ended(self, timeout_s: float, *, is_interrupted: bool) -> bool:
        """Wait; return True if the machine has ended. The first Ctrl-C interrupts the script; a second is raised."""
        try:
            self._process.wait(timeout_s)
        except subprocess.TimeoutExpired:
            return False
        except KeyboardInterrupt:
            if is_interrupted:
                raise
            (self._folder / "shared" / Path(INTERRUPT).name).touch()
            return False
        return True


@contextmanager
def started_machine(
    kernel: Kernel,
    script: str,
    *,
    radios: int,
    memory_mib: int = 3072,
    results: Path | None = None,
    channel: socket.socket | None = None,
) -> Iterator[Machine]:
    """Yield a new machine that runs a shell script as root; leaving the context ends it.

    The machine also ends with the calling thread, even if this process is killed. Its changes to files of the host
    are lost, except those below `results`.

    Args:
        kernel: Kernel of the machine.
        script: The script.
        radios: Number of radios of hwsim.
        memory_mib: Memory of the machine in MiB.
        results: An existing folder of the host in which the machine writes files, or None.
        channel: A stream socket that becomes the device `CHANNEL` in the machine, or None.

    Raises:
        ConfigurationError: A file of the machine is missing.
    """
    with tempfile.TemporaryDirectory(prefix="fieldkit-wifi-") as name:
        folder = Path(name)
        shared = folder / "shared"
        shared.mkdir()
        if results is not None:
            script = _mount_command(results) + script
        (shared / _JOB).write_text(script, encoding="utf-8")
        (folder / "kernel").write_bytes(uncompressed_kernel(kernel.image.read_bytes()))
        (folder / "initrd").write_bytes(
            build_initrd(kernel.modules, kernel.extra_modules, radios=radios, job=_JOB, output=_OUTPUT)
        )
        descriptors = () if channel is None else (channel.fileno(),)
        with (folder / "errors").open("wb") as errors:
            process = subprocess.Popen(
                [*_command_line(folder, memory_mib, results), *_channel_options(descriptors)],
                cwd=folder,
                pass_fds=descriptors,
                stdin=subprocess.DEVNULL,
                stdout=errors,
                stderr=errors,
                start_new_session=True,
                env={"PATH": PATH},
            )
        try:
            yield Machine(process, folder)
        finally:
            process.kill()
            process.wait()


def run_in_machine(
    kernel: Kernel,
    script: str,
    deadline: Deadline,
    *,
    radios: int,
    memory_mib: int = 3072,
    results: Path | None = None,
    on_output: Callable[[bytes], None] = lambda _data: None,
) -> JobResult:
    """Run a shell script as root in a new machine, and return its result.

    Arguments and errors are those of `started_machine` and `Machine.wait`.
    """
    with started_machine(kernel, script, radios=radios, memory_mib=memory_mib, results=results) as machine:
        return machine.wait(deadline, on_output)


def _mount_command(results: Path) -> str:
    folder = shlex.quote(str(results))
    return f"mount -t 9p -o trans=virtio,version=9p2000.L,msize=524288 {_RESULTS} {folder} || exit\n"


def _command_line(folder: Path, memory_mib: int, results: Path | None) -> list[str]:
    """Return the command line of QEMU."""
    accelerators = _accelerators()
    options = _KERNEL_OPTIONS if "kvm" in accelerators else f"{_KERNEL_OPTIONS} {_INSTRUCTION_CLOCK}"
    argv = ["setpriv", "--pdeathsig", "KILL", "--", "qemu-system-x86_64", *accelerators]
    argv += ["-cpu", "max" if "kvm" in accelerators else _EMULATED_PROCESSOR]
    argv += ["-m", str(memory_mib), "-nodefaults", "-nic", "none", "-display", "none", "-no-reboot"]
    argv += ["-kernel", "kernel", "-initrd", "initrd", "-append", options]
    argv += ["-serial", "file:console", "-device", "virtio-rng-pci"]
    shares = [("host", "/", ",readonly=on"), ("lab", str(folder / "shared"), "")]
    shares += [] if results is None else [(_RESULTS, str(results), "")]
    for tag, path, access in shares:
        escaped_path = path.replace(",", ",,")  # a single comma separates options
        argv += ["-fsdev", f"local,id={tag},path={escaped_path},security_model=none,multidevs=remap{access}"]
        argv += ["-device", f"virtio-9p-pci,fsdev={tag},mount_tag={tag}"]
    return argv


def _channel_options(descriptors: Sequence[int]) -> Iterator[str]:
    for descriptor in descriptors:
        yield from ("-device", "virtio-serial-pci", "-chardev", f"socket,id=channel,fd={descriptor}")
        yield from ("-device", "virtserialport,chardev=channel")


def clock_counts_instructions() -> bool:
    """Return True if this process runs in a machine without KVM, whose clock does not measure real durations."""
    return _INSTRUCTION_CLOCK in Path("/proc/cmdline").read_text(encoding="ascii", errors="replace").split()


def _accelerators() -> Sequence[str]:
    """Return QEMU's options for KVM, or for emulation with a clock that counts instructions.

    /dev/kvm is not sufficient. Inside of a virtual machine it may be KVM without hardware support (PVM), which
    interprets unmodified kernels instruction by instruction, far slower than QEMU's emulation.
    """
    flags = Path("/proc/cpuinfo").read_text(encoding="ascii").split()
    if {"vmx", "svm"} & set(flags) and os.access("/dev/kvm", os.R_OK | os.W_OK):
        return ("-accel", "kvm")
    return ("-accel", "tcg,thread=single", "-icount", f"shift={_NS_PER_INSTRUCTION_EXPONENT},sleep=on")


def _version(image: Path) -> list[tuple[int, str]]:
    """Return a sort key by which 6.1.0-50 is newer than 6.1.0-9."""
    words = image.name.removeprefix("vmlinuz-").replace("-", ".").split(".")
    return [(int(word), "") if word.isdecimal() else (-1, word) for word in words]


def _read_text(path: Path) -> str:
    """Return a file as text, at most its last 16 MiB; empty if it does not exist."""
    if not path.exists():
        return ""
    with path.open("rb") as file:
        file.seek(max(0, path.stat().st_size - _MAX_OUTPUT_BYTES))
        return file.read().decode(errors="replace")
