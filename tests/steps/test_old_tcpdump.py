"""A repeat with a tcpdump without immediate mode, whose captures must be complete."""

from dataclasses import replace
from pathlib import Path

import pytest

from fieldkit.core.deadline import Deadline
from fieldkit.core.model import FIXED_ROLES, Placement, Protocol, RepeatId, Role, Scenario, Topology
from fieldkit.core.units import parse_distance
from fieldkit.remote import evidence, fetching, jobs
from fieldkit.steps import variants
from sim_backends.emulated import testbed
from sim_backends.emulated.backend import EmulatedBackend
from sim_backends.emulated.emulated_options import EmulatedOptions, RosChoice
from sim_backends.radio.radio_options import RadioOptions
from sim_backends.world.world import load_world
from tests.helpers.casts import TURTLEBOT, los_plan
from tests.helpers.plans import problems

pytestmark = pytest.mark.emulated


def test_the_ring_buffer_of_the_kernel_is_drained(tmp_path: Path) -> None:
    plan = los_plan(record_s=0.5, protocols=(Protocol.TCP,))
    old_tools = replace(variants.expected(TURTLEBOT), immediate_mode=False)
    folder = jobs.work_folder(plan.trial, "tcp-01-1")
    scene = plan.scene(RepeatId(Protocol.TCP, 1), folder, dict.fromkeys(FIXED_ROLES, old_tools))
    cast, radio = EmulatedBackend(None, None).cast(Topology.MASTER), RadioOptions(fading=False)
    with testbed.bring_up(
        cast, options=EmulatedOptions(radio=radio), world=load_world("lawn"), ros=RosChoice.BUILTIN, seed=1
    ) as robots:
        robots.place(Placement(Scenario.LOS, Topology.MASTER, parse_distance("30ft")))
        targets = {role: (robots.shells[role], folder, role, "wlan0") for role in (Role.SENDER, Role.RECEIVER)}
        for role, target in targets.items():
            jobs.install(robots.shells[role], Deadline.after(jobs.REPLY_S))
            evidence.begin(*target)
        for entry in plan.procedure.steps:
            entry.step.run(scene, robots, lambda *_: None)
        for target in targets.values():
            fetching.fetch(*target, tmp_path)
    assert problems(plan, Protocol.TCP, tmp_path) == ()
