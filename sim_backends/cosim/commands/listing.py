"""`fieldkit cosim list` and `fieldkit cosim schema`."""

import argparse
import json

from fieldkit.cli.display import show_note, table
from fieldkit.core.errors import FieldkitError
from sim_backends.cosim.scenario.loading import load_scenario, scenario_files
from sim_backends.cosim.scenario.policies import POLICIES
from sim_backends.cosim.scenario.schema import CosimScenario


def list_all(_: argparse.Namespace) -> int:
    """Print each scenario and each sync policy in a line."""
    scenarios = []
    for name, path in scenario_files().items():
        try:
            scenarios.append((name, load_scenario(path).summary))
        except FieldkitError as error:
            show_note(f"{error.located}: it is left out")
    table(("scenario", "summary"), scenarios)
    table(("policy", "what it does"), [(name, _summary(kind)) for name, kind in POLICIES.items()])
    return 0


def print_schema(_: argparse.Namespace) -> int:
    """Print the JSON schema of scenario files."""
    print(json.dumps(CosimScenario.model_json_schema(by_alias=True), indent=2))
    return 0


def _summary(kind: object) -> str:
    return (kind.__doc__ or "").partition("\n")[0].strip()
