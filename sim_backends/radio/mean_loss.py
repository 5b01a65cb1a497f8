"""Mean loss of paths in a world: path loss without obstacles, shadowing, and loss caused by obstacles."""

import numpy as np

from sim_backends.radio.propagation import path_loss
from sim_backends.radio.propagation.fading import Shadowing
from sim_backends.radio.radio_options import RadioOptions
from sim_backends.world.penetration import Obstacles
from sim_backends.world.shapes import Floats
from sim_backends.world.world import World


class MeanLoss:
    """Mean loss of paths, without fading and antennas.

    Args:
        options: Radio options.
        carrier_hz: Frequency.
        world: Obstacles; None for open ground.
        shadowing_seed: Seed of the shadowing.
    """

    def __init__(self, options: RadioOptions, carrier_hz: float, world: World | None, shadowing_seed: int) -> None:
        self._options = options
        self._carrier_hz = carrier_hz
        self._obstacles = None if world is None else Obstacles(world)
        self._shadowing = (
            Shadowing(shadowing_seed, options.shadowing_db, options.decorrelation) if options.shadowing_db else None
        )

    def loss_without_obstacles_db(self, start_m: Floats, end_m: Floats) -> Floats:
        """Return the loss of paths between points of shape (n, 3) with shadowing and without obstacles, in dB."""
        match self._options.propagation:
            case "free-space":
                loss_db = path_loss.free_space_db(start_m, end_m, self._carrier_hz)
            case "two-ray":
                loss_db = path_loss.two_ray_db(start_m, end_m, self._carrier_hz)
            case _:
                loss_db = path_loss.log_distance_db(start_m, end_m, self._carrier_hz, self._options.exponent)
        return loss_db if self._shadowing is None else loss_db + self._shadowing.loss_db(start_m, end_m)

    def obstacles_db(self, start_m: Floats, end_m: Floats) -> Floats:
        """Return the loss caused by obstacles, in dB."""
        if self._obstacles is None:
            return np.zeros(len(start_m))
        return self._obstacles.penetration_loss_db(start_m, end_m, self._carrier_hz)

    def loss_db(self, start_m: Floats, end_m: Floats) -> Floats:
        """Return the loss with shadowing and obstacles, in dB."""
        return self.loss_without_obstacles_db(start_m, end_m) + self.obstacles_db(start_m, end_m)
