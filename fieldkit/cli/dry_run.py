"""`fieldkit trial --dry-run`: every remote command, robot by robot, as the steps would start it."""

from fieldkit.core.model import RepeatId
from fieldkit.remote import evidence, jobs
from fieldkit.remote.command import quote
from fieldkit.remote.jobs import Job
from fieldkit.trial.plan import Plan


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
