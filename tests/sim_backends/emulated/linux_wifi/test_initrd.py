"""The initial file system, read by busybox's cpio; the order of modules."""

import struct
import subprocess
from pathlib import Path

import pytest

from fieldkit.core.errors import ConfigurationError
from sim_backends.emulated.linux_wifi.initrd import cpio_archive, module_order, without_signature


def write_module(folder: Path, name: str, depends: str | None) -> None:
    field = b"" if depends is None else f"\0depends={depends}\0".encode()
    (folder / f"{name}.ko").write_bytes(b"\x7fELF" + field + b"\0name=" + name.encode() + b"\0")


def test_modules_follow_their_dependencies_once(tmp_path: Path) -> None:
    for name, depends in (("a", "b,c-d"), ("b", "c_d"), ("c-d", ""), ("e", None), ("unused", "")):
        write_module(tmp_path, name, depends)
    assert list(module_order(tmp_path, ("a", "e", "b"))) == ["c_d", "b", "a", "e"]


def test_a_built_in_module_is_left_out_and_a_missing_one_is_an_error(tmp_path: Path) -> None:
    write_module(tmp_path, "a", "built_in")
    with pytest.raises(ConfigurationError, match="built_in is missing"):
        module_order(tmp_path, ("a",))
    (tmp_path / "modules.builtin").write_text("kernel/lib/built-in.ko\n")
    assert list(module_order(tmp_path, ("a",))) == ["a"]


@pytest.mark.parametrize(("program", "suffix"), [("xz", ".xz"), ("gzip", ".gz")])
def test_compressed_modules_are_decompressed(tmp_path: Path, program: str, suffix: str) -> None:
    for name, depends in (("a", "b-c"), ("b-c", "")):
        write_module(tmp_path, name, depends)
    plain = module_order(tmp_path, ("a",))
    subprocess.run((program, *tmp_path.glob("*.ko")), check=True)
    assert [path.suffix for path in tmp_path.iterdir()] == [suffix] * 2
    assert module_order(tmp_path, ("a",)) == plain
    assert list(plain) == ["b_c", "a"]


def test_the_signature_of_a_module_is_removed() -> None:
    header = struct.pack(">5B3xI", 0, 0, 2, 0, 0, 300)
    assert without_signature(b"\x7fELF" + bytes(300) + header + b"~Module signature appended~\n") == b"\x7fELF"
    assert without_signature(b"\x7fELF unsigned") == b"\x7fELF unsigned"


@pytest.mark.emulated
def test_busybox_reads_the_archive(tmp_path: Path) -> None:
    files = {"init": (0o755, b"#!/bin/sh\n"), "lib/x/odd": (0o644, bytes(range(7))), "lib/empty": (0o600, b"")}
    archive = cpio_archive(files, ("proc",))
    subprocess.run(("/bin/busybox", "cpio", "-id"), input=archive, cwd=tmp_path, check=True, capture_output=True)
    unpacked = {str(path.relative_to(tmp_path)): path for path in tmp_path.rglob("*")}
    assert set(unpacked) == {"init", "lib", "lib/x", "lib/x/odd", "lib/empty", "proc"}
    assert {name: unpacked[name].read_bytes() for name in files} == {
        name: content for name, (_, content) in files.items()
    }
    assert {name: unpacked[name].stat().st_mode & 0o777 for name in files} == {
        name: mode for name, (mode, _) in files.items()
    }
    assert len(archive) % 4 == 0
