"""All reference pages."""

import inspect
from collections.abc import Callable, Iterator
from dataclasses import fields
from pathlib import Path
from typing import Final

from docs.generator.commands import commands
from docs.generator.cosim_protocols import cosim_protocols
from docs.generator.federate_frames import DESCRIPTION, WITHOUT_VECTOR, example_frames
from docs.generator.federate_protocol import federate_protocol
from docs.generator.markdown import page, relative, table
from docs.generator.models import HEAD, describe, keys_table, kinds, rows
from docs.generator.simulators import simulator_options
from docs.generator.step_columns import escaped, step_columns, table_rows
from fieldkit import cli
from fieldkit.analysis.quantities import DEFAULT_BY
from fieldkit.campaign.plan import CampaignFile
from fieldkit.config import loops
from fieldkit.config.documentation import attribute_meanings, class_description
from fieldkit.config.profiles import RobotProfile
from fieldkit.config.site import Site
from fieldkit.core import campaign_events, errors, events, sweep_events
from fieldkit.core.columns import Column
from fieldkit.core.model import MAX_STEPS
from fieldkit.core.result_rows import DifferenceRow, EstimateRow, declared_columns
from fieldkit.measure.transfers.fates import PACKET_COLUMNS
from fieldkit.pytest import plugin
from fieldkit.steps.base import Step, step_types
from fieldkit.steps.capabilities import CAPABILITIES
from fieldkit.trial.columns import installed_columns
from fieldkit.trial.procedure import Procedure
from sim_backends.cosim.recording.packet_tables import SCHEMAS
from sim_backends.cosim.scenario.agent_plans import MotionPlan, Traffic
from sim_backends.cosim.scenario.faults import Fault
from sim_backends.cosim.scenario.schema import CosimScenario
from sim_backends.emulated.emulated_options import EmulatedOptions
from sim_backends.world.materials import MATERIALS
from sim_backends.world.obstacles import Obstacle
from sim_backends.world.world import SHIPPED as WORLDS
from sim_backends.world.world import World

FOLDER: Final = Path(__file__).resolve().parents[1] / "reference"
_MARKS: Final = (
    "`[]` means each item of a list, `*` each name of a mapping. [Values](../values.md) describes quantities."
)


def pages() -> dict[str, str]:
    """Return the text of every reference page by its file name."""
    builders: dict[str, Callable[[], str]] = {
        "commands.md": commands,
        "exit-codes.md": exit_codes,
        "site-file.md": site_file,
        "robot-profile.md": lambda: page("Robot profile", describe(RobotProfile), _MARKS, keys_table(RobotProfile)),
        "procedure.md": procedure,
        "steps.md": steps,
        "step-capabilities.md": step_capabilities,
        "campaign-file.md": lambda: page("Campaign file", describe(CampaignFile), _MARKS, keys_table(CampaignFile)),
        "scenario-file.md": scenario_file,
        "simulator-options.md": simulator_options,
        "cosim-protocols.md": cosim_protocols,
        "recording-tables.md": recording_tables,
        "pytest-options.md": pytest_options,
        "columns.md": columns,
        "table-rows.md": table_rows,
        "events.md": json_events,
        "world-file.md": world_file,
        "federate-protocol.md": federate_protocol,
        "federate-vectors.md": federate_vectors,
    }
    return {"index.md": index()} | {name: build() for name, build in builders.items()}


def step_capabilities() -> str:
    """Return the page of capabilities of steps, from their classes."""
    lines = []
    for capability in CAPABILITIES:
        methods = ", ".join(
            f"`{name}`" for name in sorted(capability.__abstractmethods__, key=_position_in(capability))
        )
        meaning = class_description(capability).partition("\n\n")[0].replace("\n", " ")
        lines.append((f"`{capability.__name__}`", meaning, methods))
    return page(
        "Capabilities of steps",
        "A [kind of step](../add-a-procedure.md#add-a-kind-of-step) has a capability if its class defines the "
        "methods; `fieldkit/steps/capabilities.py` describes each method.",
        table(("capability", "step", "methods"), lines),
    )


def _position_in(capability: type) -> Callable[[str], int]:
    """Return a function that returns the position of a method in its class."""
    return list(vars(capability)).index


def federate_vectors() -> str:
    """Return the test vectors of the protocol of external federates."""
    frames = [(name, f"`{frame.hex()}`") for name, frame in example_frames().items() if name not in WITHOUT_VECTOR]
    return page("Test vectors of federates", DESCRIPTION, table(("message", "frame"), frames))


