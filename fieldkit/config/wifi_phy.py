"""Physical layer of a robot's Wi-Fi with 802.11n or later: the keys of `radio.phy` and their valid combinations."""

import re
from typing import Annotated, Final, Literal, cast

from fieldkit.config import schema
from fieldkit.config.schema import Bool, Duration, Field, Int, Number, Strict

WifiAmendment = Literal["n", "ac", "ax"]
WifiBand = Literal["2.4 GHz", "5 GHz", "6 GHz"]
DscpMapping = Literal["linux", "rfc8325"]
WifiRateControl = Literal["minstrel", "minstrel_ht", "firmware"]

_STANDARD: Final = re.compile(r"802\.11(n|ac|ax) (2\.4 GHz|5 GHz|6 GHz)")
# IEEE 802.11-2020, 19.1.1 and 21.1.1; 802.11ax-2021, 27.1.1: VHT only at 5 GHz; 80 MHz of HE only at 5 and 6 GHz.
_BANDS: Final[dict[WifiAmendment, tuple[WifiBand, ...]]] = {
    "n": ("2.4 GHz", "5 GHz"),
    "ac": ("5 GHz",),
    "ax": ("2.4 GHz", "5 GHz", "6 GHz"),
}
_STANDARDS: Final = tuple(f"802.11{amendment} {band}" for amendment, bands in _BANDS.items() for band in bands)
_GUARD_INTERVALS_NS: Final[dict[WifiAmendment, tuple[int, ...]]] = {
    "n": (400, 800),
    "ac": (400, 800),
    "ax": (800, 1600, 3200),
}
_MODELLED_WIDTHS_MHZ: Final = (20, 40, 80)

_AMSDU_BYTES: Final = (3839, 7935, 11454)
"""Maximum sizes: IEEE 802.11-2020, table 9-25. The last one is the size of the frame with the A-MSDU."""


