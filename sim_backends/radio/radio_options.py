"""Options of the radio in a site file; an empty mapping gives Wi-Fi on open ground."""

from typing import Annotated, Final, Literal

from fieldkit.config import schema
from fieldkit.config.schema import (
    AfterValidator,
    Bool,
    Duration,
    Field,
    Fraction,
    Int,
    Length,
    Number,
    Strict,
)
from fieldkit.core import units
from fieldkit.core.errors import ConfigurationError, did_you_mean
from sim_backends.radio.core.links import LinkParameters
from sim_backends.radio.infrastructure_options import (
    AccessPointOptions,
    MicrowaveOvenOptions,
    NeighbourNetworkOptions,
    RoamingOptions,
)
from sim_backends.radio.phy.high_throughput import mode_names
from sim_backends.radio.phy.modes import G_MODES, N_MODES

UNLIMITED: Final = "unlimited"

INFRASTRUCTURE: Final = ("access_points", "neighbours", "microwave_ovens")
"""Keys of stations and sources of noise that are not robots."""

_RATE: Final = "54Mbit/s"
_HOP_S: Final = 0.0002
"""Default rate and delay of fixed links."""


_MODES: Final = f"{', '.join(mode.name for mode in (*G_MODES, *N_MODES))}, a6 to a54, he80-mcs11-2ss-800ns"


def _check_mode(name: str) -> str:
    names = mode_names()
    if name not in names:
        raise schema.validation_error(f"there is no mode {name!r}; {did_you_mean(name, names, f'modes: {_MODES}')}")
    return name


def _check_rate(text: str) -> str:
    if text == UNLIMITED:
        return text
    try:
        rate_bit_s = units.parse_quantity(text, units.BITS_PER_S_PER_UNIT, "bit rate")
    except ConfigurationError as error:
        raise schema.validation_error(f"{error.what}; {error.remedy}, or the word {UNLIMITED}") from None
    if rate_bit_s < 1:
        raise schema.validation_error(
            f"bit rate {text!r} is below 1bit/s; write for example 20Mbit/s, or {UNLIMITED}"
        )
    return text


StationName = Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_-]{0,30}$")]


