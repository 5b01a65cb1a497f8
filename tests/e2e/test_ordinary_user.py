"""Emulated robots of an ordinary user: a complete trial, and the errors if a permission is missing."""

import csv
import signal
import subprocess
import sys
from typing import Final

import pytest

from tests.e2e.test_bad_inputs import Row, check, table
from tests.helpers import ordinary_user
from tests.helpers.host import NamespaceComparison, descendants, owners, wait_for_end
from tests.helpers.runs import Run, finish, wait_for_line

pytestmark = pytest.mark.emulated

FIELDKIT: Final = (sys.executable, "-m", "fieldkit")
TRIAL: Final = ("trial", "los", "30ft", "--repeats", "1", "--record", "1s")
BEFORE_THE_TABLE: Final = "--- trial.csv"

COMPLETE_TRIAL = f"""
[ "$(id -u)" = {ordinary_user.UID} ]
"$@" {" ".join(TRIAL)} && "$@" verify trials/*
[ -z "$(find /tmp /var/tmp /dev/shm /run -user {ordinary_user.NAME})" ]
echo '{BEFORE_THE_TABLE}'; cat trials/*/trial.csv
"""

LAB = f"""
[ "$(id -u)" = {ordinary_user.UID} ]
cat > fieldkit.yaml <<'EOF'
robots:
  robot-1: {{profile: turtlebot3_burger}}
  robot-2: {{profile: turtlebot3_burger}}
roles:
  masterless: {{sender: robot-1, receiver: robot-2}}
emulated:
  ros: builtin
  mesh: {{protocol: babel, hello: 0.5s}}
EOF
"$@" lab up
"$@" lab ps
[ "$("$@" lab shell robot-1 hostname)" = robot-1 ]
"$@" lab ssh-config > lab.ssh
[ "$(ssh -F lab.ssh robot-2 uname -n)" = robot-2 ]
head -c 300000 /dev/urandom > there
scp -q -F lab.ssh there robot-1:
rsync -e 'ssh -F lab.ssh' robot-1:there back
cmp there back
"$@" lab shell robot-1 'until ip route show proto babel | grep -q wlan0; do sleep 0.1; done'
"$@" lab move robot-2 --by 5m 0m
"$@" lab shell robot-1 ping -c 1 -w 30 -i 0.2 robot-2
"$@" lab down
[ -z "$(find /tmp /var/tmp /dev/shm /run -user {ordinary_user.NAME})" ]
"""

# The command runs in a user namespace in which no further user namespace can be created.
FORBID_NAMESPACES = 'echo 0 > /proc/sys/user/max_user_namespaces; exec "$@"'
WITHOUT_USER_NAMESPACES = (
    "unshare",
    "--user",
    "--map-current-user",
    "--keep-caps",
    "--",
    "sh",
    "-c",
    FORBID_NAMESPACES,
    "sh",
)

MISSING_PERMISSIONS: dict[str, str] = {
    "no uidmap": "mount --bind /dev/null /usr/bin/newuidmap",
    "no subordinate ids": ": > /etc/subuid; : > /etc/subgid",
    "too few subordinate groups": f"echo {ordinary_user.NAME}:300000:1000 > /etc/subgid",
    "a user without an account": "umount /etc/passwd",
    "a kernel that forbids user namespaces": "",
    "a newuidmap without its right": (
        "cp /usr/bin/newuidmap /run/ && chmod 755 /run/newuidmap && mount --bind /run/newuidmap /usr/bin/newuidmap"
    ),
    "a TUN device that is closed to this user": (
        "mount -t tmpfs tmpfs /mnt && mknod -m 600 /mnt/tun c 10 200 && mount --bind /mnt/tun /dev/net/tun"
    ),
    "a kernel without TUN": (
        "mount -t tmpfs tmpfs /mnt && mknod -m 666 /mnt/tun c 10 255 && mount --bind /mnt/tun /dev/net/tun"
    ),
    "a machine without a hosts file": (
        "mount -t tmpfs tmpfs /mnt && cp -a /etc /mnt/ && rm -f /mnt/etc/hosts && mount --bind /mnt/etc /etc"
    ),
}


def start(*words: str, change: str = "") -> "subprocess.Popen[str]":
    return subprocess.Popen(
        ordinary_user.command(*words, change=change),
        cwd="/",
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=ordinary_user.environment(),
    )


def run(*words: str, change: str = "") -> Run:
    return finish(start(*words, change=change))


def test_a_complete_trial_of_an_ordinary_user(untouched: NamespaceComparison) -> None:
    completed = run("sh", "-e", "-c", COMPLETE_TRIAL, "sh", *FIELDKIT)
    assert completed.code == 0, completed.err
    output, _, content = completed.out.partition(BEFORE_THE_TABLE)
    assert "2 valid" in output
    table = csv.DictReader(content.strip().splitlines())
    tcp, udp = (row for row in table if row["status"] == "valid")  # on a busy machine, others may be void
    for row in (tcp, udp):
        assert 0 < int(row["rtt_received"]) <= int(row["rtt_sent"]), "fading may lose echoes"
    assert tcp["hash_match"] == "true"
    assert int(udp["datagrams_received"]) > 0
    untouched()


def test_a_lab_of_an_ordinary_user(untouched: NamespaceComparison) -> None:
    completed = run("sh", "-e", "-c", LAB, "sh", *FIELDKIT)
    assert completed.code == 0, completed.out + completed.err
    assert "2 robots up" in completed.out
    assert "robot-2 is at" in completed.out
    assert "the robots are down" in completed.out
    untouched()


def test_a_killed_trial_of_an_ordinary_user_leaves_no_processes_or_interfaces(untouched: NamespaceComparison) -> None:
    process = start(*FIELDKIT, *TRIAL, "--json")
    wait_for_line(process, '"transfer"')
    process_ids = descendants(process.pid)
    assert ordinary_user.UID in owners(process_ids)
    assert len(process_ids) > 10, "three robots with their programs, and the medium"
    process.send_signal(signal.SIGKILL)
    process.communicate()
    wait_for_end(process_ids, within_s=60.0)
    untouched()


def test_the_page_lists_the_tested_errors() -> None:
    assert list(table("On this machine")) == list(MISSING_PERMISSIONS)


@pytest.mark.parametrize("row", table("On this machine").values(), ids=lambda row: row.situation)
def test_a_missing_permission_gives_one_message_with_a_remedy(row: Row) -> None:
    wrapper = WITHOUT_USER_NAMESPACES if "kernel that forbids" in row.situation else ()
    completed = run(*wrapper, *FIELDKIT, *TRIAL, change=MISSING_PERMISSIONS[row.situation])
    check(row, completed.code, completed.err)
