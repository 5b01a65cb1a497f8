"""The arguments of `fieldkit cosim` and its commands; modules that only a running command needs are not imported."""

from pathlib import Path
from typing import Final

from fieldkit.cli.parser import Commands, Parser
from fieldkit.cli.shared_arguments import add_jobs, add_json, add_workers, positive, repeats
from sim_backends.cosim.commands.scenario_arguments import (
    RECORDING_HELP,
    add_changes,
    add_federates,
    add_format,
    add_policy,
    add_recording,
    add_scenario,
    add_seed,
    add_seeds,
    add_window,
)

_PACKAGE: Final = "sim_backends.cosim.commands"
_TABLES: Final = ("1", "2", "3", "emane", "claims")


def add(parser: Parser) -> None:
    """Declare the commands of `fieldkit cosim`."""
    parser.description = (
        "Simulate robots that move and communicate; measure the error and the cost of each sync policy."
    )
    parser.epilog = "example: fieldkit cosim run baylands --policy sliding_window"
    commands = parser.add_commands(title="commands", metavar="COMMAND")
    _add_run(commands)
    _add_sweep(commands)
    _add_shootout(commands)
    _add_table(commands)
    _add_satisfy(commands)
    _add_goodput(commands)
    _add_plot(commands)
    _add_replay(commands)
    _add_conform(commands)
    _add_sdf(commands)
    _add_list(commands)
    _add_schema(commands)


def _add_run(commands: Commands) -> None:
    parser: Parser = commands.add_parser(
        "run",
        help="run a scenario",
        description="Run a scenario with one sync policy, and report the packets of each flow.",
        epilog="example: fieldkit cosim run baylands --seeds 20 --out runs/baylands",
    )
    add_scenario(parser)
    add_policy(parser, "sync policy (default: the scenario's)")
    add_window(parser, "window of the sync policy")
    add_seeds(parser)
    add_jobs(parser)
    add_federates(parser)
    parser.add_argument(
        "--emane-events",
        metavar="GROUP:PORT",
        help="publish positions and path losses to EMANE, for example 224.1.2.8:45703",
    )
    parser.add_argument("--emane-device", metavar="NAME", help="network interface of these events")
    parser.add_argument(
        "--realtime",
        metavar="FACTOR",
        help="simulate this number of seconds per second of wall time, for example 1; several runs are then not "
        "parallel, and a run that is later than --late-bound has no results",
    )
    parser.add_argument(
        "--late-bound",
        metavar="TIME",
        help="with --realtime: largest permitted lateness of a window, in wall time (default 100ms)",
    )
    parser.add_argument(
        "--out",
        type=Path,
        metavar="FOLDER",
        help="write the recordings, a capture per robot and trial.csv to this new folder (default: none)",
    )
    parser.add_argument(
        "--deadline",
        metavar="TIME",
        help="longest wait for an answer of physics or network, in wall time (default 30s)",
    )
    add_format(parser)
    parser.set_defaults(run=f"{_PACKAGE}.run:run")


def _add_sweep(commands: Commands) -> None:
    parser: Parser = commands.add_parser(
        "sweep",
        help="run a scenario with all combinations of settings",
        description="Run a scenario with all combinations of settings and seeds, in parallel. Each result is a file "
        "in FOLDER; a sweep that was stopped continues with the same command.",
        epilog="example: fieldkit cosim sweep baylands --over policy=sliding_window,scheduled window=1ms,10ms "
        "distance=20m,40m --seeds 20 -o sweep",
    )
    add_scenario(parser)
    parser.add_argument(
        "--over",
        nargs="+",
        default=[],
        metavar="NAME=VALUE,...",
        help="settings with their values: policy, window, distance (between the ends of the first flow), physics, "
        "network, or a key of the scenario's file, for example radio.exponent=2,3",
    )
    add_seeds(parser)
    add_federates(parser)
    parser.add_argument(
        "-o",
        "--out",
        required=True,
        type=Path,
        metavar="FOLDER",
        help="folder of the sweep: a new folder, or the folder of a sweep to continue",
    )
    parser.add_argument(
        "--again", action="store_true", help="repeat all failed runs, not only those with attempts left"
    )
    add_workers(parser)
    add_json(parser)
    parser.set_defaults(run=f"{_PACKAGE}.sweep:run")