def index() -> str:
    """Return the first page of the reference."""
    entries = (
        ("[Commands](commands.md)", "every command with its arguments"),
        ("[Exit codes](exit-codes.md)", "exit codes of all commands"),
        ("[Site file](site-file.md)", "`fieldkit.yaml`: robots and roles of a lab"),
        ("[Robot profile](robot-profile.md)", "`robots/NAME.yaml`"),
        ("[Procedure](procedure.md)", "`procedures/NAME.yaml`"),
        ("[Steps](steps.md)", "the kinds of step of a procedure"),
        ("[Capabilities of steps](step-capabilities.md)", "optional methods of your own kind of step"),
        ("[Campaign file](campaign-file.md)", "the file of `fieldkit campaign`"),
        ("[Scenario file](scenario-file.md)", "`scenarios/NAME.yaml` of the co-simulation"),
        ("[Options of simulators](simulator-options.md)", "`physics.options` and `network.options` of a scenario"),
        ("[World file](world-file.md)", "`worlds/NAME.yaml` of emulated robots and of the co-simulation"),
        ("[Values in files](../values.md)", "quantities with units, YAML, expectations"),
        ("[Trial folder](../trial-folder.md)", "files of a trial"),
        ("[Options of pytest](pytest-options.md)", "options of the pytest plugin"),
        ("[Columns](columns.md)", "columns of `trial.csv`, `summary.csv` and comparisons"),
        ("[Rows of tables](table-rows.md)", "the column of each row that `trial`, `aggregate` and `report` print"),
        ("[Tables of a recording](recording-tables.md)", "packets, states and windows of a co-simulation"),
        (
            "[Classes of the co-simulation](cosim-protocols.md)",
            "for your own sync policy, physics or network simulator",
        ),
        ("[JSON events](events.md)", "output of `--json`"),
        ("[Rules and layouts of the federate protocol](federate-protocol.md)", "messages of external federates"),
        ("[Test vectors of federates](federate-vectors.md)", "frames of the protocol of external federates"),
        ("[Errors](../errors.md)", "messages and remedies"),
    )
    return page("Reference", table(("page", "content"), entries))


def exit_codes() -> str:
    """Return the page of exit codes, from the families of errors."""
    families: list[type[errors.FieldkitError]] = [errors.FieldkitError]
    for family in families:  # the list grows during the loop
        families += family.__subclasses__()
    meanings: dict[int, list[str]] = {}
    for family in families:
        if "exit_code" in vars(family) and family.__module__ == errors.__name__:
            meanings.setdefault(family.exit_code, []).append(class_description(family).partition("\n")[0])
    codes = {code: relative(" Or: ".join(texts)) for code, texts in meanings.items()} | dict(cli.EXIT_CODES)
    lines = ((str(code), meaning) for code, meaning in sorted(codes.items()))
    return page(
        "Exit codes",
        table(("code", "meaning"), lines),
        "An error message has three parts: what happened, where, and what to do about it (`remedy:`). "
        "[Errors](../errors.md) lists the messages.",
    )


def site_file() -> str:
    """Return the page of the site file, with the options of the emulated backend."""
    return page(
        "Site file",
        describe(Site),
        _MARKS,
        keys_table(Site),
        "## Emulated backend",
        describe(EmulatedOptions),
        keys_table(EmulatedOptions, "emulated."),
    )


def procedure() -> str:
    """Return the page of procedures, without the kinds of step."""
    return page(
        "Procedure",
        describe(Procedure),
        _MARKS,
        keys_table(Procedure),
        "## Keys of every step",
        table(HEAD, rows(Step)),
        "If a step has a `name`, the names of its jobs, its files and its columns begin with it: `up.listen`, "
        "`up.recv.bag`, `up.file_loss`. The `paper_*` columns of a transfer use the ping that has the same name. "
        "[Steps](steps.md) lists the kinds of step.",
        "## for",
        _dedented(loops.__doc__),
        table(
            HEAD,
            (
                ("`each`", "required", "Lists of values, texts or numbers, by variable."),
                ("`during`", "required", "Steps to repeat for each combination of values."),
            ),
        ),
        f"A file has at most {MAX_STEPS:,} steps after expansion.",
    )


def _dedented(docstring: str | None) -> str:
    return inspect.cleandoc(docstring or "")


def steps() -> str:
    """Return the page of the kinds of step that are part of fieldkit."""
    built_in = {kind: model for kind, model in step_types().items() if model.__module__.startswith("fieldkit.")}
    blocks = [
        (
            "This page lists the keys of each kind of step, in addition to those of [every "
            "step](procedure.md#keys-of-every-step). Packages can [add "
            f"kinds](../add-a-procedure.md#add-a-kind-of-step). {_MARKS}"
        ),
        table(
            ("step", "purpose"),
            ((f"[`{kind}`](#{kind})", _first_sentence(model)) for kind, model in built_in.items()),
        ),
    ]
    common = {row[0]: row for row in rows(Step)}
    for kind, model in built_in.items():
        keys = (row for row in rows(model) if row[0] not in common or row[1] != common[row[0]][1])
        blocks += [f"## {kind}", describe(model), table(HEAD, keys)]
    return page("Steps", *blocks)


def _first_sentence(model: type) -> str:
    return relative(class_description(model)).partition("\n")[0]


