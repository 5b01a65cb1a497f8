"""Items that are run with both commits, and the laboratory folder for them."""

import json
import shutil
import subprocess
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Final

from benchmarks.unchanged import recorder
from benchmarks.unchanged.trees import ROOT, Tree, python

LAB: Final = Path(__file__).parent / "lab"
"""Procedures and robot profiles of the proof, in addition to those that ship."""

STORED: Final = ROOT / "tests" / "data" / "fieldkit"
BAGS: Final = ROOT / "tests" / "data" / "rosbag" / "1.15.15"


class ItemKind(StrEnum):
    """A kind of items; the report has a line for each."""

    TABLES = "tables of stored trials"
    REPORTS = "reports of stored trials"
    EXPORTS = "exports of stored trials"
    DRY_RUNS = "dry-run commands"
    COMMAND_LINES = "command lines with errors and events"
    HELP = "help texts"
    SIMULATIONS = "event hashes of simulations"
    TRIALS = "emulated trials"


@dataclass(frozen=True)
class Simulation:
    """A simulation: names of scenario and policy, seed, and end time."""

    scenario: str
    policy: str
    seed: int
    until_ns: int


@dataclass(frozen=True)
class Item:
    """A command, or a simulation.

    Attributes:
        kind: Its kind.
        arguments: The words after `fieldkit` on the command line.
        working_folder: Relative to the laboratory folder.
        outputs: Files and folders that it creates or changes there; they are moved or copied to the results.
        simulation: The simulation; then there are no arguments.
        succeeds: True if it must succeed with the base, because the outputs of a failed command prove nothing.
        counts_lines: True to count the lines of imported modules after the item, which must then run first.
    """

    kind: ItemKind
    arguments: tuple[str, ...] = ()
    working_folder: str = "."
    outputs: tuple[str, ...] = ()
    simulation: Simulation | None = None
    succeeds: bool = True
    counts_lines: bool = False

    def __str__(self) -> str:
        if self.simulation is not None:
            return f"{self.simulation.scenario}, {self.simulation.policy}, seed {self.simulation.seed}"
        return f"{self.working_folder}: fieldkit {' '.join(self.arguments)}"


# Robots -------------------------------------------------------------------------------------------------------------

ROLES: Final = ("sender", "receiver", "relay", "first", "middle", "left", "last", "rover2", "rover3", "rover4")
KEY: Final = "ssh-ed25519 AAAAC3NzaC1lZDI1NTE5AAAAIJcfoHM2b/TjeUycyd/kMkG5id0whvOnW10xYBLAo4SR"
SHARED_MASTER: Final = "ros_master: relay\n"


def site(profile: str, *, field: bool = False, more: str = "") -> str:
    """Return a site file with a robot of a profile for each role, in both topologies."""
    lines = [f"backend: {'field' if field else 'emulated'}", "robots:"]
    for number, _ in enumerate(ROLES, 1):
        host = f", host: 192.0.2.{number}, address: 198.51.100.{number}, user: pi, host_key: {KEY}" if field else ""
        lines.append(f"  robot-{number}: {{profile: {profile}{host}}}")
    roles = ", ".join(f"{role}: robot-{number}" for number, role in enumerate(ROLES, 1))
    lines += ["roles:", f"  master: {{{roles}}}", f"  masterless: {{{roles}}}"]
    return "\n".join(lines) + "\n" + more


def shipped(tree: Tree, kind: str) -> list[str]:
    """Return the names of the robots or procedures that ship with a tree."""
    return sorted(path.stem for path in (tree.code / kind).glob("*.yaml"))


def proof_names(kind: str) -> list[str]:
    """Return the names of the robots or procedures of the proof."""
    return sorted(path.stem for path in (LAB / kind).glob("*.yaml"))


