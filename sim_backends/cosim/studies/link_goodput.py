"""Predict the goodput of a Wi-Fi link from what its radio logs: signal, channel width and MCS.

Each prediction is a run of the scenario `link.yaml`: the transmit power gives the logged signal, the channel does not
fade, and no other station sends.
"""

import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any, Final

import numpy as np

from fieldkit.core.errors import ConfigurationError
from fieldkit.core.executors import Workers
from sim_backends.cosim.scenario.build import build
from sim_backends.cosim.scenario.loading import load_scenario
from sim_backends.cosim.scenario.schema import TX_POWERS_DBM, CosimScenario
from sim_backends.cosim.studies.seeds import ALL_PROCESSORS, Task, run_many
from sim_backends.radio.phy.high_throughput import mode_named
from sim_backends.radio.phy.modes import BANDS, OFDM_MODES, Band, WifiMode
from sim_backends.radio.propagation.path_loss import free_space_db

SIGNAL_STEP_DB: Final = 0.5
"""Signals are rounded to this step, so that links with nearly the same signal are simulated once."""

_SCENARIO: Final = Path(__file__).with_name("link.yaml")
_POLICY: Final = "event_driven"

_STANDARD: Final = re.compile(r"802\.11(?P<amendment>a|g|n|ac|ax)(?: (?P<band>2\.4 GHz|5 GHz|6 GHz))?")
_PREFIXES: Final = {"n": "ht", "ac": "vht", "ax": "he"}
"""Beginning of the names of modes, by amendment."""
_ONLY_BANDS: Final = {"a": "5 GHz", "g": "2.4 GHz"}
_MCS_PER_STREAM: Final = 8
"""Number of MCS with one stream in 802.11n, which continues the numbers for two streams."""

_START_S: Final = 0.5
"""Time that is not measured: TCP's slow start, and the first selections of a rate control."""
_MEASURED_PACKETS: Final = 3000
"""Approximate number of packets that the slower of radio and bus could carry while the goodput is measured."""
_MEASURED_S: Final = (0.2, 2.0)
"""Shortest and longest time during which the goodput is measured."""
_SELECTED_S: Final = 1.0
"""Shortest time if the link selects its modes: 20 updates of minstrel_ht."""

_QUEUE_S: Final = 1 / 128
"""Time to which Linux limits the data of a connection in the queue of a Wi-Fi radio: mac80211 sets sk_pacing_shift
(net/core/sock.c) to 7."""
_MIN_QUEUE_PACKETS: Final = 64
_PACKET_BITS: Final = 12_000
"""Size of an IP packet of 1,500 bytes."""

_DATAGRAM_BYTES: Final = 1460
"""Payload of a UDP datagram, so that a packet is as long as a segment of TCP without options."""


