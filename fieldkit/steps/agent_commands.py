"""Commands for a robot's Python, including the commands of the agent, fieldkit's program on robots."""

import json
from collections.abc import Mapping
from typing import Any

from fieldkit.backends.protocols import Robot
from fieldkit.remote import agent
from fieldkit.remote.command import with_environment


def compact(value: Any) -> str:  # noqa: ANN401 (any JSON value)
    """Return a value as JSON without whitespace."""
    return json.dumps(value, separators=(",", ":"))


def setup(robot: Robot) -> tuple[str, ...]:
    """Return the shell files to source first, which may add packages to the search path of Python."""
    return robot.profile.ros.command.setup if robot.profile.ros else ()


def python(robot: Robot, *words: str, environment: Mapping[str, str] | None = None) -> tuple[str, ...]:
    """Return a command for a robot's Python; `environment` overrides variables of the setup files."""
    return with_environment((robot.profile.tools.python, *words), setup=setup(robot), environment=environment)


def agent_command(robot: Robot, *words: str, environment: Mapping[str, str] | None = None) -> tuple[str, ...]:
    """Return a command for the agent on a robot, to be run as a job."""
    return python(robot, agent.path_from_job(), *words, environment=environment)