# Wrong files: name of the folder, changed file, replaced text, and new text.
WRONG: Final = (
    ("key-typo", "fieldkit.yaml", "robots:", "robotz:"),
    ("key-missing", "fieldkit.yaml", "{profile: husky}", "{}"),
    ("key-twice", "fieldkit.yaml", "roles:", "backend: emulated\nroles:"),
    ("profile-unknown", "fieldkit.yaml", "{profile: husky}", "{profile: huskey}"),
    ("robot-unknown", "fieldkit.yaml", "sender: robot-1", "sender: robot-99"),
    ("robot-in-two-roles", "fieldkit.yaml", "receiver: robot-2", "receiver: robot-1"),
    ("broken-line", "fieldkit.yaml", "robots:", "robots: ["),
    ("alias", "fieldkit.yaml", "backend: emulated", "backend: *field"),
    ("tag", "fieldkit.yaml", "backend: emulated", "backend: !radio x"),
    ("tab", "fieldkit.yaml", "  robot-2:", "\trobot-2:"),
    ("option-unknown", "fieldkit.yaml", "backend: emulated", "backend: emulated\nemulated: {radio: {los: 10%}}"),
    ("share-without-sign", "fieldkit.yaml", "backend: emulated", "backend: emulated\nemulated: {radio: {loss: 0.1}}"),
    ("world-unknown", "fieldkit.yaml", "backend: emulated", "backend: emulated\nemulated: {world: lwn}"),
    ("port-in-quotes", "fieldkit.yaml", "{profile: husky}", "{profile: husky, port: '22'}"),
    ("host-missing", "fieldkit.yaml", "backend: emulated", "backend: field"),
    ("step-unknown", "procedures/los.yaml", "  - ping:", "  - pong:"),
    ("role-unknown", "procedures/los.yaml", "{robot: sender", "{robot: senderr"),
    ("payload-too-large", "procedures/los.yaml", "udp: 8192", "udp: 65508"),
    ("name-twice", "procedures/los.yaml", "during:", "during:\n        - ping: {from: sender, to: receiver}"),
    ("capture-twice", "procedures/los.yaml", "robots: [sender, receiver]", "robots: [sender, sender]"),
    ("file-twice", "procedures/los.yaml", "into: recv.bag", "into: scan.bag"),
    ("rate-without-unit", "robots/husky.yaml", "rate: 50Hz", "rate: 50"),
    ("profile-misnamed", "robots/husky.yaml", "name: husky", "name: huskie"),
    ("topics-missing", "robots/husky.yaml", '"{topics}"]', "]"),
)

COMMAND_LINES: Final = """\
trial los 30
trial los 30feet
trial los 0m
trial los -5m
trial los 30ft --record 2
trial los 30ft --record 0s
trial lso 30ft
trial los
trial los 30ft --repeats 0
trial los 30ft --repeats many
trial los 30ft --seed -1
trial los 30ft --protocol sctp
trial los 30ft --toplogy master
trial los 30ft --topology mesh
trial los 30ft --backend emulatd
trial los 30ft --backend field
trial los 30ft --site nope.yaml
trial los 30ft --out /proc/trials
trial los 30ft --answers nope.txt
trial los 30ft 40ft --topology masterless --protocol udp --repeats 3 --record 2s --seed 9 --dry-run
campaign campaign.yaml --dry-run
campaign campaign.yaml --dry-run --json
campaign nope.yaml
robots
robots show husky
robots show huskie
procedures
procedures show los
procedures show loss
columns
columns los
columns show ip_loss
columns show iploss
check --record -2s
check los --backend field
rebuild .
rebuild a b
resume nowhere
verify .
aggregate nowhere
aggregate .
aggregate trials --by distanse
aggregate trials --quantity ip_los
aggregate trials --width 2
compare trials nowhere
export trials --format parket -o out.parquet
export trials --format csv -o there/out.csv
report trials -o there/report.html
report trials --repeat udp-77
positions nowhere
bag info nope.bag
bridge --from ros1 --to dds /scan:sensor_msgs/LasrScan
middleware recommend trials -o configuration
lab ps
lab up --robots 0
lab mvoe
lab plot -o lab.gif
enroll robot-99
completion bash
completion zsh
completion fish
completion ksh
cosim list
cosim schema
cosim run nowhere
cosim run baylands --policy nothing
cosim run baylands --set agents.nobody.along=4m
cosim run baylands --duration 1s --seed 3 --format markdown
cosim run field_30ft --duration 500ms --seeds 2 --format json
cosim run convoy --duration 1s --format csv
cosim table nothing
nothing
--version
"""
"""Valid and wrong command lines, in a folder with the stored trials in `trials`."""