@dataclass(frozen=True)
class LoggedLink:
    """What a radio logs about a link.

    Attributes:
        signal_dbm: Power of the received frames.
        standard: Standard, and from 802.11n on its band: `802.11g`, `802.11ac 5 GHz`.
        width_mhz: Channel width.
        streams: Number of spatial streams; with `phy_rate_bit_s`, the largest number.
        guard_interval_ns: Guard interval.
        mcs: MCS as the standard numbers it: in 802.11n, 8 to 15 have two streams. None if it is not logged. 802.11a
            and g have none.
        phy_rate_bit_s: PHY rate, or a mean of PHY rates; the link uses the mode with the nearest rate. None if it is
            not logged. Without MCS and PHY rate, the link selects its modes as Linux's minstrel_ht does.
        protocol: Transport, `tcp` or `udp`.
    """

    signal_dbm: float
    standard: str = "802.11n 2.4 GHz"
    width_mhz: int = 20
    streams: int = 1
    guard_interval_ns: int = 800
    mcs: int | None = None
    phy_rate_bit_s: float | None = None
    protocol: str = "tcp"

    @property
    def band(self) -> Band:
        """The band.

        Raises:
            ConfigurationError: The standard is unknown, or its band is missing.
        """
        return BANDS[self._split_standard()[1]]

    def _split_standard(self) -> tuple[str, Any]:
        match = _STANDARD.fullmatch(self.standard)
        amendment, band_name = match.groups() if match is not None else ("", None)
        band_name = band_name or _ONLY_BANDS.get(amendment)
        if band_name is None:
            raise ConfigurationError(
                f"the standard {self.standard!r} is unknown",
                remedy="write 802.11a, 802.11g, or a later standard with its band: 802.11n 2.4 GHz, 802.11ac 5 GHz",
            )
        return amendment, band_name

    def mode(self) -> WifiMode | None:
        """Return the mode of all data frames; None if the link selects its modes.

        Raises:
            ConfigurationError: The radio model has no such mode.
        """
        modes = self._modelled_modes()
        if self.mcs is not None:
            return modes[0]
        if self.phy_rate_bit_s is None:
            return None
        rate_bit_s = self.phy_rate_bit_s
        return min(modes, key=lambda mode: abs(mode.rate_bit_s - rate_bit_s))

    def _modelled_modes(self) -> list[WifiMode]:
        """Return the modes that the link can have: only that of the logged MCS, if there is one.

        Raises:
            ConfigurationError: The radio model has no such mode, or it cannot select among them.
        """
        modes = list(self._modes())
        if not modes:
            mcs = "" if self.mcs is None else f"MCS {self.mcs}, "
            raise ConfigurationError(
                f"{self.standard} with {mcs}{self.width_mhz} MHz, {self.streams} streams and a guard interval of "
                f"{self.guard_interval_ns} ns is not modelled"
            )
        if self._split_standard()[0] == "a" and self.phy_rate_bit_s is None:
            raise ConfigurationError("802.11a without a PHY rate is not modelled")
        return modes

    def _fastest_bit_s(self) -> float:
        """Return the PHY rate of the link, or the largest one if the link selects its modes."""
        mode = self.mode()
        return max(mode.rate_bit_s for mode in self._modelled_modes()) if mode is None else mode.rate_bit_s

    def _modes(self) -> Iterator[WifiMode]:
        """Yield the mode with the logged MCS; without MCS, all modes with up to `streams` streams."""
        amendment, band_name = self._split_standard()
        if amendment not in _PREFIXES:
            if self.mcs is None:
                yield from OFDM_MODES[band_name]
            return
        all_streams = range(1, self.streams + 1) if self.mcs is None else (self._streams,)
        numbers = range(2 * _MCS_PER_STREAM) if self.mcs is None else (self.mcs,)
        for streams, number in product(all_streams, numbers):
            name = f"{_PREFIXES[amendment]}{self.width_mhz}-mcs{number}-{streams}ss-{self.guard_interval_ns}ns"
            if (mode := mode_named(name, BANDS[band_name])) is not None:
                yield mode

    @property
    def _streams(self) -> int:
        """Number of streams; with an MCS of 802.11n, the number that this MCS has."""
        if self._split_standard()[0] == "n" and self.mcs is not None:
            return self.mcs // _MCS_PER_STREAM + 1
        return self.streams

    def scenario(self, changes: Mapping[str, Any]) -> CosimScenario:
        """Return the scenario of a saturated link.

        Args:
            changes: Values that replace values of the scenario `link.yaml`, by their keys.

        Raises:
            ConfigurationError: The link is not modelled, or a change is invalid.
        """
        rate_bit_s = self._fastest_bit_s()
        scenario = self._scenario_at(rate_bit_s, changes)
        if packet_s := _packet_s(scenario):
            scenario = self._scenario_at(min(rate_bit_s, _PACKET_BITS / packet_s), changes)
        if scenario.duration_ns <= _START_S * 1e9:
            raise ConfigurationError(f"the first {_START_S:g} s of a run are not measured; set a longer duration")
        return scenario

    def _scenario_at(self, rate_bit_s: float, changes: Mapping[str, Any]) -> CosimScenario:
        """Return the scenario with the traffic, queue and duration for the rate of its slower part, radio or bus."""
        amendment, _ = self._split_standard()
        mode = self.mode()
        duration_s = _START_S + self._measured_s(rate_bit_s)
        loss_db = float(free_space_db(np.zeros((1, 3)), np.array([[1.0, 0.0, 0.0]]), self.band.carrier_hz)[0])
        tx_power_dbm = self.signal_dbm + loss_db
        if not TX_POWERS_DBM[0] <= tx_power_dbm <= TX_POWERS_DBM[1]:
            low_dbm, high_dbm = (power_dbm - loss_db for power_dbm in TX_POWERS_DBM)
            raise ConfigurationError(
                f"signals below {low_dbm:.1f} dBm or above {high_dbm:.1f} dBm are not modelled at {self.band.name}"
            )
        radio: dict[str, Any] = {"standard": self.standard, "tx_power_dbm": tx_power_dbm}
        if amendment != "g":
            radio["standard"] = "802.11n 5 GHz" if amendment == "a" else self.standard
            radio["phy"] = {
                "width_mhz": self.width_mhz,
                "streams": self._streams,
                "guard_interval_ns": self.guard_interval_ns,
                "rate_control": "minstrel_ht",
            }
        values: dict[str, Any] = {
            "duration": f"{duration_s:.3f}s",
            "traffic": [self._traffic(rate_bit_s, duration_s)],
            "radio.queue_packets": max(_MIN_QUEUE_PACKETS, math.ceil(rate_bit_s * _QUEUE_S / _PACKET_BITS)),
        }
        for agent in ("sender", "receiver"):
            values |= {f"agents.{agent}.radio.{key}": value for key, value in radio.items()}
        if mode is not None:
            values["radio.mode"] = mode.name
        return load_scenario(_SCENARIO, values | dict(changes))

    def _traffic(self, rate_bit_s: float, duration_s: float) -> dict[str, Any]:
        """Return traffic that is never slower than `rate_bit_s`: a file for TCP, a stream of datagrams for UDP.

        Raises:
            ConfigurationError: The protocol is neither TCP nor UDP.
        """
        ends = {"name": "load", "from": "sender", "to": "receiver", "protocol": self.protocol}
        match self.protocol:
            case "tcp":
                return ends | {"kind": "file", "size_bytes": math.ceil(rate_bit_s * duration_s / 8)}
            case "udp":
                rate_hz = math.ceil(rate_bit_s / 8 / _DATAGRAM_BYTES)
                return ends | {"kind": "stream", "size_bytes": _DATAGRAM_BYTES, "rate": f"{rate_hz}Hz"}
            case _:
                raise ConfigurationError(f"the protocol {self.protocol!r} is unknown", remedy="write tcp or udp")

    def _measured_s(self, rate_bit_s: float) -> float:
        """Return the time during which the goodput is measured."""
        shortest_s, longest_s = _MEASURED_S
        measured_s = min(max(_MEASURED_PACKETS * _PACKET_BITS / rate_bit_s, shortest_s), longest_s)
        return max(measured_s, _SELECTED_S) if self.mode() is None else measured_s


