"""Radio properties of the stations, and the modes that they can use with each other."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol

from fieldkit.config.antennas import AntennaOptions
from fieldkit.config.wifi_phy import WifiPhy
from fieldkit.core.errors import ConfigurationError
from sim_backends.radio.phy.high_throughput import PhyCapability, capability_of, common_modes, mode_named
from sim_backends.radio.phy.modes import BAND_2_4, G_MODES, MODES, OFDM_MODES, Band, Standard, WifiMode
from sim_backends.radio.propagation.antenna_patterns import Dipole, GainTable, decode_pattern, pattern_of


class RadioSettings(Protocol):
    """The radio of a robot profile, or of an agent of a scenario."""

    @property
    def standard(self) -> str:
        """Its standard, for example `802.11n 2.4 GHz`."""
        ...

    @property
    def tx_power_dbm(self) -> float:
        """Its transmit power."""
        ...

    @property
    def sensitivity_dbm(self) -> float:
        """Received power of the weakest frame that it detects."""
        ...

    @property
    def phy(self) -> WifiPhy | None:
        """Its physical layer; None if it is not described."""
        ...

    @property
    def antenna(self) -> AntennaOptions | None:
        """Its antenna; None if it is isotropic."""
        ...


@dataclass(frozen=True)
class Antenna:
    """The radio properties of a station.

    Attributes:
        standard: Standard of its radio, if it has no `phy`.
        tx_power_dbm: Transmit power.
        sensitivity_dbm: Received power of the weakest frame that it detects.
        phy: Its capability, for 802.11n and later; None for 802.11g, or 802.11n with one stream in 20 MHz, at 2.4
            GHz.
        pattern: Pattern of its antenna; None if it is isotropic.
    """

    standard: Standard
    tx_power_dbm: float
    sensitivity_dbm: float
    phy: PhyCapability | None = None
    pattern: Dipole | GainTable | None = None

    @property
    def band(self) -> Band:
        """The band in which it sends."""
        return BAND_2_4 if self.phy is None else self.phy.band

    def supports(self, mode: WifiMode) -> bool:
        """Return True if the station can send and receive frames in this mode."""
        if mode.band is not self.band:
            return False
        if self.phy is not None:
            return mode in OFDM_MODES[self.band.name] or self.phy.supports(mode)
        return mode in G_MODES or (self.standard == "802.11n" and mode in MODES["802.11n"])


def antenna_of(radio: RadioSettings) -> Antenna:
    """Return the antenna of a robot's radio; without `phy` any standard other than 802.11n is treated as 802.11g."""
    standard: Standard = "802.11n" if radio.standard.startswith("802.11n") else "802.11g"
    phy = capability_of(radio.standard, radio.phy)
    power_dbm, sensitivity_dbm = float(radio.tx_power_dbm), float(radio.sensitivity_dbm)
    return Antenna(standard, power_dbm, sensitivity_dbm, phy, pattern_of(radio.antenna))


def decode_antenna(fields: Mapping[str, object]) -> Antenna:
    """Return the antenna whose `dataclasses.asdict` is `fields`."""
    phy, pattern = fields["phy"], fields.get("pattern")
    decoded_fields = {
        "phy": None if phy is None else PhyCapability(**phy),  # type: ignore[arg-type]
        "pattern": None if pattern is None else decode_pattern(pattern),  # type: ignore[arg-type]
    }
    return Antenna(**{**fields, **decoded_fields})  # type: ignore[arg-type]


def modes_between(first: Antenna, second: Antenna) -> tuple[WifiMode, ...]:
    """Return the modes between two stations of one band, slowest first."""
    if first.phy is not None and second.phy is not None:
        return common_modes(first.phy, second.phy)
    # A station with `phy` uses one stream in 20 MHz with a station of 802.11n that has no `phy`.
    names = {antenna.standard if antenna.phy is None else "802.11n" for antenna in (first, second)}
    return MODES["802.11n" if names == {"802.11n"} else "802.11g"]


def band_of(antennas: Mapping[str, Antenna]) -> Band:
    """Return the band of all stations; 2.4 GHz if there are none.

    Raises:
        ConfigurationError: The stations have different bands.
    """
    bands = {antenna.band.name: name for name, antenna in antennas.items()}
    if len(bands) > 1:
        words = ", ".join(f"{name} at {band}" for band, name in bands.items())
        raise ConfigurationError(
            f"radios of different bands cannot communicate: {words}",
            remedy="give the radios of all robots a standard of one band; without phy a radio is at 2.4 GHz",
        )
    return next((antenna.band for antenna in antennas.values()), BAND_2_4)


def fixed_mode(name: str | None, antennas: Mapping[str, Antenna]) -> WifiMode | None:
    """Return the mode in which all stations must send; None if each station chooses its mode.

    Stations of 802.11n and later also support modes of 802.11g, or at 5 GHz of 802.11a.

    Args:
        name: Name of the mode; None if each station chooses its mode.
        antennas: The stations, by name.

    Raises:
        ConfigurationError: A station does not support the mode, or the stations have different bands.
    """
    if name is None:
        return None
    band = band_of(antennas)
    mode = mode_named(name, band)
    for station, antenna in antennas.items():
        if mode is None or not antenna.supports(mode):
            antenna_modes = MODES[antenna.standard] if antenna.phy is None else common_modes(antenna.phy, antenna.phy)
            names = ", ".join(mode.name for mode in (*OFDM_MODES[band.name], *antenna_modes))
            raise ConfigurationError(
                f"radio.mode {name} is not a mode of the radio of {station}",
                remedy=f"use a mode that all stations support; {station} has: {names}",
            )
    return mode
