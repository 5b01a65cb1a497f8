"""The parts of the virtual machine: what is missing, and which kernel is used."""

import gzip
import lzma
import struct
from pathlib import Path

import pytest

from fieldkit.core.errors import ConfigurationError
from sim_backends.emulated.linux_wifi.initrd import MODULES, build_initrd
from sim_backends.emulated.linux_wifi.virtual_machine import (
    MESH_PACKAGE_OF,
    PACKAGE_OF,
    find_kernel,
    require_machine,
    uncompressed_kernel,
)
from sim_backends.emulated.robot.mesh_options import MeshOptions


def test_all_missing_programs_are_listed_with_their_packages(tmp_path: Path) -> None:
    with pytest.raises(ConfigurationError) as error_info:
        require_machine((tmp_path,))
    assert "qemu-system-x86_64" in error_info.value.what
    for package in ("qemu-system-x86", "linux-image-amd64", "iw", "hostapd", "wpasupplicant", "busybox"):
        assert f" {package}" in error_info.value.remedy


@pytest.mark.parametrize(("protocol", "program"), [("babel", "babeld"), ("batman-adv", "batctl")])
def test_a_mesh_needs_its_program(tmp_path: Path, protocol: str, program: str) -> None:
    mesh = MeshOptions.model_validate({"protocol": protocol})
    with pytest.raises(ConfigurationError) as error_info:
        require_machine((tmp_path,), mesh=mesh)
    assert f" {program}" in error_info.value.remedy
    with pytest.raises(ConfigurationError) as error_info:
        require_machine((tmp_path,))
    assert program not in error_info.value.remedy


@pytest.mark.parametrize(("protocol", "modules"), [("babel", ()), ("batman-adv", ("batman_adv",))])
def test_the_module_batman_adv_is_loaded_only_for_its_mesh(
    tmp_path: Path, protocol: str, modules: tuple[str, ...]
) -> None:
    for program in (*PACKAGE_OF, *MESH_PACKAGE_OF):
        path = tmp_path / "usr/sbin" / program
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch(mode=0o755)
    (tmp_path / "boot").mkdir()
    (tmp_path / "boot/vmlinuz-6.1.0-50-amd64").touch()
    (tmp_path / "lib/modules/6.1.0-50-amd64").mkdir(parents=True)
    (tmp_path / "lib/modules/6.1.0-50-amd64/mac80211_hwsim.ko").touch()
    kernel = require_machine((tmp_path,), mesh=MeshOptions.model_validate({"protocol": protocol}))
    assert kernel.extra_modules == modules


def test_a_kernel_without_the_module_batman_adv_is_reported(tmp_path: Path) -> None:
    for name in MODULES:
        (tmp_path / f"{name}.ko").touch()
    build_initrd(tmp_path, radios=1, job="job", output="output")
    with pytest.raises(ConfigurationError, match="batman_adv is missing") as error_info:
        build_initrd(tmp_path, ("batman_adv",), radios=1, job="job", output="output")
    assert "linux-image-amd64" in error_info.value.remedy


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
