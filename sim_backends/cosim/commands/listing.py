"""The commands `fieldkit cosim list` and `fieldkit cosim schema`."""

import argparse
from typing import Final

from fieldkit.cli.display import print_table, show_note
from fieldkit.core.errors import FieldkitError
from fieldkit.core.text import json_text, print_text
from sim_backends.cosim.commands.sheets import Sheet, SheetColumn, SheetPart, show_all
from sim_backends.cosim.policies.registry import policies
from sim_backends.cosim.scenario.external import simulators
from sim_backends.cosim.scenario.loading import editor_schema, load_scenario, scenario_files

_SCENARIO: Final = (SheetColumn("scenario", "scenario", ""), SheetColumn("summary", "summary", ""))
_SIMULATOR: Final = (
    SheetColumn("simulator", "simulator", ""),
    SheetColumn("role", "role", ""),
    SheetColumn("summary", "summary", ""),
)
_POLICY: Final = (SheetColumn("policy", "policy", ""), SheetColumn("summary", "what it does", ""))


def list_all(arguments: argparse.Namespace) -> int:
    """Print each scenario, each simulator and each sync policy, one per line."""
    scenario_rows = []
    for name, path in scenario_files().items():
        try:
            scenario_rows.append((name, load_scenario(path).summary))
        except FieldkitError as error:
            show_note(f"{error.located}: this scenario is omitted")
    policy_rows = []
    for name in policies():
        try:
            policy_rows.append((name, _summary(policies()[name])))
        except FieldkitError as error:
            show_note(f"{error.located}: this sync policy is omitted")
    simulator_rows = simulators()
    if arguments.format == "table":
        print_table([column.head for column in _SCENARIO], scenario_rows)
        print_table([column.head for column in _SIMULATOR], simulator_rows)
        print_table([column.head for column in _POLICY], policy_rows)
        return 0
    sheets = {
        "scenarios": Sheet(_SCENARIO, scenario_rows, [SheetPart("scenarios", ("scenario", "summary"))]),
        "simulators": Sheet(_SIMULATOR, simulator_rows, [SheetPart("simulators", ("simulator", "role", "summary"))]),
        "policies": Sheet(_POLICY, policy_rows, [SheetPart("sync policies", ("policy", "summary"))]),
    }
    show_all(sheets, arguments.format)
    return 0


def print_schema(_: argparse.Namespace) -> int:
    """Print the JSON schema of scenario files."""
    print_text(json_text(editor_schema(), indent=2))
    return 0


def _summary(policy: object) -> str:
    return (policy.__doc__ or "").partition("\n")[0].strip()
