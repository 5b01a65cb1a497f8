"""The `mesh:` key of the `emulated:` section of a site file."""

from typing import Annotated, Final, Literal

from fieldkit.config import schema
from fieldkit.config.schema import Duration, Field, Strict

_HELLO_S: Final = {"babel": 4.0, "batman-adv": 1.0}
"""Default hello interval of babeld on wireless interfaces, and default originator interval of batman-adv."""
_PROGRAMS: Final = {"babel": "babeld", "batman-adv": "batctl"}


class MeshOptions(Strict):
    """A mesh: robots forward packets for each other, and a routing protocol finds the routes.

    Attributes:
        protocol: `babel`: the daemon babeld on each robot finds routes of IP packets by Babel (RFC 8966).
            `batman-adv`: the kernels forward Ethernet frames of the interface `bat0`, which has the robot's address
            and is the interface under test; it needs `wifi: linux`.
        hello: Interval of the messages by which neighbours detect each other: the hello interval of Babel (default 4
            s), or the originator interval of batman-adv (default 1 s). A lost route is replaced after several
            intervals.
    """

    protocol: Literal["babel", "batman-adv"]
    hello: Annotated[Duration, Field(ge=0.1, le=60)] | None = None

    @schema.model_validator(mode="before")
    @classmethod
    def _read_former_key(cls, value: object) -> object:
        """Accept `daemon: babeld`, with which site files of earlier versions select Babel."""
        if isinstance(value, dict) and value.get("daemon") == "babeld" and "protocol" not in value:
            return {key: setting for key, setting in value.items() if key != "daemon"} | {"protocol": "babel"}
        return value

    @property
    def hello_s(self) -> float:
        """The interval in seconds; the default of the protocol if the site file has none."""
        return _HELLO_S[self.protocol] if self.hello is None else float(self.hello)

    @property
    def program(self) -> str:
        """The program that each robot needs."""
        return _PROGRAMS[self.protocol]
