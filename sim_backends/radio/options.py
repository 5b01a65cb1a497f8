"""What a lab may say about its radio; an empty mapping gives a radio like the paper's on open ground."""

from typing import Annotated, Final

from fieldkit import config, units
from fieldkit.config import AfterValidator, Duration, Field, Fraction, Int, Number, Strict
from fieldkit.errors import ConfigurationError

UNLIMITED: Final = "unlimited"


def _checked_rate(text: str) -> str:
    if text == UNLIMITED:
        return text
    try:
        rate_bit_s = units.parse_quantity(text, units.BITS_PER_S_PER_UNIT, "bit rate")
    except ConfigurationError as error:
        raise config.complaint(f"{error.what}; {error.remedy}, or the word {UNLIMITED}") from None
    if rate_bit_s < 1:
        raise config.complaint(f"bit rate {text!r} is below 1bit/s; write for example 20Mbit/s, or {UNLIMITED}")
    return text


class RadioOptions(Strict):
    """The radio of an emulated lab.

    `loss`, `delay` and `rate` replace on every link what the model says from distance and wall; `loss` then is a
    share of packets whatever their length, and no link is out of range. In a master topology a packet between
    two stations crosses two links and meets each of them twice.

    Attributes:
        exponent: Path-loss exponent. 3.0 is the distance power-loss coefficient N = 30 that ITU-R P.1238 gives for
            2.4 GHz in offices; free space has 2.
        reference_loss_db: Path loss at 1 m. 40.2 dB is the free-space loss at 2.437 GHz (Wi-Fi channel 6) by Friis,
            20 log10(4 pi d f / c).
        wall_loss_db: What the wall of an NLOS scenario takes. 11 dB is 0.2 m of concrete at 2.4 GHz: permittivity
            5.31 and conductivity 0.0326 f_GHz^0.8095 S/m (ITU-R P.2040-1, table 3) absorb 1636 sigma/sqrt(eps) =
            47 dB/m, and each of the two faces reflects 0.7 dB.
        noise_floor_dbm: Noise and interference at a receiver. -95 dBm is thermal noise in 20 MHz (-101 dBm) and a
            noise figure of 6 dB.
        processing: What hardware and channel access add to a hop, in seconds. 0.2 ms is about DIFS, mean first
            backoff, preamble, SIFS and ACK of 802.11g (28 + 68 + 20 + 10 + 30 us) and the host's interrupt.
        jitter: Width of the uniform extra delay of a hop, in seconds, on top of its delay.
        queue_packets: Packets that wait per link beside the one on the air; 1000 is Linux's default queue length.
        loss: Share of packets lost per link.
        delay: Delay of a link beside waiting and serialization, in seconds.
        rate: Bit rate of every link, or `unlimited`.
    """

    exponent: Annotated[Number | Int, Field(ge=1, le=8)] = 3.0
    reference_loss_db: Annotated[Number | Int, Field(ge=0, le=200)] = 40.2
    wall_loss_db: Annotated[Number | Int, Field(ge=0, le=200)] = 11.0
    noise_floor_dbm: Annotated[Number | Int, Field(ge=-150, le=50)] = -95.0
    processing: Annotated[Duration, Field(le=60)] = 0.0002
    jitter: Annotated[Duration, Field(le=60)] = 0.0
    queue_packets: Annotated[Int, Field(ge=0, le=1_000_000)] = 1000
    loss: Fraction | None = None
    delay: Annotated[Duration, Field(le=60)] | None = None
    rate: Annotated[str, AfterValidator(_checked_rate)] | None = None

    def rate_bit_s(self, modelled_bit_s: int) -> int | None:
        """Return the bit rate to use where the model says `modelled_bit_s`; None is unlimited."""
        if self.rate is None:
            return modelled_bit_s
        if self.rate == UNLIMITED:
            return None
        return round(units.parse_quantity(self.rate, units.BITS_PER_S_PER_UNIT, "bit rate"))