SIMULATED_NS: Final = 1_000_000_000
SEEDS: Final = 3


def prepare(tree: Tree) -> None:
    """Make the laboratory folder of a tree."""
    shutil.copytree(LAB, tree.lab)
    shutil.copytree(STORED / "4" / "trials", tree.lab / "trials")
    shutil.copytree(STORED / "evidence", tree.lab / "trials", dirs_exist_ok=True)
    for version in ("1", "2", "3", "4"):
        (tree.lab / "old" / version).mkdir(parents=True)
        shutil.copy(STORED / version / "trial.csv", tree.lab / "old" / version)
    shutil.copytree(BAGS, tree.lab / "bags")
    for name in ("empty", "emulated"):
        (tree.lab / name).mkdir()
    for profile in (*shipped(tree, "robots"), *proof_names("robots")):
        _site_folder(tree, profile, site(profile))
        _site_folder(tree, f"{profile}-field", site(profile, field=True))
        _site_folder(tree, f"{profile}-master", site(profile, more=SHARED_MASTER))
    for name, file, old, new in WRONG:
        folder = tree.lab / f"wrong-{name}"
        (folder / file).parent.mkdir(parents=True)
        (folder / "fieldkit.yaml").write_text(site("husky"), encoding="utf-8")
        if file != "fieldkit.yaml":
            shutil.copy(ROOT / file, folder / file)
        text = (folder / file).read_text(encoding="utf-8")
        if old not in text:
            raise ValueError(f"{file} no longer contains {old!r}")
        (folder / file).write_text(text.replace(old, new, 1), encoding="utf-8")


def _site_folder(tree: Tree, name: str, text: str) -> None:
    folder = tree.lab / name
    folder.mkdir()
    for kind in ("robots", "procedures"):
        (folder / kind).symlink_to(tree.lab / kind)
    (folder / "fieldkit.yaml").write_text(text, encoding="utf-8")


def items(base: Tree, kinds: Sequence[ItemKind]) -> list[Item]:
    """Return the items of some kinds; they depend on the files that ship with the base."""
    makers: dict[ItemKind, Callable[[Tree], Iterable[Item]]] = {
        ItemKind.TRIALS: _trial,  # first: it counts the lines of imported modules
        ItemKind.TABLES: _tables,
        ItemKind.REPORTS: _reports,
        ItemKind.EXPORTS: _exports,
        ItemKind.DRY_RUNS: _dry_runs,
        ItemKind.COMMAND_LINES: _command_lines,
        ItemKind.HELP: _help,
        ItemKind.SIMULATIONS: _simulations,
    }
    return [item for kind, make in makers.items() if kind in kinds for item in make(base)]


def _trial(_: Tree) -> Iterator[Item]:
    words = ("trial", "los", "30ft", "--repeats", "1", "--record", "1s", "--seed", "3", "--yes", "--json")
    yield Item(ItemKind.TRIALS, words, "emulated", ("trials",), counts_lines=True)


def _trials(tree: Tree) -> list[str]:
    return sorted(f"trials/{path.name}" for path in (tree.lab / "trials").iterdir())


def _tables(tree: Tree) -> Iterator[Item]:
    trials = _trials(tree)
    old_tables = [f"old/{version}/trial.csv" for version in ("1", "2", "3", "4")]
    for trial in trials:
        for name in ("trial.csv", "summary.csv"):
            yield Item(ItemKind.TABLES, ("rebuild", trial), outputs=(f"{trial}/{name}",))
        yield Item(ItemKind.TABLES, ("verify", trial))
    for form in ("table", "csv", "json", "markdown", "latex"):
        yield Item(ItemKind.TABLES, ("aggregate", "trials", "--format", form))
        if form != "latex":
            yield Item(ItemKind.TABLES, ("aggregate", "trials", "--all", "--format", form))
            yield Item(ItemKind.TABLES, ("compare", *_comparable(trials), "--force", "--format", form))
    for old in old_tables:
        yield Item(ItemKind.TABLES, ("aggregate", old, "--all", "--format", "csv"))
    for trial in trials:
        yield Item(ItemKind.TABLES, ("positions", trial))