class RadioOptions(Strict):
    """The radio of an emulated lab: Wi-Fi in its world, or links that do not depend on positions.

    With `loss`, `delay`, `rate` or `jitter` every link is fixed for all positions: no robot is out of range,
    robots do not contend for the channel, and of the other options only `queue_packets` applies. In a master topology
    a packet between two stations crosses two links, and each of these four options applies twice.

    Attributes:
        propagation: Mean path loss in the open: `log-distance`, `free-space`, or `two-ray` over flat ground.
        exponent: Exponent of the log-distance law. 3.0 is the distance power-loss coefficient N = 30 that ITU-R
            P.1238 gives for 2.4 GHz in offices; free space has 2.
        shadowing_db: Standard deviation of shadowing, in dB; 0 for none.
        decorrelation: Distance over which shadowing decorrelates to 1/e.
        fading: True if multipath components fade: Rician with line of sight, Rayleigh without. `false` gives a link
            without randomness within its range.
        k_db: Rician K factor in dB: power ratio of the constant and the scattered components, with line of
            sight. IEEE 802.11-03/940r4 (TGn channel models) has 6 dB for model F, large spaces indoors and outdoors.
        stir_m_s: Speed of moving objects around the robots (leaves, people), in m/s: a link between two robots at
            rest fades as if one moved at this speed. The TGn models have 1.2 km/h (0.33 m/s), the TGac models (IEEE
            802.11-09/0308r12) have 0.089 km/h (0.025 m/s). The default is between these values, and gives a coherence
            time of about 0.5 s.
        noise_floor_dbm: Noise and interference at a receiver, in dBm. -95 dBm is thermal noise in 20 MHz (-101 dBm)
            and a noise figure of 6 dB.
        mode: Fixed transmission mode: `g6` to `g54` (Mbit/s), `a6` to `a54` (5 and 6 GHz), `n0` to `n7` (MCS).
            If the robots' profiles have `radio.phy`, it can also be format, width in MHz, MCS, streams and guard
            interval, `vht80-mcs9-2ss-400ns`. If it is omitted, stations adapt the rate to acknowledgements.
        queue_packets: Queue length per station, or per fixed link, in packets, without the packet on the air; 1000 is
            Linux's default.
        access_points: Access points that are not robots, by name: a robot is a station of one of them and
            [roams](method-radio.md#roaming). The topology must be masterless.
        roaming: Roaming of robots between the access points.
        neighbours: Transmitters of other networks in the channel, by name.
        microwave_ovens: Microwave ovens, by name.
        loss: Fixed links: share of packets lost per link, independently of their length; 0 % if it is omitted and
            `delay`, `rate` or `jitter` is given.
        delay: Fixed links: delay of a link in addition to queuing and serialization. The default is 0.2 ms, about
            the sum of DIFS, mean first backoff, preamble, SIFS and ACK of 802.11g (28 + 68 + 20 + 10 + 30 us) and the
            host's interrupt.
        rate: Fixed links: bit rate of every link, `20Mbit/s`, or `unlimited`; 54 Mbit/s if omitted.
        jitter: Fixed links: width of the uniformly distributed extra delay of a link.
    """

    propagation: Literal["log-distance", "free-space", "two-ray"] = "log-distance"
    exponent: Annotated[Number | Int, Field(ge=1, le=8)] = 3.0
    shadowing_db: Annotated[Number | Int, Field(ge=0, le=30)] = 0.0
    decorrelation: Annotated[Length, Field(gt=0)] = 10.0
    fading: Bool = True
    k_db: Annotated[Number | Int, Field(ge=-20, le=40)] = 6.0
    stir_m_s: Annotated[Number | Int, Field(ge=0, le=100)] = 0.1
    noise_floor_dbm: Annotated[Number | Int, Field(ge=-150, le=50)] = -95.0
    mode: Annotated[str, AfterValidator(_check_mode)] | None = None
    queue_packets: Annotated[Int, Field(ge=0, le=1_000_000)] = 1000
    access_points: dict[StationName, AccessPointOptions] = Field(default_factory=dict)
    roaming: RoamingOptions = RoamingOptions.defaults()
    neighbours: dict[StationName, NeighbourNetworkOptions] = Field(default_factory=dict)
    microwave_ovens: dict[StationName, MicrowaveOvenOptions] = Field(default_factory=dict)
    loss: Fraction | None = None
    delay: Annotated[Duration, Field(le=60)] | None = None
    rate: Annotated[str, AfterValidator(_check_rate)] | None = None
    jitter: Annotated[Duration, Field(le=60)] | None = None

    @property
    def is_fixed(self) -> bool:
        """True if every link is fixed."""
        return any(option is not None for option in (self.loss, self.delay, self.rate, self.jitter))

    @property
    def has_infrastructure(self) -> bool:
        """True if access points, neighbours or ovens are on the air."""
        return bool(self.access_points or self.neighbours or self.microwave_ovens)

    @schema.model_validator(mode="after")
    def _check_infrastructure(self) -> "RadioOptions":
        if self.is_fixed and self.has_infrastructure:
            key = next(key for key in INFRASTRUCTURE if getattr(self, key))
            raise schema.validation_error(f"fixed links (loss, delay, rate or jitter) have no {key}", key)
        return self

    def link(self) -> LinkParameters:
        """Return the parameters of every fixed link."""
        return LinkParameters(
            rate_bit_s=self._rate_bit_s(),
            delay_ns=round((_HOP_S if self.delay is None else self.delay) * 1e9),
            jitter_ns=round((self.jitter or 0.0) * 1e9),
            loss=self.loss or 0.0,
            queue_packets=self.queue_packets,
        )

    def _rate_bit_s(self) -> int | None:
        if self.rate == UNLIMITED:
            return None
        return round(units.parse_quantity(self.rate or _RATE, units.BITS_PER_S_PER_UNIT, "bit rate"))