def _add_shootout(commands: Commands) -> None:
    parser: Parser = commands.add_parser(
        "shootout",
        help="measure the error and the cost of each sync policy",
        description="Run a scenario with every sync policy; report the error of each policy relative to the exact "
        "reference with the same seed, and the cost of the policy.",
        epilog="example: fieldkit cosim shootout baylands --window 1ms,10ms,100ms --figure shootout.svg",
    )
    add_scenario(parser)
    add_policy(parser, "sync policy; may be given more than once (default: all)", action="append", default=[])
    add_window(
        parser,
        "windows to compare",
        dest="windows",
        metavar="TIME,...",
        help="windows to compare (default: the scenario's; with --orders 1 to 100 ms); --bias uses only the shortest",
    )
    add_seeds(parser)
    add_federates(parser)
    modes = parser.add_mutually_exclusive_group()
    modes.add_argument("--bias", action="store_true", help="mean difference from the reference over seeds")
    modes.add_argument(
        "--orders",
        action="store_true",
        help="errors of single windows that begin in the state of the reference, and the order of each error",
    )
    modes.add_argument(
        "--bound",
        action="store_true",
        help="number of exchanges needed for the scenario's policy.bound, with error_bounded and with fixed windows",
    )
    parser.add_argument(
        "--figure",
        type=Path,
        metavar="FILE",
        help="draw error against cost, with --orders error against the window, with --bias the bias: SVG, PDF or PNG",
    )
    add_workers(parser)
    add_format(parser)
    parser.set_defaults(run=f"{_PACKAGE}.shootout:run")


def _add_table(commands: Commands) -> None:
    parser: Parser = commands.add_parser(
        "table",
        help="regenerate a table of the paper",
        description="Run the simulations of a table of the paper. Print each number of the paper next to the "
        "simulated number, with its interval and the result of the comparison.",
        epilog="example: fieldkit cosim table 1 --format markdown",
    )
    parser.add_choice(
        "which",
        _TABLES,
        metavar="TABLE",
        help="1, 2 or 3: tables of the paper's simulations; emane: its emulation; claims: its claims",
    )
    seeds = parser.add_mutually_exclusive_group()
    add_seed(seeds, "the seeds of --seeds")
    seeds.add_argument(
        "--seeds", type=repeats, default=20, metavar="N", help="run each row N times, with seeds 1 to N (default 20)"
    )
    add_changes(parser)
    add_workers(parser)
    add_format(parser)
    parser.set_defaults(run=f"{_PACKAGE}.table:run")


def _add_satisfy(commands: Commands) -> None:
    parser: Parser = commands.add_parser(
        "satisfy",
        help="run the paper's satisfaction loop, and report its effect",
        description="Run a scenario repeatedly, as the paper does, until the loss is accepted. Each round uses the "
        "window that the paper's rule computed in the previous round. Report the error of each round relative to the "
        "exact reference.",
        epilog="example: fieldkit cosim satisfy baylands --set agents.husky-2.along=60m --threshold 10%",
    )
    add_scenario(parser)
    parser.add_argument(
        "--threshold", required=True, metavar="SHARE", help="accepted loss, as a share of all packets: 10%%"
    )
    parser.add_choice(
        "--policy",
        ("velocity_aware_raw", "velocity_aware"),
        default="velocity_aware_raw",
        help="rule of the paper as printed (default), or corrected so that each window is positive",
    )
    add_window(parser, "window of the first round")
    parser.add_argument(
        "--rounds", type=repeats, default=20, metavar="N", help="largest number of rounds (default 20)"
    )
    add_seed(parser, "the first seed of the scenario")
    add_format(parser)
    parser.set_defaults(run=f"{_PACKAGE}.satisfy:run")


