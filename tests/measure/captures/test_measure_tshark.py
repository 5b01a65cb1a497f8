"""Captures of all link types against what tshark printed of them; its version and command: tests/data/README.md."""

from ipaddress import ip_address
from pathlib import Path

from fieldkit.measure.captures import pcap
from tests.helpers.dissected import rows
from tests.helpers.paths import DATA

TSHARK = DATA / "tshark" / "4.0.17"


def _number(text: str, *, missing: int = 0) -> int:
    return int(text, 0) if text else missing


def _address(text: str) -> int:
    found = ip_address(text)
    return int(found) | (0xFFFF << 32 if found.version == 4 else 0)


def _printed(path: Path) -> list[tuple[int, ...]]:
    """Time, length, addresses, IP id, offset, ports, TCP's numbers, flags, MSS and payload, UDP's length."""
    found: list[tuple[int, ...]] = []
    for line in path.read_text().splitlines():
        cells = line.split(",")
        seconds, rest = cells[0].split(".")
        either = {name: cells[at] or cells[at + 1] for name, at in (("id", 6), ("offset", 8))}
        ports = [next((cells[at] for at in (first, first + 2, first + 4) if cells[at]), "") for first in (11, 12)]
        found.append((
            int(seconds + rest),
            int(cells[1]),
            _address(cells[2] or cells[4]),
            _address(cells[3] or cells[5]),
            _number(either["id"]),
            _number(either["offset"]) * 8,
            *(_number(port, missing=-1) for port in ports),
            *map(_number, cells[17:23]),
        ))  # fmt: skip
    return found


def test_columns_equal_what_tshark_printed() -> None:
    capture = pcap.read(TSHARK / "mixed.pcapng")
    # Not printed: the protocol behind extension headers, whether fragments follow, lengths of header and payload,
    # time stamps of TCP, and identifiers of echoes.
    columns = [(*row[:4], *row[5:7], *row[10:15], *row[16:19]) for row in rows(capture.packets)]
    assert columns == _printed(TSHARK / "mixed.csv")
    assert (capture.frames, capture.frames - len(capture.packets), capture.damage) == (357, 0, None)
