"""`fieldkit trial PROCEDURE DISTANCE ...`: the main job."""

import argparse
import secrets
from datetime import UTC, datetime

from fieldkit.cli import options
from fieldkit.cli.display import watching
from fieldkit.cli.interrupts import interruptible
from fieldkit.core.events import Note
from fieldkit.core.model import RepeatId
from fieldkit.core.units import format_count, format_duration, parse_distance
from fieldkit.remote import evidence, jobs
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
        if arguments.dry_run:
            print_commands(plans[0])
            return 0
        # What runs and measures a trial takes pyarrow, which a dry run does not need.
        from fieldkit.cli import results  # noqa: PLC0415
        from fieldkit.trial import opening  # noqa: PLC0415

        sink(Note(_announce(plans)))
        with options.operator(arguments, sink) as operator:
            ended = opening.run(plans, backend, cast, arguments.out, sink=sink, operator=operator, stop=stop)
    return results.report(ended, quiet=arguments.json)


def print_commands(plan: Plan) -> None:
    """Print the commands of one repeat per protocol, in order, grouped by robot.

    Jobs are shown as a person would type them; `job.sh` runs them detached.
    """
    print(f"# procedure {plan.procedure.name}, {plan.distance}, {plan.topology}; {plan.repeats} repeats per protocol")
    for refusal in plan.refusals({}):
        name = plan.cast[refusal.role].name
        print(f"# will be refused, if {name} has what its profile names: {refusal.what}; {refusal.remedy}")
    here = plan.scene(RepeatId(plan.protocols[0], 1), "")
    for line in plan.beside(here):
        print(f"# while steps run: {line}")
    for protocol in plan.protocols:
        scene = plan.scene(RepeatId(protocol, 1), jobs.work_folder(plan.trial, f"{protocol}-01-1"))
        planned = list(plan.commands(scene))
        for role, robot in scene.cast.items():
            print(f"\n## {protocol}: {robot.name} ({role}, {robot.address}), in {scene.folder}")
            if role not in plan.procedure.roles():
                print("nothing but the checks before repeat 1")
                continue
            where = (scene.folder, role, robot.profile.radio.interface)
            print(f"0. begin: {quote(evidence.begin_command(*where))}")
            for number, one in enumerate(planned, start=1):
                if one.role is role:
                    print(f"{number}. {one.job.name}: {in_shell(one.job)}")
            print(f"{len(planned) + 1}. pack: {quote(evidence.pack_command(*where))}")


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
