"""Arguments that several commands of `fieldkit cosim` share, and the names that complete them."""

from collections.abc import Callable, Iterable
from functools import partial
from pathlib import Path
from typing import Any, Final

from fieldkit.cli.parser import Parser
from fieldkit.cli.shared_arguments import TABLES, natural, repeats

RECORDING_HELP: Final = "folder that `fieldkit cosim run --out` made"


def add_scenario(parser: Parser) -> None:
    """Add the scenario and the options that change it; `settings.read_scenario` reads both."""
    scenario = parser.add_argument(
        "scenario",
        metavar="SCENARIO",
        help="name of a scenario, see `fieldkit cosim list`, or a file ending in .yaml",
    )
    _set_completer(scenario, _scenario_names)
    parser.add_argument("--duration", metavar="TIME", help="duration of the simulation, for example 30s")
    add_changes(parser)


def add_changes(
    parser: Parser, meaning: str = "change a value of the scenario's file, for example agents.husky-2.along=40m"
) -> None:
    """Add `--set`; `meaning` describes what it changes."""
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help=f"{meaning}; may be repeated")


def add_recording(parser: Parser, meaning: str = RECORDING_HELP) -> None:
    """Add the folder of a recording; `meaning` is its help."""
    parser.add_argument("recording", type=Path, metavar="RECORDING", help=meaning)


def add_federates(parser: Parser) -> None:
    """Add `--physics` and `--network`."""
    for role in ("physics", "network"):
        action = parser.add_argument(
            f"--{role}",
            metavar="FEDERATE",
            help=f"{role}: a simulator of `fieldkit cosim list`, a command, or an address of tcp, udp, dds or ros1 "
            "(addresses: fieldkit docs federates; default: the scenario's)",
        )
        _set_completer(action, partial(_federate_names, role))


def add_policy(parser: Parser, meaning: str, **options: Any) -> None:  # noqa: ANN401 (options of argparse)
    """Add `--policy`; `meaning` is its help, and `options` are passed to argparse."""
    _set_completer(parser.add_argument("--policy", metavar="NAME", help=meaning, **options), _policy_names)


def add_window(parser: Parser, meaning: str, **options: Any) -> None:  # noqa: ANN401 (options of argparse)
    """Add `--window`; `meaning` is its help without the default, and `options` replace those of argparse."""
    parser.add_argument("--window", **{"metavar": "TIME", "help": f"{meaning} (default: the scenario's)", **options})


def add_seed(parser: Any, default: str) -> None:  # noqa: ANN401 (a parser or a group of arguments)
    """Add `--seed`; `default` describes the seed without it."""
    parser.add_argument("--seed", type=natural, metavar="N", help=f"seed of all random draws (default: {default})")


def add_seeds(parser: Parser) -> None:
    """Add `--seed` and `--seeds`, of which only one may be given."""
    seeds = parser.add_mutually_exclusive_group()
    add_seed(seeds, "all seeds of the scenario")
    seeds.add_argument("--seeds", type=repeats, metavar="N", help="run the scenario N times, with seeds 1 to N")


def add_format(parser: Parser) -> None:
    """Add `--format`, the output format of a table."""
    parser.add_choice("--format", TABLES, default="table", help="output format (default table)")


def _set_completer(action: Any, names: Callable[[], Iterable[str]]) -> None:  # noqa: ANN401 (argparse's is generic)
    """Complete an argument with names that are determined when the Tab key is pressed."""
    action.completer = lambda **_: list(names())


def _scenario_names() -> Iterable[str]:
    from sim_backends.cosim.scenario.loading import scenario_files  # noqa: PLC0415 (importing pydantic is slow)

    return [*scenario_files(), *map(str, Path().glob("*.yaml"))]


def _policy_names() -> Iterable[str]:
    from sim_backends.cosim.policies.registry import policies  # noqa: PLC0415 (importing pydantic is slow)

    return policies()


def _federate_names(role: str) -> Iterable[str]:
    from sim_backends.cosim.scenario.external import simulators  # noqa: PLC0415 (importing pydantic is slow)

    return [simulator.name for simulator in simulators() if simulator.role == role]
