"""Creates the agents of a scenario: bodies, radios, and the programs that steer them and send their traffic."""

import math
from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import Any, Final

from fieldkit.config import profiles
from fieldkit.config.locations import names
from fieldkit.core.model import Vector
from sim_backends.cosim.federates import Program
from sim_backends.cosim.programs.follow import FollowAtHeadway, HoldStation
from sim_backends.cosim.programs.senders import (
    EchoRequester,
    EchoResponder,
    Periodic,
    Playback,
    file_pieces,
    generated_bag,
)
from sim_backends.cosim.programs.way_points import PERIOD_NS, DriveThrough, FlyThrough, ProfileLeg, VelocityProfile
from sim_backends.cosim.programs.wrappers import AgentClock, CombinedProgram, Outage, ProgramWithClock
from sim_backends.cosim.scenario.agent_plans import (
    BagTraffic,
    FileTraffic,
    FollowPlan,
    LegPlan,
    PingTraffic,
    StandingPlan,
    StationKeepingPlan,
    StreamTraffic,
    Traffic,
    VelocityProfilePlan,
    WayPointsPlan,
)
from sim_backends.cosim.scenario.faults import ClockSkewFault, NodeLossFault
from sim_backends.cosim.scenario.schema import AgentPlan, CosimScenario
from sim_backends.physics.body import Body, Twist, Velocity
from sim_backends.physics.differential_drive import DifferentialDrive
from sim_backends.physics.quadrotor import Quadrotor
from sim_backends.physics.robot_limits import BODIES, TURTLEBOT3_BURGER, DriveLimits, QuadrotorLimits, quadrotor
from sim_backends.radio.antennas import Antenna, antenna_of
from sim_backends.radio.core.random_streams import RandomStream
from sim_backends.world.world import World


def list_robots() -> list[str]:
    """Return all valid values of an agent's `robot`: kinds of bodies, and names of robot profiles."""
    return sorted({*BODIES, *names("robots")})


def limits_of(robot: str) -> DriveLimits | QuadrotorLimits:
    """Return the limits of a robot's body.

    A robot profile contains only the top speed. The other limits are those of the TurtleBot3 Burger or, if the robot
    flies, of the Duckiedrone.
    """
    if robot in BODIES:
        return BODIES[robot]
    profile = profiles.load_profile(robot)
    reference_limits: DriveLimits | QuadrotorLimits = quadrotor(robot) if profile.kind == "uav" else TURTLEBOT3_BURGER
    return replace(reference_limits, speed_m_s=float(profile.limits.max_speed_m_s))


def make_bodies(scenario: CosimScenario, world: World) -> dict[str, Body[Any]]:
    """Return the bodies of all agents, at their start positions."""
    return {name: _body(plan, scenario, world) for name, plan in scenario.agents.items()}


def _body(plan: AgentPlan, scenario: CosimScenario, world: World) -> Body[Any]:
    heading_rad, body_limits = math.radians(plan.heading_deg), limits_of(plan.robot)
    east_m, north_m, up_m = _start_m(plan, scenario, world)
    if isinstance(body_limits, QuadrotorLimits):
        return Quadrotor(body_limits, (east_m, north_m, up_m), heading_rad)
    return DifferentialDrive(body_limits, (east_m, north_m), heading_rad)


def _start_m(plan: AgentPlan, scenario: CosimScenario, world: World) -> Vector:
    """Return the start position of an agent: metres east, north, up."""
    point_m = plan.at_m
    if point_m is None:
        assert plan.along is not None
        point_m = world.lines[scenario.line].at(plan.along, plan.aside_m)
    return *point_m, world.ground_m(point_m) + plan.height


def antennas_of(scenario: CosimScenario) -> dict[str, Antenna]:
    """Return the antennas of the agents that have a radio, from their plan or from their robot profile."""
    profile_names = names("robots")
    used_profiles = {
        plan.robot for plan in scenario.agents.values() if plan.radio is None and plan.robot in profile_names
    }
    profile_antennas = {robot: antenna_of(profiles.load_profile(robot).radio) for robot in sorted(used_profiles)}
    agent_antennas = {}
    for name, plan in scenario.agents.items():
        if (radio := plan.radio) is not None:
            agent_antennas[name] = antenna_of(radio)
        elif plan.robot in profile_antennas:
            agent_antennas[name] = profile_antennas[plan.robot]
    return agent_antennas


