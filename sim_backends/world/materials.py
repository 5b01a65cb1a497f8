"""Materials, and the losses of a radio wave that crosses them."""

import cmath
import math
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Final

SPEED_OF_LIGHT_M_S: Final = 299_792_458.0
_DB_PER_NEPER: Final = 20 / math.log(10)
# Imaginary part of the relative permittivity, 17.98 sigma / f with sigma in S/m and f in GHz: ITU-R P.2040-1, eq. 9b.
_LOSS_FACTOR: Final = 17.98


@dataclass(frozen=True)
class Solid:
    """A homogeneous material with plane faces.

    Permittivity is `a f^b`, conductivity `c f^d` in S/m, with f in GHz: ITU-R P.2040-1, table 3.

    Attributes:
        a: Relative permittivity at 1 GHz.
        b: Exponent of the frequency in the permittivity.
        c: Conductivity at 1 GHz, in S/m.
        d: Exponent of the frequency in the conductivity.
    """

    a: float
    b: float
    c: float
    d: float

    def permittivity(self, frequency_hz: float) -> complex:
        """Return the relative permittivity; its imaginary part is 0 or negative (ITU-R P.2040-1, eq. 9)."""
        ghz = frequency_hz / 1e9
        return complex(self.a * ghz**self.b, -_LOSS_FACTOR * self.c * ghz**self.d / ghz)

    def loss_db_per_m(self, frequency_hz: float) -> float:
        """Return the attenuation of a plane wave in the material, in dB/m (ITU-R P.2040-1, attenuation rate)."""
        wave_number = 2 * math.pi * frequency_hz / SPEED_OF_LIGHT_M_S
        return -_DB_PER_NEPER * wave_number * cmath.sqrt(self.permittivity(frequency_hz)).imag

    def face_loss_db(self, frequency_hz: float) -> float:
        """Return the reflection loss of one face at normal incidence, in dB (ITU-R P.2040-1, eq. 31, theta = 0)."""
        root = cmath.sqrt(self.permittivity(frequency_hz))
        reflected = abs((1 - root) / (1 + root)) ** 2
        return -10 * math.log10(1 - reflected)


@dataclass(frozen=True)
class Foliage:
    """Leaves and branches; the loss depends on their total depth along a path.

    Weissberger's modified exponential decay (1982, ESD-TR-81-101), for 0.23 to 95 GHz, trees in leaf: with f in GHz
    and d in m, the loss is 0.45 f^0.284 d dB below 14 m and 1.33 f^0.284 d^0.588 dB above. The formula is also used
    beyond its range of 400 m.
    """

    def loss_db(self, depth_m: float, frequency_hz: float) -> float:
        """Return the attenuation over `depth_m` of foliage, in dB."""
        scale = math.pow(frequency_hz / 1e9, 0.284)
        return scale * (0.45 * depth_m if depth_m < 14 else 1.33 * math.pow(depth_m, 0.588))


Material = Solid | Foliage

FOLIAGE: Final = Foliage()
GROUND: Final = Solid(15.0, -0.1, 0.035, 1.63)
"""Medium dry ground."""

MATERIALS: Final[Mapping[str, Material]] = MappingProxyType(
    {
        # ITU-R P.2040-1, table 3; metal's conductivity there is 10^7 S/m.
        "concrete": Solid(5.31, 0.0, 0.0326, 0.8095),
        "brick": Solid(3.75, 0.0, 0.038, 0.0),
        "plasterboard": Solid(2.94, 0.0, 0.0116, 0.7076),
        "wood": Solid(1.99, 0.0, 0.0047, 1.0718),
        "glass": Solid(6.27, 0.0, 0.0043, 1.1925),
        "chipboard": Solid(2.58, 0.0, 0.0217, 0.7800),
        "metal": Solid(1.0, 0.0, 1e7, 0.0),
        "ground": GROUND,
        "foliage": FOLIAGE,
    }
)