class WifiPhy(Strict):
    """The physical layer of 802.11n, ac or ax, as the emulated radio models it.

    Without this key 802.11n has one stream in 20 MHz without aggregation, and later standards are treated as 802.11g.

    Attributes:
        width_mhz: Channel width: 20, 40 or 80 MHz.
        streams: Number of spatial streams, 1 or 2.
        guard_interval_ns: Shortest guard interval: 400 or 800 ns for 802.11n and ac, 800, 1600 or 3200 ns for
            802.11ax.
        rate_control: Algorithm that selects its rates: `minstrel_ht` of Linux (SoftMAC drivers), `firmware` for
            radios whose firmware selects them (brcmfmac, iwlwifi, ath10k), or `minstrel`, the algorithm of Linux for
            802.11g.
        firmware_margin_db: Rate control `firmware`: margin in dB below the measured signal, 0 to 20.
        firmware_interval: Rate control `firmware`: time between two selections of a rate, 1 ms to 10 s.
        rts_threshold_bytes: Size of the largest frame or aggregate that it sends without RTS and CTS; without this
            key it sends no RTS, as with `iw phy PHY set rts off`.
        access_categories: Mapping of the DSCP of a packet to one of the four access categories of EDCA: `linux` (by
            the upper three bits, as Linux up to 6.7 does) or `rfc8325`. Without this key all packets are best
            effort.
        amsdu_max_bytes: Maximum size of an A-MSDU (several packets in one frame of an aggregate): 3839, 7935 or 11454
            (only 802.11ac, and 802.11ax at 5 or 6 GHz). A-MSDUs are used between robots that both have this key, up
            to the smaller of their sizes. 7935 is 4065 in modes of 802.11n, whose aggregates have frames of at most
            4095 bytes. Without this key each frame contains one packet.
        power_save: True if it uses power save as a station of an access point (topology `master`), as Linux does by
            default, also on a Raspberry Pi (`iw dev wlan0 get power_save`).
        packet_time: Time that its bus (SDIO) and driver need for each packet that it sends, one after another, before
            the packet is in the queue of the radio.
        power_save_timeout: Time from its last frame until it dozes, 1 ms to 10 s; 100 ms in mac80211.
    """

    width_mhz: Int = 20
    streams: Int = 1
    guard_interval_ns: Int = 800
    rate_control: WifiRateControl = "minstrel"
    firmware_margin_db: Annotated[Number | Int, Field(ge=0, le=20)] = 3.0
    firmware_interval: Annotated[Duration, Field(ge=0.001, le=10)] = 0.1
    rts_threshold_bytes: Annotated[Int, Field(ge=0, le=10_000_000)] | None = None
    access_categories: DscpMapping | None = None
    packet_time: Annotated[Duration, Field(ge=0, le=0.1)] = 0.0
    amsdu_max_bytes: Int | None = None
    power_save: Bool = False
    power_save_timeout: Annotated[Duration, Field(ge=0.001, le=10)] = 0.1

    @schema.model_validator(mode="after")
    def _require_modelled_values(self) -> "WifiPhy":
        if self.width_mhz not in _MODELLED_WIDTHS_MHZ:
            raise schema.validation_error(
                f"a width of {self.width_mhz} MHz is not modelled; write 20, 40 or 80", "width_mhz"
            )
        if self.streams not in {1, 2}:
            raise schema.validation_error(f"{self.streams} streams are not modelled; write 1 or 2", "streams")
        if self.amsdu_max_bytes not in {None, *_AMSDU_BYTES}:
            raise schema.validation_error(
                f"there is no A-MSDU size of {self.amsdu_max_bytes} bytes; write {_join_words(_AMSDU_BYTES)}",
                "amsdu_max_bytes",
            )
        valid = sorted({interval for intervals in _GUARD_INTERVALS_NS.values() for interval in intervals})
        if self.guard_interval_ns not in valid:
            raise schema.validation_error(
                f"there is no guard interval of {self.guard_interval_ns} ns; write {_join_words(valid)}",
                "guard_interval_ns",
            )
        return self

    def incompatibility(self, standard: str) -> str | None:
        """Return the reason why a radio of a standard, `802.11ac 5 GHz`, cannot have these values; None if it can."""
        match = _STANDARD.fullmatch(standard)
        if match is None:
            return f"phy needs a standard with its band, not {standard!r}; write one of: {', '.join(_STANDARDS)}"
        amendment, band = cast("tuple[WifiAmendment, WifiBand]", match.groups())
        if band not in _BANDS[amendment]:
            return f"802.11{amendment} does not exist at {band}; it exists at {', '.join(_BANDS[amendment])}"
        widths_mhz = _widths_mhz(amendment, band)
        if self.width_mhz not in widths_mhz:
            return f"{standard} has no width of {self.width_mhz} MHz; write phy.width_mhz: {_join_words(widths_mhz)}"
        if self.amsdu_max_bytes == _AMSDU_BYTES[-1] and (amendment == "n" or band == "2.4 GHz"):
            return (
                f"{standard} has no A-MSDU of {_AMSDU_BYTES[-1]} bytes; write phy.amsdu_max_bytes: "
                f"{_join_words(_AMSDU_BYTES[:-1])}"
            )
        intervals_ns = _GUARD_INTERVALS_NS[amendment]
        if self.guard_interval_ns not in intervals_ns:
            return (
                f"802.11{amendment} has no guard interval of {self.guard_interval_ns} ns; "
                f"write phy.guard_interval_ns: {_join_words(intervals_ns)}"
            )
        return None

    def split_standard(self, standard: str) -> tuple[WifiAmendment, WifiBand]:
        """Return amendment and band of a standard for which `incompatibility` returns None."""
        match = _STANDARD.fullmatch(standard)
        assert match is not None
        return cast("tuple[WifiAmendment, WifiBand]", match.groups())


def check_standard(standard: str, phy: WifiPhy | None) -> None:
    """Raise a validation error if a radio of this standard cannot have this physical layer."""
    if phy is not None and (reason := phy.incompatibility(standard)) is not None:
        raise schema.validation_error(reason, "standard")


def _widths_mhz(amendment: WifiAmendment, band: WifiBand) -> tuple[int, ...]:
    return (20, 40) if amendment == "n" or band == "2.4 GHz" else _MODELLED_WIDTHS_MHZ


def _join_words(values: tuple[int, ...] | list[int]) -> str:
    *first, last = map(str, values)
    return f"{', '.join(first)} or {last}"