STATION_M_S: Final = 1.0
"""Station keeping: largest speed at which an agent returns to its station."""


def stop_commands(bodies: Mapping[str, Body[Any]]) -> dict[str, Twist | Velocity]:
    """Return the command that stops each body."""
    return {name: Velocity() if body.flies else Twist() for name, body in bodies.items()}


def make_controllers(scenario: CosimScenario, bodies: Mapping[str, Body[Any]], seed: int) -> dict[str, Program]:
    """Return the controllers of the agents that move, by the name of the agent.

    Args:
        scenario: The scenario.
        bodies: The body of each agent.
        seed: Seed of the phases (times of first commands) that the scenario does not set. They are random, because
            the controllers of different robots do not run at the same times.
    """
    programs = {
        name: _controller(plan, bodies[name], plan.lifetime.appears_ns, _phase_ns(name, plan, seed))
        for name, plan in scenario.agents.items()
    }
    return {name: program for name, program in programs.items() if program is not None}


def _phase_ns(name: str, plan: AgentPlan, seed: int) -> int:
    """Return the time of the first command of a controller, from the appearance of its agent."""
    if plan.phase is not None:
        return round(plan.phase * 1e9)
    return int(RandomStream(seed, name, "controller's phase").draw(0) * PERIOD_NS)


def _controller(plan: AgentPlan, body: Body[Any], appears_ns: int, phase_ns: int) -> Program | None:
    """Return the program that steers an agent; None if the agent never moves."""
    motion = plan.motion
    first_ns = appears_ns + phase_ns
    match motion:
        case StandingPlan():
            return None
        case WayPointsPlan():
            begin_ns = round(motion.wait * 1e9) + first_ns
            return _waypoint_program(path_points_m(motion, body.place_m), motion.speed, body, begin_ns)
        case StationKeepingPlan():
            return _waypoint_program([body.place_m], STATION_M_S, body, first_ns)
        case VelocityProfilePlan():
            heading_rad = math.radians(plan.heading_deg)
            return VelocityProfile([_leg(leg, body, heading_rad) for leg in motion.legs], begin_ns=appears_ns)
        case FollowPlan():
            return _follower(motion, body, first_ns)


def _leg(leg: LegPlan, body: Body[Any], heading_rad: float) -> ProfileLeg:
    command: Twist | Velocity = Twist(leg.speed, math.radians(leg.turn_deg_s))
    if body.flies:
        east, north = leg.speed * math.cos(heading_rad), leg.speed * math.sin(heading_rad)
        command = Velocity((east, north, float(leg.climb_m_s)))
    return ProfileLeg(round(leg.duration * 1e9), command)


def _follower(motion: FollowPlan, body: Body[Any], begin_ns: int) -> Program:
    timeout_ns = round(motion.timeout * 1e9)
    if body.flies:
        return HoldStation(motion.leader, above_m=motion.distance, timeout_ns=timeout_ns, begin_ns=begin_ns)
    (leader,) = motion.leader
    return FollowAtHeadway(
        leader,
        headway_s=motion.headway,
        standstill_m=motion.distance,
        top_speed_m_s=body.top_speed_m_s,
        timeout_ns=timeout_ns,
        begin_ns=begin_ns,
    )


def _waypoint_program(points_m: list[Vector], speed_m_s: float, body: Body[Any], begin_ns: int) -> Program:
    if body.flies:
        return FlyThrough(points_m, speed_m_s, begin_ns=begin_ns)
    return DriveThrough([(east_m, north_m) for east_m, north_m, _ in points_m], speed_m_s, begin_ns=begin_ns)


def path_points_m(plan: WayPointsPlan, start_m: Vector) -> list[Vector]:
    """Return the waypoints of a path, metres east, north, up."""
    origin_m = start_m if plan.relative else (0.0, 0.0, 0.0)
    return [
        (origin_m[0] + east_m, origin_m[1] + north_m, origin_m[2] + up_m[0] if up_m else start_m[2])
        for east_m, north_m, *up_m in plan.points_m
    ]


