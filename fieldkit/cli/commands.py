"""Every command with its help line and arguments. Nothing here imports what a command runs.

`run` of the parsed arguments names the function that runs the command: `trial:run` is `run` of `fieldkit.cli.trial`.
"""

import argparse
from pathlib import Path
from typing import Final

from fieldkit.cli import arguments
from fieldkit.cli.parser import Commands, Parser
from fieldkit.config.locations import SITE_FILE

TABLES: Final = ("table", "csv", "json", "markdown")
SHELLS: Final = ("bash", "zsh", "fish")
STORAGES: Final = ("mcap", "sqlite3")
DISTRIBUTIONS: Final = ("noetic", "foxy", "humble", "jazzy", "kilted")
"""`bags.contents.DISTRIBUTIONS`, which a test compares."""
MIDDLEWARES: Final = ("ros1", "dds", "zenoh")
"""`agent.middleware.ADAPTERS`, which a test compares."""
PAIRED_BY: Final = "scenario,topology,distance_m,protocol"
"""`analysis.compare.PAIRED_BY`, which a test compares."""

_COMPARE_EPILOG: Final = """\
delta (Cliff's) says how much the repeats of both overlap: of all pairs of one of A and
one of B, the share in which B is the larger less that in which it is the smaller. +1 or
-1: no overlap, however close; 0: each is the larger as often. `cliffs_delta` in CSV, JSON.

exit codes with --threshold: 0 if, in every cell in which A or B has the quantity,
the whole 95 % interval of B - A is within the threshold; 1 if it is not, or if one
of the two has no such cell, not the quantity, or no interval. Without: 0.

example: fieldkit compare field/ trials/ --threshold ip_loss=2% --threshold rtt_median_s=5ms"""


def add_all(commands: Commands) -> None:
    """Add every command, in the order in which the help lists them."""
    for add in (
        _init,
        _enroll,
        _check,
        _trial,
        _campaign,
        _resume,
        _abort,
        _lab,
        _aggregate,
        _compare,
        _report,
        _export,
        _bag,
        _bridge,
        _catalog,
        _positions,
        _rebuild,
        _verify,
        _completion,
    ):
        add(commands)


def _init(commands: Commands) -> None:
    parser: Parser = commands.add_parser(
        "init",
        help="write a commented site file",
        description="Write a site file in which every line is explained; a file that exists is not overwritten.",
    )
    parser.add_argument(
        "--out", type=Path, metavar="FILE", default=Path(SITE_FILE), help=f"the file (default: {SITE_FILE})"
    )
    parser.set_defaults(run="init:run")


def _enroll(commands: Commands) -> None:
    parser: Parser = commands.add_parser(
        "enroll",
        help="pin a robot's host key in the site file",
        description="Show the host key that a robot offers, and pin it in the site file once you compared it.",
    )
    parser.add_argument("robot", metavar="ROBOT", help="name of a robot in the site file")
    parser.add_argument(
        "--site", type=Path, metavar="FILE", default=Path(SITE_FILE), help=f"site file (default: {SITE_FILE})"
    )
    parser.add_argument("--yes", action="store_true", help="do not ask: the key was compared, or need not be")
    parser.add_argument("--replace", action="store_true", help="pin it also in place of another one")
    parser.set_defaults(run="enroll:run")


def _check(commands: Commands) -> None:
    parser: Parser = commands.add_parser(
        "check",
        help="look at everything that a trial needs",
        description="Look at everything that a trial needs of the robots and of this machine; change nothing.",
        epilog="example: fieldkit check los --topology masterless",
    )
    parser.add_argument("procedure", metavar="PROCEDURE", nargs="?", default="los", help="default: los")
    arguments.add_site(parser)
    arguments.add_changes(parser)
    arguments.add_json(parser)
    parser.set_defaults(run="check:run")


