"""Options of access points, roaming, neighbouring networks and microwave ovens in a site file or scenario."""

from typing import Annotated

from fieldkit.config import schema
from fieldkit.config.schema import Bool, Duration, Field, Fraction, Int, Length, Number, Strict
from sim_backends.world.obstacles import Place

_Power = Annotated[Number | Int, Field(ge=-100, le=60)]


class AccessPointOptions(Strict):
    """An access point that is not a robot. It has the standard of the first robot's radio.

    Attributes:
        at_m: Its position, metres east and north.
        height: Its height above the ground.
        tx_power_dbm: Transmit power.
    """

    at_m: Place
    height: Annotated[Length, Field(ge=0)] = 2.5
    tx_power_dbm: _Power = 20.0


class RoamingOptions(Strict):
    """Roaming like wpa_supplicant with `bgscan="simple:SHORT:THRESHOLD:LONG"` on mac80211.

    The defaults are those of NetworkManager for a network with several known access points, and those of mac80211
    (scan.c) for an active scan in a kernel with 250 ticks per second, which expects 56 ms per channel and returns so
    that it is away for at most 124 ms.

    Attributes:
        short: Interval between scans while the signal is below the threshold.
        threshold_dbm: Threshold of the signal of beacons.
        long: Interval between scans while the signal is above the threshold.
        channels: Number of channels that a scan visits, including the current one.
        dwell: Time on each channel, during which the access point buffers packets: two timers of eight ticks.
        away: Time after which the robot returns to the current channel before it visits another one.
        home: Time of such a return.
        handshake: True for the 4-way handshake of WPA2 after each association; `false` for an open network.
        sae: True for WPA3: each association starts with the four frames of SAE.
        processing: Time of a station or access point from the reception of a frame of an association until it sends
            the next one. The default is an assumption.
        noise_dbm: Noise that the robots' driver reports, which affects the margin of a handover; -89 dBm is
            wpa_supplicant's value for drivers that report none.
    """

    short: Annotated[Duration, Field(gt=0)] = 30.0
    threshold_dbm: Annotated[Number | Int, Field(ge=-100, le=0)] = -65.0
    long: Annotated[Duration, Field(gt=0)] = 300.0
    channels: Annotated[Int, Field(ge=1, le=60)] = 11
    dwell: Annotated[Duration, Field(gt=0, le=1)] = 0.064
    away: Annotated[Duration, Field(ge=0, le=10)] = 0.068
    home: Annotated[Duration, Field(ge=0, le=10)] = 0.204
    handshake: Bool = True
    sae: Bool = False
    processing: Annotated[Duration, Field(ge=0, le=1)] = 0.001
    noise_dbm: Annotated[Number | Int, Field(ge=-120, le=0)] = -89.0

    @schema.model_validator(mode="after")
    def _check_intervals(self) -> "RoamingOptions":
        if self.long < self.short:
            raise schema.validation_error("long must be at least as long as short", "long")
        return self


class NeighbourNetworkOptions(Strict):
    """A transmitter of another network in the same channel. It contends for the channel like the robots.

    Attributes:
        at_m: Its position, metres east and north.
        duty: Share of the time in which it sends if it never waits for the channel. It sends frames of 1,500 bytes at
            the basic rate, without ACK, at random intervals.
        height: Its height above the ground.
        tx_power_dbm: Transmit power.
    """

    at_m: Place
    duty: Annotated[Fraction, Field(gt=0, le=0.95)]
    height: Annotated[Length, Field(ge=0)] = 2.5
    tx_power_dbm: _Power = 20.0


class MicrowaveOvenOptions(Strict):
    """A domestic microwave oven. It sends noise once per mains cycle (Kamerman and Erkocevic, PIMRC 1997).

    Here the noise lasts half of the cycle. Robots in another band than 2.4 GHz do not receive it.

    Attributes:
        at_m: Its position, metres east and north.
        mains_hz: Frequency of the mains.
        power_dbm: Power that it radiates into the robots' channel while it is on. The default is an assumption; ovens
            differ by tens of dB.
        height: Its height above the ground.
    """

    at_m: Place
    mains_hz: Annotated[Number | Int, Field(ge=10, le=100)] = 50
    power_dbm: _Power = 16.0
    height: Annotated[Length, Field(ge=0)] = 1.0
