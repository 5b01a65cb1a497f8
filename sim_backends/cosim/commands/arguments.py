"""What `fieldkit cosim` and its commands take. Nothing here imports what a command runs."""

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, Final

from fieldkit.cli.arguments import natural, repeats
from fieldkit.cli.parser import Commands, Parser

_HERE: Final = "sim_backends.cosim.commands"
_FORMATS: Final = ("table", "csv", "json", "markdown")


def add(parser: Parser) -> None:
    """Declare the commands of `fieldkit cosim`."""
    parser.description = "Simulate robots that move and talk, and measure what each synchronization method costs."
    parser.epilog = "example: fieldkit cosim run baylands --policy sliding_window"
    commands = parser.add_commands(title="commands", metavar="COMMAND")
    _run(commands)
    _list(commands)
    _schema(commands)


def _run(commands: Commands) -> None:
    parser: Parser = commands.add_parser(
        "run",
        help="run a scenario",
        description="Run a scenario with one sync policy, and tell of each flow of packets what became of it.",
        epilog="example: fieldkit cosim run baylands --seeds 20 --out runs/baylands",
    )
    _add_scenario(parser)
    _completed(
        parser.add_argument("--policy", metavar="NAME", help="sync policy (default: the scenario's)"), _policy_names
    )
    seeds = parser.add_mutually_exclusive_group()
    seeds.add_argument(
        "--seed",
        type=natural,
        metavar="N",
        help="seed of everything random (default: the scenario's first)",
    )
    seeds.add_argument("--seeds", type=repeats, metavar="N", help="run it N times, with seeds 1 to N")
    parser.add_argument(
        "--out",
        type=Path,
        metavar="FOLDER",
        help="keep the recordings and trial.csv there; it is made (default: none)",
    )
    _add_format(parser)
    parser.set_defaults(run=f"{_HERE}.run:run")


def _list(commands: Commands) -> None:
    parser: Parser = commands.add_parser(
        "list", help="list scenarios and sync policies", description="List every scenario and sync policy."
    )
    parser.set_defaults(run=f"{_HERE}.listing:list_all")


def _schema(commands: Commands) -> None:
    parser: Parser = commands.add_parser(
        "schema",
        help="print the JSON schema of scenario files",
        description="Print the JSON schema of scenario files, by which editors complete and check them.",
    )
    parser.set_defaults(run=f"{_HERE}.listing:print_schema")


def _add_scenario(parser: Parser) -> None:
    """Add the scenario, and what of it is changed; `settings.scenario` reads both."""
    scenario = parser.add_argument(
        "scenario",
        metavar="SCENARIO",
        help="name of a scenario, see `fieldkit cosim list`, or a file ending in .yaml",
    )
    _completed(scenario, _scenario_names)
    parser.add_argument("--duration", metavar="TIME", help="how long it lasts, for example 30s")
    parser.add_argument("--window", metavar="TIME", help="window of the sync policy, for example 5ms")
    parser.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="KEY=VALUE",
        help="another value of its file, agents.husky-2.along=40m; may be given more than once",
    )


def _add_format(parser: Parser) -> None:
    parser.add_choice("--format", _FORMATS, default="table", help="how it is printed (default table)")


def _completed(action: Any, names: Callable[[], Iterable[str]]) -> None:  # noqa: ANN401 (argparse's own is generic)
    """Let the Tab key complete an argument by names that are looked for only then."""
    action.completer = lambda **_: list(names())


def _scenario_names() -> Iterable[str]:
    from sim_backends.cosim.scenario.loading import scenario_files  # noqa: PLC0415 (pydantic)

    return [*scenario_files(), *map(str, Path().glob("*.yaml"))]


def _policy_names() -> Iterable[str]:
    from sim_backends.cosim.scenario.policies import POLICIES  # noqa: PLC0415 (as above)

    return POLICIES