def _trial(commands: Commands) -> None:
    parser: Parser = commands.add_parser(
        "trial",
        help="run a procedure at one or more distances",
        description="Run a procedure: per protocol, so many repeats of record, capture, transfer and ping.",
        epilog="example: fieldkit trial los 30ft --repeats 3 --record 2s",
    )
    parser.add_argument("procedure", metavar="PROCEDURE", help="name of a procedure, see `fieldkit procedures`")
    parser.add_argument("distances", metavar="DISTANCE", nargs="+", help="with a unit, for example 30ft or 9.1m")
    arguments.add_site(parser)
    arguments.add_changes(parser)
    parser.add_argument(
        "--seed", type=arguments.natural, metavar="N", default=1, help="seed of everything random (default: 1)"
    )
    parser.add_argument(
        "--notes",
        type=arguments.free_text,
        metavar="TEXT",
        default="",
        help="kept with the trial: weather, place, people",
    )
    arguments.add_out(parser, "trial folders go")
    parser.add_argument("--dry-run", action="store_true", help="print every remote command per robot, touch nothing")
    arguments.add_json(parser)
    arguments.add_operator(parser)
    arguments.add_junit(parser)
    parser.set_defaults(run="trial:run")


def _campaign(commands: Commands) -> None:
    parser: Parser = commands.add_parser(
        "campaign",
        help="run the trials of a campaign file, or go on with them",
        description="Run the trials of a campaign file in a shuffled order. The same command goes on later.",
        epilog="example: fieldkit campaign lawn.yaml --dry-run",
    )
    parser.add_argument("file", type=Path, metavar="FILE", help="campaign file, see docs/campaign.md")
    arguments.add_site(parser)
    arguments.add_out(parser, "the campaign's folder goes")
    parser.add_argument("--dry-run", action="store_true", help="print order, way and time; touch nothing")
    arguments.add_json(parser)
    arguments.add_operator(parser)
    arguments.add_junit(parser)
    parser.set_defaults(run="campaign:run")


def _resume(commands: Commands) -> None:
    parser: Parser = commands.add_parser(
        "resume",
        help="go on with a trial that stopped",
        description="Go on with a trial that was interrupted, killed or cut off: nothing that is done is redone.",
    )
    arguments.add_trial(parser, "folder of the trial")
    arguments.add_site(parser)
    arguments.add_operator(parser)
    arguments.add_json(parser)
    arguments.add_junit(parser)
    parser.set_defaults(run="resume:run")


def _abort(commands: Commands) -> None:
    parser: Parser = commands.add_parser(
        "abort",
        help="end every job of fieldkit on the robots and break their locks",
        description="End every job that fieldkit started on any robot of the site file, whoever started it, and "
        "break the robots' locks. The trial that runs there stops, and says who aborted it.",
    )
    arguments.add_site(parser)
    parser.add_argument("--yes", action="store_true", help="do not ask")
    parser.set_defaults(run="abort:run")


def _lab(commands: Commands) -> None:
    parser: Parser = commands.add_parser(
        "lab",
        help="bring robots up on this machine to play with",
        description="Emulated robots that stay up until they are taken down: one lab per directory.",
    )
    actions = parser.add_commands(title="commands", metavar="COMMAND")
    up = actions.add_parser("up", help="bring the robots of the site file up, all in one place, or N alike")
    arguments.add_robots(up)
    up.add_argument("--seed", type=int, default=1, metavar="N", help="seed of everything random (default 1)")
    up.add_argument("--foreground", action="store_true", help="keep this terminal; Ctrl-C takes the robots down")
    up.set_defaults(run="lab:up")
    listing = actions.add_parser("ps", help="list the robots: where they are, what runs on them")
    listing.set_defaults(run="lab:list_robots")
    shell = actions.add_parser("shell", help="log in on a robot, or run a command there as ssh does")
    shell.add_argument("robot", metavar="ROBOT", help="name of the robot")
    shell.add_argument("command", nargs=argparse.REMAINDER, metavar="COMMAND", help="what its shell runs")
    shell.set_defaults(run="lab:shell")
    _lab_move(actions)
    config = actions.add_parser("ssh-config", help="print a configuration for ssh -F, scp -F, rsync and Ansible")
    config.set_defaults(run="lab:print_ssh_config")
    actions.add_parser("down", help="end the robots").set_defaults(run="lab:down")
    plot = actions.add_parser(
        "plot", help="draw the robots that are up, or would be, from above, and how well they hear each other"
    )
    arguments.add_robots(plot)
    plot.add_argument(
        "-o", "--out", type=Path, default=Path("lab.svg"), metavar="FILE", help="SVG, PDF or PNG (default lab.svg)"
    )
    plot.set_defaults(run="lab:plot")


