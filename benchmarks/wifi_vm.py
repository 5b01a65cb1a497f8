"""Three robots with Linux's real Wi-Fi stack in a virtual machine: `python -m benchmarks.wifi_vm FOLDER`, as root.

    apt-get install --no-install-recommends qemu-system-x86 mmdebstrap cpio kmod openssh-client

FOLDER becomes a lab with the machine's kernel and files, built from Debian packages if they are missing, a site file
and a key. The radios are those of mac80211_hwsim: cfg80211, mac80211, hostapd and wpa_supplicant are as on a robot,
and only the channel is simulated, without loss. The robots are two TurtleBots with ROS 1, and a drone that runs the
access point.

While it runs, `fieldkit check` and `fieldkit trial los 30ft` work in FOLDER as with robots in the field. As root,
`ssh -i key -p PORT root@127.0.0.1` logs in on a robot; there

    network cell|roaming|adhoc|nothing     changes the network of its radio
    link-cost SECONDS                      measures the cost of sampling its link

(benchmarks/wifi_vm/root/usr/local/sbin). It runs until Ctrl-C, or with `--then COMMAND...` until that command, run in
FOLDER, exits. KVM is used if the processor supports virtualisation (vmx or svm among its flags). Otherwise the
processor is emulated in software, which needs a mostly idle machine: with ten busy processes a login takes longer
than fieldkit's timeout of 8 s.
"""

import argparse
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Final

HERE: Final = Path(__file__).with_name("wifi_vm")
PACKAGES: Final = (
    "mount openssh-server iproute2 iw hostapd wpasupplicant tcpdump netcat-traditional iputils-ping iperf3 ethtool "
    "kmod libcap2-bin procps python3-rosmaster python3-rosbag python3-rospy python3-sensor-msgs"
)
MODULES: Final = "mac80211_hwsim virtio_pci virtio_net virtio_rng bridge ccm ctr cmac gcm"
ROBOTS: Final = ("duckiedrone-1", "turtlebot-1", "turtlebot-2")
BOOT_S: Final = 600.0


def build(lab: Path) -> None:
    """Make `vmlinuz`, `root.cpio` and the key of a lab from Debian packages and the folder next to this file."""
    root, kernel = lab / "root", lab / "kernel"
    for folder in (root, kernel):
        shutil.rmtree(folder, ignore_errors=True)
    (lab / "key").unlink(missing_ok=True)
    _run("ssh-keygen", "-q", "-t", "ed25519", "-N", "", "-C", "lab", "-f", str(lab / "key"))
    options = ("--dpkgopt=path-exclude=/usr/share/{doc,man,locale,info}/*", "--dpkgopt=force-unsafe-io")
    include = f"--include={','.join(PACKAGES.split())}"
    _run("mmdebstrap", "--variant=apt", *options, include, "bookworm", str(root))
    _run("chroot", str(root), "useradd", "--create-home", "--shell", "/bin/bash", "--password", "*", "ubuntu")
    shutil.copytree(HERE / "root", root, dirs_exist_ok=True)
    shutil.copy(lab / "key.pub", root / "etc/ssh/lab.pub")

    kernel.mkdir()
    depends = _output("apt-cache", "depends", "linux-image-amd64")
    package = next(word for word in depends.split()[1:] if word.startswith("linux-image-"))
    _run("apt-get", "download", package, cwd=kernel)
    (archive,) = kernel.glob("*.deb")
    _run("dpkg-deb", "-x", str(archive), str(kernel))
    version = package.removeprefix("linux-image-")
    _run("depmod", "-b", str(kernel), version)
    needed = _output("modprobe", "-d", str(kernel), "-S", version, "-a", "--show-depends", *MODULES.split())
    modules = {Path(line.split()[1]) for line in needed.splitlines() if line.startswith("insmod ")}
    for path in (*modules, *kernel.glob("lib/modules/*/modules.*")):
        to = root / path.relative_to(kernel)
        to.parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(path, to)
    _run("depmod", "-b", str(root), version)
    with (lab / "root.cpio").open("wb") as out:
        names = subprocess.run(("find", ".", "-print0"), cwd=root, check=True, capture_output=True).stdout
        subprocess.run(("cpio", "-0", "-o", "-H", "newc", "--quiet"), cwd=root, check=True, input=names, stdout=out)
    (kernel / "boot" / f"vmlinuz-{version}").rename(lab / "vmlinuz")
    for folder in (root, kernel):
        shutil.rmtree(folder)