def _comparable(trials: Sequence[str]) -> list[str]:
    return [trial for trial in trials if "_los_" in trial][:2]


def _reports(tree: Tree) -> Iterator[Item]:
    for paths in (["trials"], *([trial] for trial in _trials(tree))):
        yield Item(ItemKind.REPORTS, ("report", *paths, "-o", "report.html"), outputs=("report.html",))
    yield Item(
        ItemKind.REPORTS,
        ("report", "trials", "-o", "report.html", "--figures", "figures"),
        outputs=("report.html", "figures"),
    )


def _exports(tree: Tree) -> Iterator[Item]:
    for form in ("csv", "parquet", "junit"):
        yield Item(ItemKind.EXPORTS, ("export", "trials", "--format", form, "-o", "out"), outputs=("out",))
    rebuilt = ("export", "trials", "--rebuild", "--format", "csv", "-o", "out")
    yield Item(ItemKind.EXPORTS, rebuilt, outputs=("out",))
    for trial in _trials(tree):
        yield Item(ItemKind.EXPORTS, ("export", trial, "--format", "mcap", "-o", "out"), outputs=("out",))


def _dry_runs(tree: Tree) -> Iterator[Item]:
    for profile in (*shipped(tree, "robots"), *proof_names("robots")):
        for procedure in (*shipped(tree, "procedures"), *proof_names("procedures")):
            words = ("trial", procedure, "30ft", "--dry-run", "--json")
            yield Item(ItemKind.DRY_RUNS, words, profile, succeeds=False)
            yield Item(ItemKind.DRY_RUNS, (*words, "--allow-motion"), f"{profile}-field", succeeds=False)
            if "master" in procedure:
                yield Item(ItemKind.DRY_RUNS, words, f"{profile}-master", succeeds=False)


def _command_lines(_: Tree) -> Iterator[Item]:
    for line in COMMAND_LINES.splitlines():
        yield Item(ItemKind.COMMAND_LINES, tuple(line.split()), succeeds=False)
    for bag in sorted(BAGS.glob("*.bag")):
        for verb in ("info", "check"):
            yield Item(ItemKind.COMMAND_LINES, ("bag", verb, f"bags/{bag.name}"), succeeds=False)
    for words in (("trial", "los", "30ft", "--dry-run"), ("init",), ("robots",), ("check", "--backend", "field")):
        yield Item(ItemKind.COMMAND_LINES, words, "empty", ("fieldkit.yaml",), succeeds=False)
    for name, _file, _old, _new in WRONG:
        yield Item(ItemKind.COMMAND_LINES, ("trial", "los", "30ft", "--dry-run"), f"wrong-{name}", succeeds=False)


def _help(tree: Tree) -> Iterator[Item]:
    """Yield the help of each command, and of the commands inside of commands."""
    for command in json.loads(_output(tree, recorder.__file__, "--commands")):
        yield Item(ItemKind.HELP, (*command, "--help"))


def _output(tree: Tree, *words: str) -> str:
    """Return the output of Python in a tree."""
    return subprocess.run(
        (*python(), *words), env=tree.environment(), cwd=tree.lab, check=True, stdout=subprocess.PIPE, text=True
    ).stdout


def _simulations(tree: Tree) -> Iterator[Item]:
    listed = json.loads(_output(tree, "-m", "fieldkit", "cosim", "list", "--format", "json"))
    for scenario in listed["scenarios"]:
        for policy in listed["policies"]:
            for seed in range(1, SEEDS + 1):
                simulation = Simulation(scenario["scenario"], policy["policy"], seed, SIMULATED_NS)
                yield Item(ItemKind.SIMULATIONS, simulation=simulation)
