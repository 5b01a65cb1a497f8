"""The lab's client of a co-simulated medium, which starts the process of the medium."""

from collections.abc import Mapping, Sequence
from typing import Any

from typing_extensions import override

from fieldkit.config.profiles import Radio
from sim_backends.emulated.cosimulated.simulators import RobotBody, Simulators
from sim_backends.emulated.medium.framing import IP, Framing
from sim_backends.emulated.medium.medium_client import MediumClient
from sim_backends.radio.radio_options import RadioOptions
from sim_backends.world.world import World


class CosimulatedClient(MediumClient):
    """Starts the process of a co-simulated medium. The other arguments and the errors are those of `MediumClient`.

    Args:
        bodies: Body of each robot; other nodes have none.
        simulators: The simulators.
        policy: Name and parameters of the sync policy.
    """

    module = "sim_backends.emulated.cosimulated.cosim_process"

    def __init__(
        self,
        options: RadioOptions,
        world: World | None = None,
        *,
        seed: int,
        framing: Framing = IP,
        bodies: Mapping[str, RobotBody],
        simulators: Simulators,
        policy: Mapping[str, Any],
    ) -> None:
        super().__init__(options, world, seed=seed, framing=framing)
        self._bodies = bodies
        self._simulators = simulators
        self._policy = policy

    @override
    def attach(
        self, name: str, address: str, radio: Radio, fd: int | None, *, physics_fds: Sequence[int] = ()
    ) -> None:
        super().attach(name, address, radio, fd)
        if (body := self._bodies.get(name)) is not None:
            request = {"do": "body", "name": name, "body": body.to_json()}
            self._worker.request(request, descriptors=physics_fds)

    @override
    def _configure(self) -> None:
        super()._configure()
        request = {"do": "simulate", "simulators": self._simulators._asdict(), "policy": dict(self._policy)}
        self._worker.request(request)