def _lab_move(actions: Commands) -> None:
    parser: Parser = actions.add_parser(
        "move",
        help="put a robot elsewhere, at once",
        usage="%(prog)s [-h] ROBOT (--to EAST NORTH [UP] | --by EAST NORTH [UP])",
        description="Put a robot elsewhere, at once. Lengths have units (20m, -30ft) and are its antenna's.",
    )
    parser.takes_lengths = True
    parser.add_argument("robot", metavar="ROBOT", help="name of the robot")
    way = parser.add_mutually_exclusive_group(required=True)
    way.add_argument(
        "--to",
        nargs="+",
        type=str.strip,
        metavar="LENGTH",
        help="EAST NORTH [UP] in the world; on the ground without UP",
    )
    way.add_argument(
        "--by",
        nargs="+",
        type=str.strip,
        metavar="LENGTH",
        help="EAST NORTH [UP] from where it is, UP over the ground",
    )
    parser.set_defaults(run="lab:move")


def _aggregate(commands: Commands) -> None:
    parser: Parser = commands.add_parser(
        "aggregate",
        help="put the repeats of many trials together, with intervals",
        description="Put the repeats of any number of trials together, condition by condition, with 95 % intervals.",
        epilog="example: fieldkit aggregate trials --by distance,protocol --quantity ip_loss",
    )
    arguments.add_paths(parser)
    arguments.add_cells(parser)
    parser.add_argument(
        "--quantity",
        action="append",
        default=[],
        metavar="NAME",
        help="column to show, may be given more than once (default: all; latex: RTT and losses)",
    )
    parser.add_argument(
        "--width",
        action="append",
        default=[],
        metavar="WIDTH",
        help="tell how many more repeats make an interval +-WIDTH: 2%% for shares, 1ms, 100kbit/s; may be repeated",
    )
    parser.add_choice("--format", (*TABLES, "latex"), default="table", help="default: table")
    parser.set_defaults(run="aggregate:run")


