"""Commands of a trial, shown without running them."""

from collections.abc import Iterator

from fieldkit.backends.protocols import Robot
from fieldkit.core.events import CommandPlanned, Note, Sink
from fieldkit.core.model import Protocol, RepeatId
from fieldkit.core.printing import say
from fieldkit.core.units import format_count
from fieldkit.remote import evidence, fetching, jobs
from fieldkit.remote.command import quote
from fieldkit.remote.jobs import Job
from fieldkit.steps.scene import PutProgram
from fieldkit.trial.plan import Plan


def print_commands(plan: Plan) -> None:
    """Print the commands of one repeat per protocol, in order, grouped by robot.

    Jobs are shown as a person would type them; `job.sh` runs them detached.
    """
    each = f"{format_count(plan.repeats, 'repeat')} per protocol"
    say(f"# procedure {plan.procedure.name}, {plan.distance}, {plan.topology}; {each}")
    for remark in _remarks(plan):
        say(f"# {remark}")
    planned = list(_commands(plan))
    for protocol in plan.protocols:
        for role, robot in plan.cast.items():
            mine = [command for command in planned if (command.protocol, command.role) == (protocol, role)]
            say(f"\n## {protocol}: {robot.name} ({role}, {robot.address}), in {_folder(plan, protocol)}")
            if not mine:
                say("nothing but the checks before repeat 1")
            for command in mine:
                say(f"{command.number}. {command.name}: {command.command}")


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
    for line in plan.dry_run_notes(plan.scene(RepeatId(plan.protocols[0], 1), "")):
        yield f"while steps run: {line}"


def _folder(plan: Plan, protocol: Protocol) -> str:
    return jobs.work_folder(plan.trial, f"{protocol}-01-1")


def _commands(plan: Plan) -> Iterator[CommandPlanned]:
    """Yield the commands of one repeat per protocol, robot by robot; a role that no step names has none."""
    for protocol in plan.protocols:
        folder = _folder(plan, protocol)
        scene = plan.scene(RepeatId(protocol, 1), folder)
        everybodys = list(plan.jobs(scene))
        for role, robot in scene.cast.items():
            if role not in plan.procedure.roles():
                continue
            where = (scene.folder, role, robot.profile.radio.interface)
            mine = [
                (0, "begin", quote(evidence.begin_command(*where))),
                *((0, "put", _copying(put, robot, folder)) for put in plan.puts() if put.role is role),
                *(
                    (number, planned.job.name, in_shell(planned.job))
                    for number, planned in enumerate(everybodys, start=1)
                    if planned.role is role
                ),
                (len(everybodys) + 1, "pack", quote(fetching.pack_command(*where))),
            ]
            for number, name, command in mine:
                yield CommandPlanned(protocol, robot.name, role, folder, number, name, command)


def _copying(put: PutProgram, robot: Robot, folder: str) -> str:
    """Return how a person would copy a program of the lab to a robot, once its folder there is made."""
    words = ("scp", "-p", put.program.file, f"{robot.address}:{folder}/{put.at}")
    return f"{quote(words)}  # SHA-256 {put.program.sha256}"


def in_shell(job: Job) -> str:
    """Return a job's command as a person would type it in its folder."""
    text = quote((("sudo", "-n") if job.as_root else ()) + job.argv)
    text += f" < {quote((job.stdin,))}" if job.stdin else ""
    text += (f" > {quote((job.stdout,))}" if job.stdout else "") + f" 2> {quote((job.log,))}"
    return text + (f"  # at most {job.output_limit_bytes} bytes of each" if job.output_limit_bytes else "")
