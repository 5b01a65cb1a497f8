"""Options of Gazebo: `physics.options` of a scenario. The adapter reads them in `options.h`."""

from collections.abc import Iterator, Mapping
from typing import Annotated, Any, Literal

from typing_extensions import override

from fieldkit.config.schema import Bool, Field, Location
from fieldkit.core.units import parse_duration_s
from sim_backends.federates.simulator_options import SimulatorOptions
from sim_backends.gazebo.sdf import VERSIONS, model_sdf
from sim_backends.physics.robot_limits import DriveLimits, QuadrotorLimits
from sim_backends.world.obstacles import Coordinate, Real

Positive = Annotated[Real, Field(gt=0, le=1e6)]
NotNegative = Annotated[Real, Field(ge=0, le=1e6)]
Position = tuple[Coordinate, Coordinate, Coordinate]


class GazeboOptions(SimulatorOptions):
    """Options of the physics simulator [Gazebo](gazebo.md).

    In names of services and topics, `{world}` is replaced by the name of the world. In topics of commands, `{model}`
    is replaced by the name of the agent's model.

    Attributes:
        world: Name of Gazebo's world; if omitted, the name of the scenario's world.
        models: Name of the model of each agent whose model does not have the agent's name.
        origins_m: For each agent, the body's lowest point in the frame of its model; if omitted, `[0, 0, 0]`.
        partition: Value of `IGN_PARTITION` and `GZ_PARTITION`; if omitted, the value in the environment.
        ip: Value of `IGN_IP` and `GZ_IP`; if omitted, the value in the environment.
        control_service: Service that advances, pauses and resets the world.
        pose_service: Service that places robots.
        create_service: Service that creates the model of an agent when it appears.
        remove_service: Service that removes the model of an agent when it disappears.
        model_files: SDF file, on the machine of Gazebo, for each agent with `appears` or `disappears` whose model is
            not the one in `fieldkit cosim sdf`. A model that disappears is created again at the end of the run.
        pose_topic: Topic of the poses of the models.
        clock_topic: Topic of the simulated time.
        command_topic: Topic of the commands to an agent.
        command_topics: Topic of the commands to each agent whose topic is not `command_topic`.
        acknowledge: Acknowledgement of commands before the next step: `required` by a plugin of the world, `auto` by
            the plugin or without it by requests to the control service, or `off`; see
            [lock-step](gazebo.md#lock-step).
        fence_topic: Topic of requests for the acknowledgement.
        fence_answer: Topic of the acknowledgement.
        reset: Reset the world before a run.
        place: Set the poses of the robots before a run.
        settle_s: Simulated time in which robots come to rest before time 0. Before the reset, it may be up to six
            times as long.
        start_error_m: Largest permitted distance of a robot from its start position at the start of a run.
        velocity: Interval over which velocities are computed from positions: the last `step`, or the `window`, which
            takes one request to Gazebo per window instead of two.
        gravity_m_s2: Gravity that is compensated for robots that fly; 0 if their links have no gravity.
        yaw_gain_per_s: Commanded yaw rate of robots that fly, per radian of heading error.
        control_period_s: Interval, in simulated time, between repeated commands while a robot that flies turns to its
            commanded heading.
        limit_m_s2: Largest acceleration, for the sync policy `error_bounded`; if omitted, this policy exchanges
            states after every step while an agent sends.
        deterministic: True to declare that equal requests give equal answers.
        timeout_s: Maximum wait without progress, in wall time.
    """

    world: str | None = None
    models: dict[str, str] = Field(default_factory=dict)
    origins_m: dict[str, Position] = Field(default_factory=dict)
    partition: str | None = None
    ip: str | None = None
    control_service: str = "/world/{world}/control"
    pose_service: str = "/world/{world}/set_pose"
    create_service: str = "/world/{world}/create"
    remove_service: str = "/world/{world}/remove"
    model_files: dict[str, str] = Field(default_factory=dict)
    pose_topic: str = "/world/{world}/dynamic_pose/info"
    clock_topic: str = "/world/{world}/clock"
    command_topic: str = "/model/{model}/cmd_vel"
    command_topics: dict[str, str] = Field(default_factory=dict)
    acknowledge: Literal["auto", "required", "off"] = "auto"
    fence_topic: str = "/world/{world}/fieldkit/fence"
    fence_answer: str = "/world/{world}/fieldkit/passed"
    reset: Bool = True
    place: Bool = True
    settle_s: NotNegative = 0.5
    start_error_m: Positive = 0.3
    velocity: Literal["step", "window"] = "step"
    gravity_m_s2: NotNegative = 9.80665
    yaw_gain_per_s: NotNegative = 4
    control_period_s: Positive = 0.02
    limit_m_s2: Positive | None = None
    deterministic: Bool = False
    timeout_s: Positive = 10

    @override
    def agent_names(self) -> Iterator[tuple[str, Location]]:
        for key in ("models", "origins_m", "command_topics", "model_files"):
            yield from ((name, (key, name)) for name in getattr(self, key))

    @override
    def further_configuration(self, configuration: Mapping[str, Any]) -> dict[str, Any]:
        """Return `sdf`: the model of each agent in SDF, by version of the plugin names (`sdf.Version`)."""
        step_ns = round(parse_duration_s(configuration["scenario"]["physics"]["step"]) * 1e9)
        models: dict[str, dict[str, str]] = {}
        for agent, robot in configuration["robots"].items():
            name, limits = self.models.get(agent, agent), _limits(robot["body"])
            models[agent] = {
                version: model_sdf(name, limits, step_ns=step_ns, version=version) for version in VERSIONS
            }
        return {"sdf": models}


def _limits(body: Mapping[str, Any]) -> DriveLimits | QuadrotorLimits:
    """Return the limits of a body in the configuration; only a quadrotor has a mass there."""
    return QuadrotorLimits(**body) if "mass_kg" in body else DriveLimits(**body)
