"""`fieldkit trial PROCEDURE DISTANCE ...`: the main job."""

import argparse
import secrets
from collections.abc import Iterator
from datetime import UTC, datetime

from fieldkit.cli import options
from fieldkit.cli.display import watching
from fieldkit.cli.terminal import interruptible
from fieldkit.core.events import CommandPlanned, Note, Sink
from fieldkit.core.model import Protocol, RepeatId
from fieldkit.core.units import format_count, format_duration, parse_distance
from fieldkit.remote import evidence, fetching, jobs
from fieldkit.remote.command import quote
from fieldkit.remote.jobs import Job
from fieldkit.trial.plan import Plan
from fieldkit.trial.request import make_plan


def run(arguments: argparse.Namespace) -> int:
    """Run the trial at each distance and print the table of each."""
    requests = [
        options.request(arguments, parse_distance(text), seed=arguments.seed, notes=arguments.notes)
        for text in arguments.distances
    ]
    topology = requests[0].chosen_topology
    with watching(as_json=arguments.json) as sink, interruptible() as stop:
        name, backend = options.backend(arguments, sink)
        cast = backend.cast(topology)
        run_id = secrets.token_hex(8)
        plans = [
            make_plan(
                request,
                backend=name,
                cast=cast,
                now=datetime.now(UTC),
                session=run_id,
                lab_bytes=backend.lab_bytes,
            )
            for request in requests
        ]
        for line in requests[0].procedure.shortened(cast):
            sink(Note(line))
        if arguments.dry_run and arguments.json:
            tell_commands(plans[0], sink)
        elif arguments.dry_run:
            print_commands(plans[0])
        if arguments.dry_run:
            return 0
        # What runs and measures a trial takes pyarrow, which a dry run does not need.
        from fieldkit.cli import results  # noqa: PLC0415
        from fieldkit.trial.running import opening  # noqa: PLC0415

        sink(Note(_announce(plans)))
        with options.operator(arguments, sink) as operator:
            ended = opening.run(plans, backend, plans[0].cast, arguments.out, sink=sink, operator=operator, stop=stop)
    return results.report(ended, arguments)


def print_commands(plan: Plan) -> None:
    """Print the commands of one repeat per protocol, in order, grouped by robot.

    Jobs are shown as a person would type them; `job.sh` runs them detached.
    """
    each = f"{format_count(plan.repeats, 'repeat')} per protocol"
    print(f"# procedure {plan.procedure.name}, {plan.distance}, {plan.topology}; {each}")
    for remark in _remarks(plan):
        print(f"# {remark}")
    planned = list(_commands(plan))
    for protocol in plan.protocols:
        for role, robot in plan.cast.items():
            mine = [command for command in planned if (command.protocol, command.role) == (protocol, role)]
            print(f"\n## {protocol}: {robot.name} ({role}, {robot.address}), in {_folder(plan, protocol)}")
            if not mine:
                print("nothing but the checks before repeat 1")
            for command in mine:
                print(f"{command.number}. {command.name}: {command.command}")


def tell_commands(plan: Plan, sink: Sink) -> None:
    """Tell what `print_commands` prints as events, for a program."""
    for remark in _remarks(plan):
        sink(Note(remark))
    for command in _commands(plan):
        sink(command)


def _remarks(plan: Plan) -> Iterator[str]:
    """Yield what is known before any robot is asked, beside the commands."""
    for refusal in plan.refusals({}):
        name = plan.cast[refusal.role].name
        yield f"will be refused, if {name} has what its profile names: {refusal.what}; {refusal.remedy}"
    for line in plan.beside(plan.scene(RepeatId(plan.protocols[0], 1), "")):
        yield f"while steps run: {line}"


def _folder(plan: Plan, protocol: Protocol) -> str:
    return jobs.work_folder(plan.trial, f"{protocol}-01-1")


def _commands(plan: Plan) -> Iterator[CommandPlanned]:
    """Yield the commands of one repeat per protocol, robot by robot; a role that no step names has none."""
    for protocol in plan.protocols:
        folder = _folder(plan, protocol)
        scene = plan.scene(RepeatId(protocol, 1), folder)
        everybodys = list(plan.commands(scene))
        for role, robot in scene.cast.items():
            if role not in plan.procedure.roles():
                continue
            where = (scene.folder, role, robot.profile.radio.interface)
            mine = [
                (0, "begin", quote(evidence.begin_command(*where))),
                *(
                    (number, planned.job.name, in_shell(planned.job))
                    for number, planned in enumerate(everybodys, start=1)
                    if planned.role is role
                ),
                (len(everybodys) + 1, "pack", quote(fetching.pack_command(*where))),
            ]
            for number, name, command in mine:
                yield CommandPlanned(protocol, robot.name, role, folder, number, name, command)


def in_shell(job: Job) -> str:
    """Return a job's command as a person would type it in its folder."""
    text = quote((("sudo", "-n") if job.as_root else ()) + job.argv)
    text += f" < {quote((job.stdin,))}" if job.stdin else ""
    return text + (f" > {quote((job.stdout,))}" if job.stdout else "") + f" 2> {quote((job.log,))}"


def _announce(plans: list[Plan]) -> str:
    protocols = " and ".join(protocol.upper() for protocol in plans[0].protocols)
    places = f" at each of {len(plans)} distances" if len(plans) > 1 else ""
    duration = format_duration(sum(plan.expected_s() for plan in plans))
    return f"{format_count(plans[0].repeats, 'repeat')} of {protocols}{places}, about {duration}"