def _compare(commands: Commands) -> None:
    parser: Parser = commands.add_parser(
        "compare",
        help="compare two runs: field against simulation, or before and after",
        description="Compare two runs cell by cell: the difference B - A with its 95 % interval, and a verdict.",
        epilog=_COMPARE_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("a", type=Path, metavar="A", help=arguments.PATH_HELP)
    parser.add_argument("b", type=Path, metavar="B", help="the same")
    arguments.add_cells(parser, PAIRED_BY)
    parser.add_argument(
        "--threshold",
        action="append",
        default=[],
        metavar="QUANTITY=VALUE",
        help="how far apart the two may be, ip_loss=2%% or rtt_median_s=5ms (a share: in percentage points); "
        "may be given more than once",
    )
    parser.add_argument("--force", action="store_true", help="compare also runs that are not comparable")
    arguments.add_rebuild(parser)
    parser.add_choice("--format", TABLES, default="table", help="how it is printed (default table)")
    parser.set_defaults(run="compare:run")


def _report(commands: Commands) -> None:
    parser: Parser = commands.add_parser(
        "report",
        help="make one page of figures and tables from trials",
        description="Make one HTML file of figures, tables and strips; it opens without a network.",
    )
    arguments.add_paths(parser)
    parser.add_argument(
        "-o",
        "--out",
        type=Path,
        default=Path("report.html"),
        metavar="FILE",
        help="the page (default report.html)",
    )
    parser.add_argument("--title", default="", help="its title (default: made of the procedures)")
    parser.add_argument(
        "--repeat",
        default="",
        metavar="NAME",
        help="whose time line is drawn: udp-07, or TRIAL/udp-07 (default: the median one where most is lost)",
    )
    parser.add_argument(
        "--quantity",
        action="append",
        default=[],
        metavar="NAME",
        help="column to draw besides those that are drawn anyway, may be given more than once",
    )
    parser.add_argument("--figures", type=Path, metavar="FOLDER", help="keep the figures there too: SVG, PDF and PNG")
    parser.set_defaults(run="report:run")


def _export(commands: Commands) -> None:
    parser: Parser = commands.add_parser(
        "export",
        help="write trials for pandas, R or Foxglove",
        description="Write the rows of trials as one table, or what happened in one trial as a time line.",
    )
    arguments.add_paths(parser)
    parser.add_choice(
        "--format",
        ("csv", "parquet", "mcap", "junit"),
        required=True,
        help="csv or parquet: the rows of all trials as one table; mcap: the time line of one trial, for "
        "Foxglove; junit: repeats and expectations, for CI servers",
    )
    parser.add_argument("-o", "--out", required=True, type=Path, metavar="FILE", help="the file; none may be there")
    parser.set_defaults(run="export:run")


def _bag(commands: Commands) -> None:
    parser: Parser = commands.add_parser(
        "bag",
        help="look into bags of ROS 1 and ROS 2, check, repair and convert them",
        description="Bags of ROS 1 (.bag) and ROS 2 (SQLite, MCAP), without ROS. A bag is never changed.",
    )
    actions = parser.add_commands(title="commands", metavar="COMMAND")
    info = actions.add_parser("info", help="what a bag holds, by its index")
    arguments.add_bag(info)
    arguments.add_json(info)
    info.set_defaults(run="bag:info")
    check = actions.add_parser("check", help="read every message of bags, and tell what is wrong")
    check.add_argument("bags", type=Path, nargs="+", metavar="BAG", help=arguments.BAG_HELP)
    check.set_defaults(run="bag:check")
    repair = actions.add_parser("repair", help="write what can be read of a damaged bag into a new one")
    arguments.add_bag(repair)
    repair.add_argument("to", type=Path, metavar="NEW", help="the new bag, of the same format")
    repair.set_defaults(run="bag:repair")
    convert = actions.add_parser(
        "convert",
        help="write a bag in another format",
        epilog="example: fieldkit bag convert scan.bag scan --storage mcap --distribution humble",
    )
    arguments.add_bag(convert)
    convert.add_argument("to", type=Path, metavar="NEW", help="NAME.bag for ROS 1, else a folder for ROS 2")
    convert.add_choice("--storage", STORAGES, default=STORAGES[0], help="of a bag of ROS 2 (default: mcap)")
    convert.add_choice(
        "--distribution",
        DISTRIBUTIONS,
        help=f"whose message types it has: {', '.join(DISTRIBUTIONS)} (default: noetic or jazzy)",
    )
    convert.set_defaults(run="bag:convert")


def _bridge(commands: Commands) -> None:
    parser: Parser = commands.add_parser(
        "bridge",
        help="carry topics between ROS 1, DDS and Zenoh",
        description="Carry topics from one middleware to another until Ctrl-C, then tell how many messages and how "
        "late. TOPIC is NAME:TYPE, or NAME:TYPE:QOS as ROS 2 names it.",
        epilog="example: fieldkit bridge --from ros1 --to dds /scan:sensor_msgs/LaserScan:sensor_data "
        "--back /cmd_vel:geometry_msgs/Twist",
    )
    parser.add_choice("--from", MIDDLEWARES, dest="near", required=True, help=f"one of: {', '.join(MIDDLEWARES)}")
    parser.add_choice("--to", MIDDLEWARES, dest="far", required=True, help="another of them")
    parser.add_argument("topics", metavar="TOPIC", nargs="*", help="goes from the first to the second")
    for option, what in (("--back", "goes the other way"), ("--both", "goes both ways")):
        parser.add_argument(
            option, metavar="TOPIC", action="append", default=[], help=f"{what}; may be given more than once"
        )
    parser.add_argument(
        "--address",
        metavar="IP",
        default="127.0.0.1",
        help="address of this machine where the others are (default: 127.0.0.1)",
    )
    parser.add_argument("--master", metavar="HOST[:PORT]", help="of ROS 1 (default: ROS_MASTER_URI, or here)")
    parser.add_argument("--router", metavar="HOST[:PORT]", help="of Zenoh (default: scouting)")
    parser.add_argument(
        "--peer",
        metavar="IP",
        action="append",
        default=[],
        help="who is asked over DDS or Zenoh in place of multicast; may be given more than once",
    )
    parser.add_argument(
        "--domain", type=arguments.natural, metavar="N", help="of ROS 2 (default: ROS_DOMAIN_ID, or 0)"
    )
    parser.add_argument("--node", metavar="NAME", default="fieldkit_bridge", help="default: fieldkit_bridge")
    parser.add_choice("--distribution", ("humble", "jazzy"), default="jazzy", help="of ROS 2 (default: jazzy)")
    parser.add_argument(
        "--type",
        metavar="NAME=FILE",
        action="append",
        default=[],
        help="a message type of your own and its .msg file; may be given more than once",
    )
    parser.add_argument("--json", action="store_true", help="print what was carried as JSON")
    parser.set_defaults(run="bridge:run")


def _catalog(commands: Commands) -> None:
    for kind, dest, what in (("robots", "profile", "robot profile"), ("procedures", "procedure", "procedure")):
        parser: Parser = commands.add_parser(
            kind, help=f"list {kind}, or show NAME", description=f"List {kind}, or show one."
        )
        arguments.add_show(parser, dest, what)
        parser.set_defaults(run=f"catalog:{kind}")
    parser = commands.add_parser(
        "columns",
        help="list the CSV columns, those of PROCEDURE, or show NAME",
        usage="%(prog)s [-h] [PROCEDURE | show NAME]",
        description="What every column of the CSVs means: all, those that the steps of a procedure fill, or one.",
    )
    parser.add_argument("filled", metavar="PROCEDURE", nargs="?", help="a procedure, or its file, or the word show")
    parser.add_argument("column", metavar="NAME", nargs="?", help="after the word show: name of a column")
    parser.set_defaults(run="catalog:columns")


def _positions(commands: Commands) -> None:
    parser: Parser = commands.add_parser(
        "positions",
        help="say where robots really stood, from GPX or CSV, or list who tells it",
        description="Keep files that tell where robots were with a trial, and fill the distance and speed columns "
        "from them; without any, list who tells it in each repeat.",
        epilog="example: fieldkit positions trials/... receiver=walk.gpx sender=48.13740,11.57550 --offset 0.3s",
    )
    parser.takes_lengths = True
    arguments.add_trial(parser)
    parser.add_argument(
        "told",
        metavar="ROLE=FILE",
        nargs="*",
        help="GPX or CSV of the robot in that role, or where it stood: LAT,LON[,ALT], or X,Y[,Z] with units",
    )
    parser.add_argument(
        "--offset", metavar="TIME", default="0s", help="add it to the times of the files: 0.3s, -2s (default: 0s)"
    )
    parser.add_argument(
        "--gap", metavar="TIME", default="3s", help="nobody knows where a robot was in longer gaps (default: 3s)"
    )
    parser.add_argument("--heights", action="store_true", help="let heights over the ellipsoid count, too")
    parser.add_argument("--clear", action="store_true", help="forget what was given")
    parser.set_defaults(run="positions:run")


def _rebuild(commands: Commands) -> None:
    parser: Parser = commands.add_parser(
        "rebuild",
        help="make trial.csv and summary.csv again from raw evidence",
        description="Make trial.csv and summary.csv again from plan, journal and raw evidence: the same bytes.",
    )
    arguments.add_trial(parser)
    parser.set_defaults(run="rebuild:run")


def _verify(commands: Commands) -> None:
    parser: Parser = commands.add_parser(
        "verify",
        help="compare a trial's files with its manifest",
        description="Compare every file of a trial with MANIFEST.sha256 (sha256sum -c reads it too).",
    )
    arguments.add_trial(parser)
    parser.set_defaults(run="verify:run")


def _completion(commands: Commands) -> None:
    parser: Parser = commands.add_parser(
        "completion",
        help="print what completes fieldkit's words in a shell",
        description="Print a script that completes commands, options, robots, procedures and trials by the Tab key.",
        epilog='in ~/.bashrc or ~/.zshrc: eval "$(fieldkit completion bash)", or zsh; '
        "in ~/.config/fish/config.fish: fieldkit completion fish | source",
    )
    parser.add_choice("shell", SHELLS, metavar="SHELL", help=f"one of: {', '.join(SHELLS)}")
    parser.set_defaults(run="completion:run")
