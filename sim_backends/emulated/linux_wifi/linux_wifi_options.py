"""The `linux_wifi:` key of the `emulated:` section of a site file."""

from typing import Literal

from fieldkit.config.schema import Bool, Strict


class LinuxWifiOptions(Strict):
    """Settings of [Linux's Wi-Fi](linux-wifi.md); they have no effect without `wifi: linux`.

    Attributes:
        security: Security of the access point: `wpa2` (pre-shared key) or `wpa3` (SAE with protected management
            frames).
        mesh: True for an 802.11s mesh of all robots, in every topology: the kernels forward frames for each other.
        monitor: True to give each robot a monitor interface `mon0`, on which tcpdump captures frames with radiotap.
    """

    security: Literal["wpa2", "wpa3"] = "wpa2"
    mesh: Bool = False
    monitor: Bool = False