def _add_goodput(commands: Commands) -> None:
    parser: Parser = commands.add_parser(
        "goodput",
        help="predict the goodput of logged Wi-Fi links",
        description="Predict the goodput of the Wi-Fi links in LOG, a CSV file with a row per link. Its columns are "
        "signal_dbm and, if known, standard, width_mhz, streams, guard_interval_ns, mcs or phy_rate_bit_s, protocol, "
        "and goodput_bit_s, the measured goodput.",
        epilog="example: fieldkit cosim goodput links.csv --format csv",
    )
    parser.add_argument("log", type=Path, metavar="LOG", help="the CSV file")
    add_changes(parser, "change a value of the scenario that simulates a link, for example radio.queue_packets=100")
    add_workers(parser)
    add_format(parser)
    parser.set_defaults(run=f"{_PACKAGE}.goodput:run")


def _add_plot(commands: Commands) -> None:
    parser: Parser = commands.add_parser(
        "plot",
        help="draw a recording, or the table of a shootout",
        description="Draw a recording: the paths of its agents from above, and delay, loss and distance over time. "
        "Or draw the CSV table of `fieldkit cosim shootout`: errors against cost.",
        epilog="example: fieldkit cosim plot runs/baylands --out baylands.pdf",
    )
    add_recording(parser, f"{RECORDING_HELP}, or CSV table of a shootout")
    parser.add_argument(
        "-o", "--out", type=Path, default=Path("run.svg"), metavar="FILE", help="SVG, PDF or PNG (default run.svg)"
    )
    parser.set_defaults(run=f"{_PACKAGE}.plot:run")


def _add_replay(commands: Commands) -> None:
    parser: Parser = commands.add_parser(
        "replay",
        help="print the results of a recording",
        description="Print the results of a recorded run; a recording that was changed or truncated is an error.",
    )
    add_recording(parser)
    parser.add_argument("--mcap", type=Path, metavar="FILE", help="also write the recording as MCAP, for Foxglove")
    add_format(parser)
    parser.set_defaults(run=f"{_PACKAGE}.replay:run")


def _add_conform(commands: Commands) -> None:
    parser: Parser = commands.add_parser(
        "conform",
        help="check an external federate",
        description="Start an external physics or network simulator, check that it follows the protocol, and print "
        "each failure with the request and the answer. Exit code 1 if a check failed.",
        epilog="example: fieldkit cosim conform 'python3 carts.py'",
    )
    parser.add_argument(
        "federate",
        nargs="+",
        metavar="COMMAND",
        help="command that starts the federate, as one word or after --; or its address (fieldkit docs federates)",
    )
    parser.add_choice(
        "--role", ("physics", "network"), help="role of the federate (default: the first that it accepts)"
    )
    parser.add_argument(
        "--scenario", default="convoy", metavar="SCENARIO", help="scenario for the checks (default convoy)"
    )
    add_changes(parser)
    parser.add_argument(
        "--windows",
        type=positive,
        default=2000,
        metavar="N",
        help="number of windows in the check for drift (default 2000)",
    )
    parser.add_argument("--deadline", metavar="TIME", help="longest wait for an answer, in wall time (default 30s)")
    parser.add_choice("--format", ("table", "json"), default="table", help="output format (default table)")
    parser.set_defaults(run=f"{_PACKAGE}.conform:run")


def _add_sdf(commands: Commands) -> None:
    parser: Parser = commands.add_parser(
        "sdf",
        help="print the world of a scenario for Gazebo",
        description="Print the world of a scenario and its robots as SDF, for --physics gazebo.",
        epilog="example: fieldkit cosim sdf convoy > convoy.sdf",
    )
    add_scenario(parser)
    parser.add_choice(
        "--gazebo",
        ("fortress", "garden"),
        default="fortress",
        help="version of Gazebo for which the plugins are named: fortress (default), or garden for Garden and later",
    )
    parser.set_defaults(run=f"{_PACKAGE}.sdf:run")


def _add_list(commands: Commands) -> None:
    parser: Parser = commands.add_parser(
        "list",
        help="list scenarios, simulators and sync policies",
        description="List every scenario, simulator and sync policy.",
    )
    add_format(parser)
    parser.set_defaults(run=f"{_PACKAGE}.listing:list_all")


def _add_schema(commands: Commands) -> None:
    parser: Parser = commands.add_parser(
        "schema",
        help="print the JSON schema of scenario files",
        description="Print the JSON schema of scenario files. Editors use it to complete and check these files.",
    )
    parser.set_defaults(run=f"{_PACKAGE}.listing:print_schema")
