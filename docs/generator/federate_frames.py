"""An example of each message of the protocol of external federates: the test vectors."""

from fieldkit.core.model import LinkSample, StationSample
from sim_backends.federates import exchanges
from sim_backends.federates.agent_states import AgentTable
from sim_backends.federates.exchanges import AdvanceNetwork, NetworkOutcomes
from sim_backends.federates.frames import PHYSICS, MessageKind, encode, text_bytes
from sim_backends.federates.handshake import AgentStart, FederateCapability, Hello, Welcome, encode_join
from sim_backends.federates.link_records import encode_links
from sim_backends.federates.records import COMMAND_TYPES, ArrivalDelay
from sim_backends.network.packets import Arrival, Drop, Packet
from sim_backends.physics.body import Twist, Velocity
from sim_backends.world.motion import State

START = State((1.0, 2.0, 0.5), (0.0, 0.0, 0.0), 0.25)
DRONE = State((-1.5, 0.0, 10.0), (0.0, 0.5, -0.25), None)
HELLO = Hello(
    PHYSICS,
    [AgentStart("ugv", "husky", START, flies=False, antenna_m=0.5, limit_m_s2=3.0)],
    seed=7,
    step_ns=1_000_000,
    end_ns=2_000_000_000,
    name="demo",
    configuration=b"{}",
    token="s3cret",  # noqa: S106 (an example)
)
WELCOME = Welcome(
    PHYSICS,
    "carts",
    HELLO.configuration_hash,
    "carts 1.0",
    FederateCapability.DETERMINISTIC | FederateCapability.AGENTS_APPEAR,
    step_ns=1_000_000,
    commands=COMMAND_TYPES,
)

LINKS = {
    "ugv": LinkSample(
        0,
        (StationSample("uav", -61.5, 54e6, None, 12, 11, 3, 1),),
        noise_dbm=-95.0,
        active_ns=11_099_999,
        busy_ns=2_000_000,
    )
}

WITHOUT_VECTOR = {"pong", "busy", "done", "release", "bye", "sample links"}
"""Messages whose body is empty or equals that of ping."""

DESCRIPTION = """\
This page has a frame of each layout of the [protocol](../federates.md) in hexadecimal. Messages whose body is empty
or equals that of ping are omitted. The values are those of a run `demo` of 2 s with seed 7, step 1 ms, configuration
`{}` and token `s3cret`.

- The agent `ugv` (`husky`, antenna at 0.5 m, limit 3 m/s^2) starts at (1, 2, 0.5) with heading 0.25.
- The physics federate `carts`, version `carts 1.0`, is deterministic and supports both commands.
- From 10 to 11.1 ms `ugv` drives at 0.5 m/s and turns at -0.125 rad/s, and agent 1 flies at (1, 0, 0.25) m/s.
- Agent 1, `uav`, appears in the states at (-1.5, 0, 10) with the velocity (0, 0.5, -0.25).
- Packet 9, number 4 of `pose`, has 300 bytes, is sent at 10 ms and enters the network at 10.5 ms.
- `ugv` receives `uav` with -61.5 dBm. It has sent 12 packets to `uav`, the last at 54 Mbit/s, and has received 11
  packets at an unknown rate.
"""
"""Text of the page of test vectors."""


def agents() -> AgentTable:
    """Return the table of agents after the first answer of the physics."""
    return AgentTable(["ugv", "uav"])


def _name(kind: MessageKind) -> str:
    return kind.name.lower().replace("_", " ")


def example_frames() -> dict[str, bytes]:
    """Return a frame of each kind, by its name."""
    packet = Packet(9, "ugv", "uav", 300, ("pose", 4), 10_000_000, 10_500_000, "udp")
    bodies = {
        MessageKind.JOIN: encode_join("s3cret"),
        MessageKind.HELLO: HELLO.encode(),
        MessageKind.WELCOME: WELCOME.encode(),
        MessageKind.ADVANCE_PHYSICS: exchanges.encode_advance_physics(
            11_100_000, 10_000_000, {"ugv": Twist(0.5, -0.125), "uav": Velocity((1.0, 0.0, 0.25))}, agents()
        ),
        MessageKind.STATES: exchanges.encode_states(
            11_000_000, {"ugv": START, "uav": DRONE}, AgentTable(["ugv"]), {"ugv": 3.0}
        ),
        MessageKind.ADVANCE_NETWORK: AdvanceNetwork(
            11_099_999, {"ugv": START}, [packet], since_ns=10_000_000, reckoning_ns=1_000_000
        ).encode(agents()),
        MessageKind.OUTCOMES: NetworkOutcomes(
            11_099_999,
            12_000_000,
            [Arrival(9, "uav", 11_000_250)],
            [Drop(8, "out of range")],
            [ArrivalDelay(100_000, 350_000, 33)],
        ).encode(agents()),
        MessageKind.PING: exchanges.encode_number(42),
        MessageKind.PONG: exchanges.encode_number(42),
        MessageKind.BUSY: exchanges.encode_number(10_000_000),
        MessageKind.FORK: exchanges.encode_fork(2),
        MessageKind.DONE: b"",
        MessageKind.RELEASE: b"",
        MessageKind.ERROR: text_bytes("ValueError: no wheels"),
        MessageKind.BYE: b"",
        MessageKind.SAMPLE_LINKS: b"",
        MessageKind.LINKS: encode_links(LINKS, agents()),
    }
    copies = {MessageKind.RELEASE: 2}
    without_number = {MessageKind.JOIN, MessageKind.RELEASE, MessageKind.BYE}
    return {
        _name(kind): encode(kind, 0 if kind in without_number else 3, copies.get(kind, 0), body)
        for kind, body in bodies.items()
    }
