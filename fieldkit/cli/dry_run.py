"""Show the commands of a trial without running them."""

from collections.abc import Iterator, Sequence

from fieldkit.backends.protocols import Robot
from fieldkit.core.events import CommandPlanned, Note, Sink
from fieldkit.core.model import Protocol, RepeatId, Role
from fieldkit.core.text import print_text
from fieldkit.core.units import format_count
from fieldkit.remote import evidence, fetching, jobs
from fieldkit.remote.command import quote
from fieldkit.remote.jobs import Job
from fieldkit.steps.scene import PutProgram
from fieldkit.trial.plan import Plan, telemetry_cast


def print_commands(plan: Plan) -> None:
    """Print the commands of one repeat per protocol, in order, grouped by robot.

    Jobs are shown as a person would type them on the robot. In a trial `job.sh` starts them detached.
    """
    repeats_text = f"{format_count(plan.repeats, 'repeat')} per protocol"
    print_text(f"# procedure {plan.procedure.name}, {plan.distance}, {plan.topology}; {repeats_text}")
    for remark in _remarks(plan):
        print_text(f"# {remark}")
    commands = list(_commands(plan))
    for protocol in plan.protocols:
        for role, robot in plan.cast.items():
            robot_commands = [command for command in commands if (command.protocol, command.role) == (protocol, role)]
            print_text(f"\n## {protocol}: {robot.name} ({role}, {robot.address}), in {_folder(plan, protocol)}")
            if not robot_commands:
                print_text("only the checks before repeat 1")
            for command in robot_commands:
                print_text(f"{command.number}. {command.name}: {command.command}")


def report_commands(plan: Plan, sink: Sink) -> None:
    """Send the output of `print_commands` to `sink` as events, for programs."""
    for remark in _remarks(plan):
        sink(Note(remark))
    for command in _commands(plan):
        sink(command)


def _remarks(plan: Plan) -> Iterator[str]:
    """Yield the remarks that follow from the plan alone, without a query to any robot."""
    for refusal in plan.refusals({}):
        name = plan.cast[refusal.role].name
        yield f"if {name} has the tools of its profile, this will be refused: {refusal.what}; {refusal.remedy}"
    for line in plan.dry_run_notes(plan.scene(RepeatId(plan.protocols[0], 1), "")):
        yield f"while steps run: {line}"
    if cast := telemetry_cast(plan):
        from fieldkit.telemetry import telemetry_queries  # noqa: PLC0415 (few profiles have sources)

        for line in telemetry_queries.dry_run_notes(cast):
            yield f"while steps run: {line}"


def _folder(plan: Plan, protocol: Protocol) -> str:
    return jobs.work_folder(plan.trial, f"{protocol}-01-1")


def _commands(plan: Plan) -> Iterator[CommandPlanned]:
    """Yield the commands of one repeat per protocol, robot by robot. A role that no step uses has no commands."""
    for protocol in plan.protocols:
        folder = _folder(plan, protocol)
        scene = plan.scene(RepeatId(protocol, 1), folder)
        all_jobs = list(plan.jobs(scene))
        for role, robot in scene.cast.items():
            if role not in plan.procedure.roles():
                continue
            location = (scene.folder, role, robot.profile.radio.interface)
            commands = [
                (0, "begin", quote(evidence.begin_command(*location, sources=_telemetry_sources(plan, role)))),
                *((0, "put", _copy_command(put, robot, folder)) for put in plan.program_copies() if put.role is role),
                *(
                    (number, planned_job.job.name, shell_line(planned_job.job))
                    for number, planned_job in enumerate(all_jobs, start=1)
                    if planned_job.role is role
                ),
                (len(all_jobs) + 1, "pack", quote(fetching.pack_command(*location))),
            ]
            for number, name, command in commands:
                yield CommandPlanned(protocol, robot.name, role, folder, number, name, command)


def _telemetry_sources(plan: Plan, role: Role) -> Sequence[Sequence[str]]:
    """Return the telemetry sources that a robot queries during an attempt."""
    cast = telemetry_cast(plan)
    if not cast:
        return ()
    from fieldkit.telemetry import telemetry_queries  # noqa: PLC0415 (few profiles have sources)

    return telemetry_queries.queries_by_role(cast).get(role, ())


def _copy_command(put: PutProgram, robot: Robot, folder: str) -> str:
    """Return the command that copies a program from this machine into the folder of the repeat on a robot."""
    argv = ("scp", "-p", put.program.file, f"{robot.address}:{folder}/{put.at}")
    return f"{quote(argv)}  # SHA-256 {put.program.sha256}"


def shell_line(job: Job) -> str:
    """Return a job's command as a person would type it in its folder."""
    text = quote((("sudo", "-n") if job.as_root else ()) + job.argv)
    text += f" < {quote((job.stdin,))}" if job.stdin else ""
    text += (f" > {quote((job.stdout,))}" if job.stdout else "") + f" 2> {quote((job.log,))}"
    return text + (f"  # at most {job.output_limit_bytes} bytes of each" if job.output_limit_bytes else "")
