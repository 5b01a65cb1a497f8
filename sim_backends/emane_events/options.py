"""Options of the connection to EMANE's event channel."""

from collections.abc import Iterable, Iterator
from ipaddress import IPv4Address
from typing import Annotated

from typing_extensions import override

from fieldkit.config import schema
from fieldkit.config.schema import AfterValidator, Bool, Duration, Field, Int, Location
from sim_backends.emane_events.events import MAX_NEM
from sim_backends.federates.simulator_options import SimulatorOptions
from sim_backends.world.obstacles import Real


def _check_channel(text: str) -> str:
    split_channel(text)
    return text


def split_channel(text: str) -> tuple[str, int]:
    """Return the multicast group and the port of an event channel, `224.1.2.8:45703`.

    Raises:
        ValueError: The text is not an event channel.
    """
    group, _, port = text.rpartition(":")
    try:
        is_valid = IPv4Address(group).is_multicast and port.isascii() and 0 < int(port) < 1 << 16
    except ValueError:
        is_valid = False
    if not is_valid:
        raise schema.validation_error(f"{text!r} is not a multicast group and port, such as 224.1.2.8:45703")
    return group, int(port)


class EmaneOptions(SimulatorOptions):
    """The event channel of the network emulator EMANE, see [its page](emane.md).

    Attributes:
        channel: Multicast group and port of the events.
        device: Network interface; if omitted, the interface of the route to the group.
        nems: EMANE's identifiers (NEM, one per radio) of agents; if empty, 1, 2, ... in the order of the agents.
        reference: Latitude and longitude in degrees, and height above the ellipsoid in metres, of the world's origin.
        interval: Smallest time between two publications of a run's positions and path losses, in simulated time.
        pathloss: Publish the mean path loss between all agents, with obstacles, for `precomputed` propagation; or, if
            the run reads positions from events, use the path losses in them.
        real_time: True if a run is at most as fast as the wall clock, because EMANE uses the wall clock.
        wait: Maximum wait for the first location of each agent, if the run reads positions from events.
    """

    channel: Annotated[str, AfterValidator(_check_channel)] = "224.1.2.8:45703"
    device: str | None = None
    nems: dict[str, Annotated[Int, Field(ge=1, le=MAX_NEM)]] = Field(default_factory=dict)
    reference: tuple[
        Annotated[Real, Field(ge=-90, le=90)], Annotated[Real, Field(ge=-180, le=180)], Annotated[Real, Field()]
    ] = (0, 0, 0)
    interval: Annotated[Duration, Field(gt=0)] = 0.1
    pathloss: Bool = True
    real_time: Bool = True
    wait: Annotated[Duration, Field(gt=0)] = 30.0

    @override
    def agent_names(self) -> Iterator[tuple[str, Location]]:
        yield from ((name, ("nems", name)) for name in self.nems)

    def nems_of(self, agents: Iterable[str]) -> dict[str, int]:
        """Return the NEM identifier of each agent.

        Raises:
            ValueError: An agent has no identifier, or two agents have the same identifier.
        """
        names = list(agents)
        if not self.nems:
            return {name: number for number, name in enumerate(names, 1)}
        for name in (*names, *self.nems):
            if name not in self.nems or name not in names:
                raise ValueError(
                    f"nems must list each agent once: {name} is {'missing' if name in names else 'unknown'}"
                )
        if len(set(self.nems.values())) < len(self.nems):
            raise ValueError("nems: two agents have the same identifier")
        return {name: self.nems[name] for name in names}
