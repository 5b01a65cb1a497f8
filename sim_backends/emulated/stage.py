"""The stage of an emulated lab: where everybody stands, as the medium is told."""

from fieldkit.backends import Cast
from fieldkit.errors import RobotError
from fieldkit.model import Placement, Role
from sim_backends.emulated import placement as places
from sim_backends.emulated.laptop import Laptop
from sim_backends.emulated.medium_client import MediumClient
from sim_backends.world.world import World


class Stage:
    """Puts robots in their places, takes one away and brings it back.

    Args:
        cast: Who plays which role.
        medium: Carries their packets.
        world: What they stand in.
        laptop: Stands among them; None where it is not on the air.
    """

    def __init__(self, cast: Cast, medium: MediumClient, world: World, laptop: Laptop | None) -> None:
        self._cast = cast
        self._medium = medium
        self._world = world
        self._laptop = laptop
        self._placement: Placement | None = None

    def place(self, placement: Placement, *, without: Role | None = None) -> None:
        """Put everybody in place, at once.

        Args:
            placement: Where.
            without: Who is so far away that nobody hears it; without the relay nobody hears anybody.

        Raises:
            LinkError: The medium ended or did not answer.
        """
        self._placement = placement
        positions_m = places.positions_m(self._cast, placement, self._world)
        relay = places.relay(self._cast, placement)
        if self._laptop is not None:
            positions_m[self._laptop.name] = places.laptop_m(self._cast, placement, self._world)
        if without is not None:
            gone = self._cast[without].name
            positions_m = {} if gone == relay else {name: at for name, at in positions_m.items() if name != gone}
        self._medium.place(positions_m, relay=relay if relay in positions_m else None)

    def move(self, *, away: Role | None) -> None:
        """Take one robot out of everybody's range, or bring all back with None. Errors as `place`.

        Raises:
            RobotError: Nobody has a place yet.
        """
        if self._placement is None:
            raise RobotError("the robots have no places yet", remedy="place them first")
        self.place(self._placement, without=away)
