"""What `fieldkit bridge` takes."""

from typing import Final

from fieldkit.cli.arguments import shared
from fieldkit.cli.parser import Parser

MIDDLEWARES: Final = ("ros1", "dds", "zenoh")
"""`agent.middleware.ADAPTERS`, which a test compares, without `ros2`: that needs the Python of a robot's ROS 2."""


def add(parser: Parser) -> None:
    """Declare what `fieldkit bridge` takes."""
    parser.description = (
        "Carry topics from one middleware to another until Ctrl-C, then tell how many messages and how "
        "late. TOPIC is NAME:TYPE, or NAME:TYPE:QOS as ROS 2 names it."
    )
    parser.epilog = (
        "example: fieldkit bridge --from ros1 --to dds /scan:sensor_msgs/LaserScan:sensor_data "
        "--back /cmd_vel:geometry_msgs/Twist"
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
    parser.add_argument(
        "--patience", type=shared.natural, default=3, metavar="S", help="for the master to answer (default: 3)"
    )
    parser.add_argument("--router", metavar="HOST[:PORT]", help="of Zenoh (default: scouting)")
    parser.add_argument(
        "--peer",
        metavar="IP",
        action="append",
        default=[],
        help="who is asked over DDS or Zenoh in place of multicast; may be given more than once",
    )
    parser.add_argument("--domain", type=shared.natural, metavar="N", help="of ROS 2 (default: ROS_DOMAIN_ID, or 0)")
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
