"""The media of a lab: one for the radio under test, and one per further link of the robots, for example LTE."""

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

from fieldkit.core.model import Vector
from sim_backends.emulated.medium.medium_client import MediumClient
from sim_backends.world.motion import Attitude


@dataclass(frozen=True)
class Media:
    """Running media.

    Attributes:
        radio: The medium of the radio under test.
        links: The medium of each further link, by its name.
    """

    radio: MediumClient
    links: Mapping[str, MediumClient]

    def medium_of(self, link: str) -> MediumClient:
        """Return the medium of a further link, or of the radio under test if no further link has this name."""
        return self.links.get(link, self.radio)

    def place(
        self,
        positions_m: Mapping[str, Vector],
        *,
        relay: str | None = None,
        velocities_m_s: Mapping[str, Vector] = MappingProxyType({}),
        attitudes: Mapping[str, Attitude] = MappingProxyType({}),
    ) -> None:
        """Place the robots in the medium of the radio, and in the medium of each link to which they are attached.

        Only the radio under test has a relay.

        Arguments and errors are those of `MediumClient.place`.
        """
        self.radio.place(positions_m, relay=relay, velocities_m_s=velocities_m_s, attitudes=attitudes)
        for medium in self.links.values():
            attached_m = {name: position_m for name, position_m in positions_m.items() if name in medium.robot_names}
            medium.place(
                attached_m,
                velocities_m_s={name: velocities_m_s[name] for name in attached_m if name in velocities_m_s},
                attitudes={name: attitudes[name] for name in attached_m if name in attitudes},
            )

    def lateness_counts(self) -> Mapping[int, int]:
        """Return the number of packets of all media by lateness in ns, rounded as in `MediumStats`.

        Raises the errors of `MediumClient.stats`.
        """
        counts: Counter[int] = Counter()
        for medium in (self.radio, *self.links.values()):
            counts.update(medium.stats().packet_lateness_counts)
        return counts

    def check_alive(self) -> None:
        """Raise the errors of `Worker.check_alive` if a medium does not run."""
        for medium in (self.radio, *self.links.values()):
            medium.check_alive()
