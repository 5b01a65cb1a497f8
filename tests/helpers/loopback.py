"""SSH servers on loopback in separate namespaces, with an empty home folder; the namespaces end all processes."""

import subprocess
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from fieldkit.core.deadline import Deadline
from tests.helpers.sshd import UP_S, Server, free_port, is_ssh_server, make_key, wait_until

Command = Callable[[Path, int], Sequence[str]]
"""Returns the command line of a server, from its port and the file of its host key in OpenSSH format."""

_WITH_SEPARATE_HOME = """
mount -t tmpfs -o mode=700 tmpfs /root && mkdir -m 700 /root/.ssh &&
cp "$1" /root/.ssh/authorized_keys && mkdir -p /run/sshd && shift && exec "$@"
"""


def openssh(host_key: Path, port: int) -> Sequence[str]:
    options = (
        f"HostKey={host_key}",
        f"ListenAddress=127.0.0.1:{port}",
        "UsePAM=no",
        "PidFile=none",
    )
    return ("/usr/sbin/sshd", "-D", "-e", "-f", "/dev/null", *(f"-o{option}" for option in options))


def dropbear(host_key: Path, port: int) -> Sequence[str]:
    converted_key = host_key.with_name("dropbear")
    subprocess.run(
        ("dropbearconvert", "openssh", "dropbear", host_key, converted_key), capture_output=True, check=True
    )
    return ("/usr/sbin/dropbear", "-F", "-E", "-s", "-r", str(converted_key), "-p", f"127.0.0.1:{port}")


@contextmanager
def serve(folder: Path, command: Command) -> Iterator[Server]:
    """Yield a running server whose keys and log are in `folder`."""
    host_key = make_key(folder / "host")
    make_key(folder / "client")
    port = free_port()
    namespaces = ("unshare", "--mount", "--propagation", "private", "--pid", "--fork", "--kill-child", "--mount-proc")
    argv = (
        *namespaces,
        "sh",
        "-c",
        _WITH_SEPARATE_HOME,
        "sh",
        str(folder / "client.pub"),
        *command(folder / "host", port),
    )
    with (folder / "log").open("wb") as log, subprocess.Popen(argv, stderr=log) as process:
        try:
            wait_until(lambda: is_ssh_server(port), Deadline.after(UP_S))
            yield Server(port, host_key, (folder / "client").read_text(encoding="ascii"), folder, process.pid)
        finally:
            process.kill()  # unshare ignores SIGTERM