def scenario_file() -> str:
    """Return the page of scenario files of the co-simulation."""
    radio = frozenset({"radio."})
    blocks = ["## Keys", keys_table(CosimScenario, without=radio)]
    for title, union in {"Motion": MotionPlan, "Traffic": Traffic, "Fault": Fault}.items():
        for kind, model in kinds(union).items():
            blocks += [f"## {title}: {kind}", describe(model), keys_table(model)]
    return page("Scenario file", describe(CosimScenario), _MARKS, *blocks)


def world_file() -> str:
    """Return the page of world files, with a shipped one."""
    blocks = ["## Obstacles", f"`material` is one of {', '.join(f'`{name}`' for name in MATERIALS)}."]
    for kind, model in kinds(Obstacle).items():
        blocks += [f"### {kind}", describe(model), keys_table(model)]
    example = (WORLDS / "lawn.yaml").read_text(encoding="utf-8").strip()
    return page(
        "World file",
        describe(World),
        f"The shipped world `lawn`:\n\n```yaml\n{example}\n```",
        _MARKS,
        keys_table(World),
        *blocks,
    )


def pytest_options() -> str:
    """Return the page of the options of the pytest plugin."""
    lines = [
        (
            f"`--fieldkit-{name} {metavar}`",
            f"`fieldkit_{name}`",
            ", ".join(f"`{word}`" for word in choices or ()) or "any",
            text,
        )
        for name, (metavar, text, choices) in plugin.OPTIONS.items()
    ]
    return page(
        "Options of pytest",
        "Options and configuration keys that the [pytest plugin](../pytest.md) adds. A path in the configuration is "
        "relative to pytest's root folder.",
        table(("option", "key", "values", "meaning"), [*lines, ("`--fieldkit-yes`", "none", "none", plugin.YES)]),
    )


def recording_tables() -> str:
    """Return the page of the Parquet tables of a recorded co-simulation."""
    blocks = []
    for name, schema in SCHEMAS.items():
        lines = (
            (f"`{field.name}`", field.metadata[b"unit"].decode() or "none", field.metadata[b"meaning"].decode())
            for field in schema
        )
        blocks += [f"## {name}", table(("field", "unit", "meaning"), lines)]
    return page(
        "Tables of a recording",
        "Fields of the Parquet tables in a [recording](../cosim-commands.md#recordings) of the co-simulation.",
        *blocks,
    )


def columns() -> str:
    """Return the page of columns of `trial.csv`, `summary.csv` and comparisons."""
    trial = installed_columns()
    summary = (*(column for column in trial if column.name in DEFAULT_BY), *declared_columns(EstimateRow))
    files = {"trial.csv": trial, "summary.csv": summary, "fieldkit compare": declared_columns(DifferenceRow)}
    blocks = [
        (
            "`fieldkit columns` prints this list; `fieldkit columns PROCEDURE` prints those that a procedure fills. "
            "A missing value is empty, never 0. *Estimate* is the [estimate over several repeats]"
            "(../method-intervals.md#intervals). See also [trial folder](../trial-folder.md#columns)."
        ),
    ]
    for name, file_columns in files.items():
        blocks += [f"## {name}", table(("column", "unit", "estimate", "meaning"), _column_rows(file_columns))]
    blocks += ["## trial.csv with certain steps", "FLOW is the kind of step.", step_columns()]
    packets = ((f"`{column.name}`", column.unit, column.meaning) for column in PACKET_COLUMNS)
    blocks += [
        "## packets",
        "Columns of [`trials.packets`](../python-api.md#packets) in Python, besides `step`.",
        table(("column", "unit", "meaning"), packets),
    ]
    return page("Columns", *blocks)


def _column_rows(columns_of_file: tuple[Column, ...]) -> Iterator[tuple[str, str, str, str]]:
    for column in columns_of_file:
        figure = str(column.figure.kind) if column.figure else ""
        yield f"`{column.name}`", column.unit, figure, escaped(column.meaning)


def json_events() -> str:
    """Return the page of the events of `--json`."""
    blocks = [
        (
            "`fieldkit trial`, `resume`, `campaign`, `check`, `clocks` and `cosim sweep` with `--json` print one "
            "JSON object per line, with `event`, `utc_ns` and the fields below. [Automation](../automation.md) "
            "describes how a program answers requests."
        ),
    ]
    for record in _event_types():
        meanings = attribute_meanings(record)
        lines = ((f"`{field.name}`", meanings.get(field.name, "")) for field in fields(record))
        blocks += [f"## {_snake(record.__name__)}", class_description(record), table(("field", "meaning"), lines)]
    return page("JSON events", *blocks)


def _event_types() -> Iterator[type[events.Event]]:
    """Yield the types of events: of a trial, of a campaign, of a sweep, each in the order of their declarations."""
    for module in (events, campaign_events, sweep_events):
        for member in vars(module).values():
            is_declared = inspect.isclass(member) and member.__module__ == module.__name__
            if is_declared and issubclass(member, events.Event) and member is not events.Event:
                yield member


def _snake(name: str) -> str:
    return "".join(f"_{letter.lower()}" if letter.isupper() else letter for letter in name).lstrip("_")