def _packet_s(scenario: CosimScenario) -> float:
    """Return the time that the sender's bus and driver need per packet."""
    radio = scenario.agents["sender"].radio
    return 0.0 if radio is None or radio.phy is None else float(radio.phy.packet_time)


def predict_goodputs_bit_s(
    links: Sequence[LoggedLink],
    changes: Mapping[str, Any],
    *,
    workers: Workers = ALL_PROCESSORS,
    progress: Callable[[int], None] | None = None,
) -> dict[LoggedLink, float | ConfigurationError]:
    """Return the predicted goodput of each link: payload bits that arrive per second; or why it is not modelled.

    Args:
        links: The links.
        changes: Values that replace values of the scenario, by their keys.
        workers: The workers that run the simulations.
        progress: Called with the number of finished runs, or None.

    Raises:
        FieldkitError: A run failed.
    """
    results: dict[LoggedLink, float | ConfigurationError] = {}
    scenarios: dict[str, CosimScenario] = {}
    modelled: list[LoggedLink] = []
    for link in dict.fromkeys(links):
        try:
            scenarios[str(len(modelled))] = link.scenario(changes)
            modelled.append(link)
        except ConfigurationError as error:
            results[link] = error
    tasks = [Task(_POLICY, 1, name) for name in scenarios]
    goodputs = run_many(partial(_goodput_bit_s, scenarios), tasks, workers=workers, progress=progress)
    return results | dict(zip(modelled, goodputs, strict=True))


def _goodput_bit_s(scenarios: Mapping[str, CosimScenario], task: Task) -> float:
    """Return the payload bits that arrive per second after the start."""
    scenario = scenarios[task.setup]
    start_ns = round(_START_S * 1e9)
    run = build(scenario, policy=task.policy, seed=task.seed).run()
    arrived_bytes = sum(
        fate.packet.size_bytes
        for fate in run.fates.values()
        if fate.counted_ns is not None and fate.counted_ns > start_ns
    )
    return arrived_bytes * 8e9 / (scenario.duration_ns - start_ns)
