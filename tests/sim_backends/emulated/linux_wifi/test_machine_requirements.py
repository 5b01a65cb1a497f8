"""The parts of the virtual machine: what is missing, and which kernel is used."""

import gzip
import lzma
import struct
from pathlib import Path

import pytest

from fieldkit.core.errors import ConfigurationError
from sim_backends.emulated.linux_wifi.virtual_machine import find_kernel, require_machine, uncompressed_kernel


def test_all_missing_programs_are_listed_with_their_packages(tmp_path: Path) -> None:
    with pytest.raises(ConfigurationError) as error_info:
        require_machine((tmp_path,))
    assert "qemu-system-x86_64" in error_info.value.what
    for package in ("qemu-system-x86", "linux-image-amd64", "iw", "hostapd", "wpasupplicant", "busybox"):
        assert f" {package}" in error_info.value.remedy


@pytest.mark.parametrize("suffix", [".ko", ".ko.xz"])
def test_the_newest_kernel_with_hwsim_is_used(tmp_path: Path, suffix: str) -> None:
    for version, has_hwsim in (("6.1.0-9-amd64", True), ("6.1.0-50-amd64", True), ("6.12.0-1-cloud-amd64", False)):
        modules = tmp_path / "lib/modules" / version / "kernel"
        modules.mkdir(parents=True)
        (tmp_path / "boot").mkdir(exist_ok=True)
        (tmp_path / "boot" / f"vmlinuz-{version}").touch()
        if has_hwsim:
            (modules / f"mac80211_hwsim{suffix}").touch()
    kernel = find_kernel((tmp_path / "missing", tmp_path))
    assert kernel is not None
    assert kernel.image.name == "vmlinuz-6.1.0-50-amd64"
    assert kernel.modules == tmp_path / "lib/modules/6.1.0-50-amd64"


@pytest.mark.parametrize("sectors", [4, 39])
def test_a_kernel_is_decompressed_if_it_is_compressed_with_xz(sectors: int) -> None:
    def image(payload: bytes) -> bytes:
        header = bytearray((sectors + 1) * 512)
        header[0x1F1] = sectors
        header[0x202:0x206] = b"HdrS"
        header[0x248:0x250] = struct.pack("<II", 100, len(payload))
        return bytes(header) + bytes(100) + payload + b"rest"

    elf = b"\x7fELF" + bytes(range(256)) * 9
    size = struct.pack("<I", len(elf))
    assert uncompressed_kernel(image(lzma.compress(elf, check=lzma.CHECK_CRC32) + size)) == elf
    gzip_image = image(gzip.compress(elf))
    assert uncompressed_kernel(gzip_image) == gzip_image
    assert uncompressed_kernel(b"HdrS") == b"HdrS"
