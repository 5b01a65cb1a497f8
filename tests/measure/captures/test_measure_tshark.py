"""Captures of all link types compared with tshark's output; its version and command are in tests/data/README.md."""

from ipaddress import ip_address
from pathlib import Path

from fieldkit.measure.captures import pcap
from tests.helpers.dissected import rows
from tests.helpers.paths import DATA

TSHARK = DATA / "tshark" / "4.0.17"


def _number(text: str, *, missing: int = 0) -> int:
    return int(text, 0) if text else missing


def _address(text: str) -> int:
    address = ip_address(text)
    return int(address) | (0xFFFF << 32 if address.version == 4 else 0)


def _printed(path: Path) -> list[tuple[int, ...]]:
    """Return time, length, addresses, IP id, offset, ports, TCP numbers, flags, MSS and payload, and UDP length."""
    printed_rows: list[tuple[int, ...]] = []
    for line in path.read_text().splitlines():
        cells = line.split(",")
        seconds, rest = cells[0].split(".")
        either = {name: cells[at] or cells[at + 1] for name, at in (("id", 6), ("offset", 8))}
        ports = [next((cells[at] for at in (first, first + 2, first + 4) if cells[at]), "") for first in (11, 12)]
        printed_rows.append((
            int(seconds + rest),
            int(cells[1]),
            _address(cells[2] or cells[4]),
            _address(cells[3] or cells[5]),
            _number(either["id"]),
            _number(either["offset"]) * 8,
            *(_number(port, missing=-1) for port in ports),
            *map(_number, cells[17:23]),
        ))  # fmt: skip
    return printed_rows


def test_columns_equal_what_tshark_printed() -> None:
    capture = pcap.read(TSHARK / "mixed.pcapng")
    # tshark did not print: the protocol after extension headers, more_fragments, lengths of header and payload,
    # TCP time stamps, and identifiers of echoes.
    columns = [(*row[:4], *row[5:7], *row[10:15], *row[16:19]) for row in rows(capture.packets)]
    assert columns == _printed(TSHARK / "mixed.csv")
    assert (capture.frames, capture.frames - len(capture.packets), capture.damage) == (357, 0, None)