def _run(*argv: str, cwd: Path | None = None) -> None:
    subprocess.run(argv, check=True, cwd=cwd)


def _output(*argv: str) -> str:
    return subprocess.run(argv, check=True, capture_output=True, text=True).stdout


@contextmanager
def running(lab: Path) -> Iterator[Sequence[int]]:
    """Start the machine, and stop it afterwards; yield the robots' SSH ports here, in the order of `ROBOTS`."""
    ports = _free_ports(len(ROBOTS))
    argv = ["qemu-system-x86_64", *_accelerators(), "-cpu", "max", "-smp", "2", "-m", "3G"]
    argv += ["-kernel", "vmlinuz", "-initrd", "root.cpio", "-append", "console=ttyS0 rdinit=/init quiet"]
    argv += ["-display", "none", "-no-reboot", "-serial", "file:console.txt", "-device", "virtio-rng-pci"]
    for number, port in enumerate(ports):
        argv += ["-netdev", f"user,id=c{number},restrict=on,hostfwd=tcp:127.0.0.1:{port}-:22"]
        argv += ["-device", f"virtio-net-pci,netdev=c{number},mac=52:54:00:00:00:0{number},romfile="]
    machine = subprocess.Popen(argv, cwd=lab, stdin=subprocess.DEVNULL)
    try:
        until_s = time.monotonic() + BOOT_S
        while not all(_is_ssh_server(port) for port in ports):
            if machine.poll() is not None or time.monotonic() > until_s:
                sys.exit(f"the machine did not come up: see {lab / 'console.txt'}")
            time.sleep(1)
        yield ports
    finally:
        machine.terminate()
        machine.wait()


def _accelerators() -> Sequence[str]:
    """Return QEMU's options for the accelerator; QEMU uses the first one that works.

    /dev/kvm is not sufficient. Inside of a virtual machine it may be KVM without hardware support (PVM), which
    interprets unmodified kernels instruction by instruction, far slower than QEMU's emulation.
    """
    flags = Path("/proc/cpuinfo").read_text(encoding="ascii").split()
    kvm = ("-accel", "kvm") if {"vmx", "svm"} & set(flags) else ()
    return (*kvm, "-accel", "tcg,thread=multi")


def _free_ports(count: int) -> Sequence[int]:
    with ExitStack() as stack:
        sockets = [stack.enter_context(socket.socket()) for _ in range(count)]
        for opened in sockets:
            opened.bind(("127.0.0.1", 0))
        return [opened.getsockname()[1] for opened in sockets]


def _is_ssh_server(port: int) -> bool:
    """Return True if an SSH server answers on a port; QEMU accepts connections before the server is up."""
    try:
        with socket.create_connection(("127.0.0.1", port), timeout=30) as connection:
            return connection.recv(4) == b"SSH-"
    except OSError:
        return False


def write_site(lab: Path, ports: Sequence[int]) -> None:
    """Write the site file of the robots behind these ports, their host keys pinned."""
    site = lab / "fieldkit.yaml"
    text = (HERE / "fieldkit.yaml").read_text(encoding="utf-8")
    for number, port in enumerate(ports):
        text = text.replace(f"PORT_{number}", str(port))
    site.write_text(text, encoding="utf-8")
    for robot in ROBOTS:
        _run(sys.executable, "-m", "fieldkit", "enroll", robot, "--yes", cwd=lab)


def main() -> int:
    """Build missing files, start the machine, run a command or wait."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("lab", type=Path, metavar="FOLDER", help="needs 1 GB of disk space")
    parser.add_argument("--then", nargs=argparse.REMAINDER, help="run this in FOLDER, then exit")
    options = parser.parse_args()
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))  # so that the machine is stopped, too
    lab: Path = options.lab.resolve()
    lab.mkdir(parents=True, exist_ok=True)
    if not (lab / "vmlinuz").exists():
        build(lab)
    with running(lab) as ports:
        write_site(lab, ports)
        print(f"the robots are up: cd {lab} && fieldkit check   # Ctrl-C here stops them", flush=True)
        try:
            if options.then:
                return subprocess.run(options.then, cwd=lab, check=False).returncode
            while True:
                time.sleep(3600)
        except KeyboardInterrupt:
            return 130
    return 0


if __name__ == "__main__":
    sys.exit(main())
