"""Setup files at the paths of a real robot: the emulated robot has them, although the host does not."""

import shlex
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from fieldkit.backends.protocols import Cast
from fieldkit.config import locations, schema
from fieldkit.config.profiles import RecordCommand
from fieldkit.core.deadline import Deadline
from fieldkit.core.errors import ConfigurationError
from fieldkit.core.model import Role, Topology
from fieldkit.remote.command import with_environment
from fieldkit.remote.shell import Shell
from sim_backends.emulated import testbed
from sim_backends.emulated.backend import DEFAULT_SITE, EmulatedBackend
from sim_backends.emulated.emulated_options import EmulatedOptions, RosChoice
from sim_backends.world.world import load_world
from tests.helpers import ordinary_user
from tests.helpers.casts import ros_of
from tests.helpers.host import NamespaceComparison

SETUP = (
    "/opt/ros/noetic/setup.bash",
    "/etc/clearpath/setup.bash",  # Clearpath's robots
    "/code/catkin_ws/devel/setup.bash",  # Duckietown's containers
    "/usr/share/our robot/setup.sh",
    "/etc/ros.bash",
)
LONG_S = 60.0


def cast_with(*setup: str) -> Cast:
    """Return the paper's sender alone, with other setup files."""
    robot = EmulatedBackend(None, None).cast(Topology.MASTERLESS)[Role.SENDER]
    ros = ros_of(robot.profile)
    command = ros.command.model_copy(update={"setup": setup})
    profile = robot.profile.model_copy(update={"ros": ros.model_copy(update={"variants": {"ros1": command}})})
    return {Role.SENDER: robot.model_copy(update={"profile": profile})}


@pytest.fixture(scope="module")
def shell() -> Iterator[Shell]:
    options, world = EmulatedOptions(), load_world("lawn")
    with testbed.bring_up(
        cast_with(*SETUP), options=options, world=world, ros=RosChoice.BUILTIN, seed=1
    ) as emulation:
        yield emulation.shells[Role.SENDER]


def output_of(shell: Shell, *argv: str) -> str:
    return shell.run(argv, deadline=Deadline.after(LONG_S)).stdout.decode()


@pytest.mark.emulated
@pytest.mark.parametrize("path", SETUP)
def test_a_setup_file_can_be_sourced_at_the_path_in_the_profile(path: str, shell: Shell) -> None:
    assert not Path(path).exists(), "the host must not have this file"
    output = output_of(shell, *with_environment(["sh", "-c", 'echo "$ROS_DISTRO"; command -v rosbag'], setup=[path]))
    assert output.split("\n") == ["noetic", f"{Path(path).parent}/bin/rosbag", ""]


@pytest.mark.emulated
def test_the_remaining_file_system_is_as_usual(shell: Shell, untouched: NamespaceComparison) -> None:
    assert output_of(shell, "hostname") == "turtlebot-1\n"
    assert output_of(shell, "getent", "hosts", "turtlebot-1").split() == ["10.42.0.1", "turtlebot-1"]
    for folder in ("/", "/etc", "/usr/share", "/etc/clearpath"):
        result = shell.run(("touch", f"{folder}/mine"), deadline=Deadline.after(LONG_S), check=False)
        assert b"Read-only file system" in result.stderr, folder
    assert output_of(shell, "ls", "/etc/ssh") == "".join(f"{name}\n" for name in sorted_as_ls(Path("/etc/ssh")))
    assert output_of(shell, "readlink", "/bin") == f"{Path('/bin').readlink()}\n"
    mounts = output_of(shell, "cat", "/proc/self/mountinfo").splitlines()
    assert sum(line.split()[4] == "/" for line in mounts) == 1, "the old root is unmounted"
    untouched()


# In the namespace of an ordinary user, /etc contains other mounts.
USER_SCRIPT = f"""
mkdir robots
echo 'emulated: {{ros: builtin}}' | cat {shlex.quote(str(DEFAULT_SITE))} - > fieldkit.yaml
sed 's#setup: .*noetic.*#setup: [/code/ws/setup.bash, /etc/clearpath/setup.bash]#' \
    {shlex.quote(str(locations.find("robots", "turtlebot3_burger")))} > robots/turtlebot3_burger.yaml
"$@" lab up --robots 1
"$@" lab shell robot-1 sh -c '. /code/ws/setup.bash && . /etc/clearpath/setup.bash && echo "found $ROS_DISTRO"'
"$@" lab down
"""


@pytest.mark.emulated
def test_setup_files_work_for_an_ordinary_user_too() -> None:
    words = ("sh", "-e", "-c", USER_SCRIPT, "sh", sys.executable, "-m", "fieldkit")
    environment = ordinary_user.environment()
    result = subprocess.run(
        ordinary_user.command(*words), cwd="/", env=environment, capture_output=True, text=True, check=False
    )
    assert "found noetic" in result.stdout, result.stdout + result.stderr


def sorted_as_ls(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir() if not path.name.startswith("."))


@pytest.mark.parametrize("path", ["setup.bash", "~/ws/setup.bash", "/opt/../etc/x", "/opt/ros/", "$HOME/setup.bash"])
def test_paths_that_are_not_absolute_are_rejected(path: str) -> None:
    text = f'{{distribution: noetic, setup: ["{path}"], record: ["{{topics}}"], ends: itself, writes: x.bag}}'
    with pytest.raises(ConfigurationError, match="is not an absolute path"):
        schema.validate(schema.parse(text, source="x"), RecordCommand)
