"""The media of a lab: the radio under test, and one medium per further link of the robots."""

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

from fieldkit.core.model import Vector
from sim_backends.emulated.medium.medium_client import MediumClient


@dataclass(frozen=True)
class Media:
    """Running media.

    Attributes:
        radio: The medium of the radio under test.
        links: The medium of each further link, by its name.
    """

    radio: MediumClient
    links: Mapping[str, MediumClient]

    def of(self, link: str) -> MediumClient:
        """Return the medium of a link; of the radio under test if it is not a further link."""
        return self.links.get(link, self.radio)

    def place(
        self,
        positions_m: Mapping[str, Vector],
        *,
        relay: str | None = None,
        velocities_m_s: Mapping[str, Vector] = MappingProxyType({}),
    ) -> None:
        """Place the robots in all media; arguments and errors as `MediumClient.place`. Only the radio has a relay."""
        self.radio.place(positions_m, relay=relay, velocities_m_s=velocities_m_s)
        for medium in self.links.values():
            here_m = {name: place_m for name, place_m in positions_m.items() if name in medium.attached}
            medium.place(
                here_m, velocities_m_s={name: velocities_m_s[name] for name in here_m if name in velocities_m_s}
            )

    def late(self) -> Mapping[int, int]:
        """Return the late packets in all media by lateness in nanoseconds. Errors as `MediumClient.stats`."""
        late: Counter[int] = Counter()
        for medium in (self.radio, *self.links.values()):
            late.update(medium.stats().late)
        return late

    def check_alive(self) -> None:
        """Raise the errors of `Worker.check_alive` if a medium does not run."""
        for medium in (self.radio, *self.links.values()):
            medium.check_alive()