START_INTERVAL_S: Final = 0.1
"""Traffic without a period begins at a random time in an interval of this length, which equals the default of the
scenario's key `policy.longest`, the longest window."""


def make_programs(
    scenario: CosimScenario, seed: int, controllers: Mapping[str, Program], stops: Mapping[str, Any]
) -> dict[str, Program]:
    """Return the programs of all agents that send traffic, reply to pings or have a controller, by agent.

    Args:
        scenario: The scenario.
        seed: Seed of the random draws.
        controllers: The program that steers each agent.
        stops: The command that stops each agent's body.
    """
    programs_by_agent: dict[str, list[Program]] = {name: [] for name in scenario.agents}
    for name, controller in controllers.items():
        programs_by_agent[name].append(controller)
    for traffic in scenario.traffic:
        begin_s = max(traffic.start, scenario.agents[traffic.source].appears)
        programs_by_agent[traffic.source] += [
            _sender(traffic, flow, to, begin_s, seed) for flow, to in traffic.flows.items()
        ]
    for name in {to for traffic in scenario.traffic if isinstance(traffic, PingTraffic) for to in traffic.to}:
        programs_by_agent[name].append(EchoResponder())
    program_by_agent: dict[str, Program] = {
        name: agent_programs[0] if len(agent_programs) == 1 else CombinedProgram(agent_programs)
        for name, agent_programs in programs_by_agent.items()
        if agent_programs
    }
    return dict(_with_faults(scenario, program_by_agent, stops))


def _sender(traffic: Traffic, flow: str, to: str, begin_s: float, seed: int) -> Program:
    """Return the program that sends the packets of a flow."""
    phase = RandomStream(seed, flow, "phase").draw(0)
    begin_ns = _ns(begin_s + phase * (traffic.period_s or START_INTERVAL_S))
    match traffic:
        case StreamTraffic():
            return Periodic(
                flow,
                to,
                period_ns=_ns(1 / traffic.rate),
                size_bytes=traffic.size_bytes,
                first_ns=begin_ns,
                stop_ns=None if traffic.stop is None else _ns(traffic.stop),
                protocol=traffic.transport,
            )
        case PingTraffic():
            return EchoRequester(
                flow,
                to,
                count=traffic.count,
                interval_ns=_ns(traffic.interval),
                size_bytes=traffic.size_bytes,
                first_ns=begin_ns,
                protocol=traffic.transport,
            )
        case FileTraffic():
            bag = file_pieces(traffic.size_bytes, traffic.piece_bytes)
        case BagTraffic():
            bag = generated_bag(
                # The random stream depends on the bag only, because every receiver gets the same bag.
                RandomStream(seed, traffic.title, "recorded"),
                length_ns=_ns(traffic.length),
                rate_hz=traffic.rate,
                size_bytes=traffic.size_bytes,
                jitter_ns=_ns(traffic.jitter),
            )
    return Playback(flow, to, bag, begin_ns=begin_ns, protocol=traffic.transport)


def _with_faults(
    scenario: CosimScenario, program_by_agent: Mapping[str, Program], stops: Mapping[str, Any]
) -> Iterator[tuple[str, Program]]:
    """Yield each agent and its program, wrapped so that the faults of its clock and its computer take effect."""
    skews = [fault for fault in scenario.faults if isinstance(fault, ClockSkewFault)]
    clocks = {
        skew.agent: AgentClock(skew.begin_ns, skew.end_ns, round(skew.offset_ms * 1e6), round(skew.rate_ppm * 1e3))
        for skew in skews
    }
    for name, program in program_by_agent.items():
        wrapped_program = ProgramWithClock(program, clocks.get(name, AgentClock())) if skews else program
        for fault in scenario.faults:
            if isinstance(fault, NodeLossFault) and fault.agent == name:
                wrapped_program = Outage(wrapped_program, fault.begin_ns, fault.end_ns, stops.get(name))
        yield name, wrapped_program


def _ns(seconds: float) -> int:
    return round(seconds * 1e9)
