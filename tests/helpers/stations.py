"""Stations on one radio channel with given signal strengths, and saturated traffic between them."""

from collections.abc import Sequence

from sim_backends.radio.mac.channel import RadioChannel
from sim_backends.radio.mac.frames import TransmissionAttempt
from sim_backends.radio.phy.modes import WifiMode
from sim_backends.radio.rate_control.rate_control import FixedRate, RateControl
from sim_backends.radio.wifi import Wifi

NOISE_MW = 1e-9
SENSITIVITY_MW = 1e-8
STRONG_MW = 1e-4

HEADERS_BYTES = 28


class FixedPowers(RadioChannel):
    """A channel on which all stations receive each other equally well, except the pairs in `without_link`."""

    def __init__(self, names: Sequence[str], mode: WifiMode, *, without_link: Sequence[tuple[str, str]] = ()) -> None:
        self.names = tuple(names)
        self.noise_mw = [NOISE_MW] * len(names)
        self.sensitivity_mw = [SENSITIVITY_MW] * len(names)
        self._mode = mode
        self.rows = [[0.0 if receiver == transmitter else STRONG_MW for receiver in names] for transmitter in names]
        for pair in without_link:
            first, second = (self.names.index(name) for name in pair)
            self.rows[first][second] = self.rows[second][first] = 0.0

    def powers_mw(self, transmitter: int, now_ns: int) -> list[float]:
        return self.rows[transmitter]

    def are_linked(self, transmitter: int, receiver: int) -> bool:
        return True

    def delay_ns(self, transmitter: int, receiver: int) -> int:
        return 0

    def rate_control(self, transmitter: int, receiver: int) -> RateControl:
        return FixedRate(self._mode)


def saturate(
    channel: RadioChannel,
    senders: Sequence[str],
    receiver: str,
    *,
    seconds: float,
    payload_bytes: int = 1000,
    queued: int = 50,
    relay: str | None = None,
    seed: int = 1,
    log: list[TransmissionAttempt] | None = None,
) -> dict[str, float]:
    """UDP goodput of each sender in bit/s; each sender always has packets in its queue."""
    wifi: Wifi[str] = Wifi(channel, seed)
    wifi.log_attempts(None if log is None else log.append)
    wifi.set_relay(relay)
    arrived_packets = dict.fromkeys(senders, 0)
    for name in senders:
        for _ in range(queued):
            wifi.send(0, name, name, payload_bytes + HEADERS_BYTES, receiver)
    end_ns = round(seconds * 1e9)
    while (now_ns := wifi.next_event_ns()) is not None and now_ns < end_ns:
        for at_ns, _, name, _, _ in wifi.deliveries(now_ns):
            arrived_packets[name] += 1
            wifi.send(at_ns, name, name, payload_bytes + HEADERS_BYTES, receiver)
    return {name: count * payload_bytes * 8 / seconds for name, count in arrived_packets.items()}
