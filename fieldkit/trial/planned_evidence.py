"""Evidence of a repeat according to the plan of its trial: transfers, pings, captures and recordings."""

from collections.abc import Mapping

from fieldkit.core.model import Protocol, Role
from fieldkit.measure.transfers.transfer_spec import Transfer
from fieldkit.steps.capabilities import Pings, SendsFile
from fieldkit.steps.nest import Nest
from fieldkit.steps.scene import PingSource
from fieldkit.trial.plan import Plan


def transfers(plan: Plan, protocol: Protocol) -> tuple[Transfer, ...]:
    """Return the transfers of a repeat, in the order in which they start."""
    scene = plan.procedure.scene(protocol, plan.cast, "")
    specs = (
        placed.step.transfer(scene, placed.within)
        for placed in plan.procedure.walk()
        if isinstance(placed.step, SendsFile)
    )
    return tuple(transfer for transfer in specs if transfer is not None)


def ping_sources(plan: Plan) -> tuple[PingSource, ...]:
    """Return the measurements of round-trip times of a repeat, in the order in which they start."""
    specs = (placed.step.ping_source() for placed in plan.procedure.walk() if isinstance(placed.step, Pings))
    return tuple(source for source in specs if source is not None)


def captures(plan: Plan) -> Mapping[str, Role]:
    """Return the role of the robot that makes each capture, by capture file."""
    nests = (placed.step for placed in plan.procedure.walk() if isinstance(placed.step, Nest))
    roles_by_file = [(file, role) for nest in nests for role, file in nest.captures().items()]
    return {file: role for role in plan.cast for file, owner in roles_by_file if owner == role}


def bags(plan: Plan) -> Mapping[Role, str]:
    """Return the first file (usually a ROS bag) that is recorded on each robot, relative to an attempt's folder."""
    scene = plan.procedure.scene(plan.protocols[0], plan.cast, "")
    return {role: recordings[0].name for role, recordings in scene.recordings.items()}
