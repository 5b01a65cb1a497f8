"""Reading of CSV and GPX files with positions; errors name the file and the line."""

import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fieldkit.core.errors import EvidenceError
from fieldkit.measure.positions import position_files
from fieldkit.measure.positions.samples import LOCAL, WGS84, read_csv

S = 10**9
NOON_NS = 1_795_348_800 * S
GPX = """\
<?xml version="1.0" encoding="UTF-8"?>
<gpx version="1.1" creator="OsmAnd" xmlns="http://www.topografix.com/GPX/1/1">
  <metadata><time>2026-11-22T11:00:00Z</time></metadata>
  <wpt lat="48.0" lon="11.0"><name>car park</name></wpt>
  <trk><name>walk</name><trkseg>
    <trkpt lat="48.137400" lon="11.575500"><ele>520.5</ele><time>2026-11-22T12:00:00Z</time></trkpt>
    <trkpt lat="48.137500" lon="11.575600"><time>2026-11-22T12:00:01.250Z</time></trkpt>
  </trkseg><trkseg>
    <trkpt lat="48.137600" lon="11.575700"><ele>521</ele><time>2026-11-22T14:00:03+02:00</time></trkpt>
  </trkseg></trk>
</gpx>
"""


def write_file(folder: Path, text: str, name: str = "walk.csv") -> Path:
    path = folder / name
    path.write_text(text, encoding="utf-8")
    return path


def test_lengths_are_read_in_any_unit_and_column_order(tmp_path: Path) -> None:
    text = "\ufeffy_ft,note,t,x_cm\n10,begin,2026-11-22T12:00:00Z,-50\n20,,2026-11-22T14:00:00.000001+02:00,50\n"
    samples = read_csv(write_file(tmp_path, text))
    assert samples.frame == LOCAL
    assert samples.times_ns.tolist() == [NOON_NS, NOON_NS + 1000]
    assert samples.values == pytest.approx(np.array([[-0.5, 3.048, 0], [0.5, 6.096, 0]]))


@pytest.mark.parametrize(
    ("name", "first", "second"),
    [
        ("t_s", "1795348800", "1795348800.000000001"),
        ("t_ms", "1795348800000", "1795348800000.000001"),
        ("t_us", "1795348800000000", "1795348800000000.001"),
        ("t_ns", "1795348800000000000", "1795348800000000001"),
    ],
)
def test_times_in_any_unit_keep_every_nanosecond(tmp_path: Path, name: str, first: str, second: str) -> None:
    samples = read_csv(
        write_file(tmp_path, f"{name},lat,lon_deg,alt_m\n{first},48.1,11.5,520\n{second},48.1,11.5,521\n")
    )
    assert samples.frame == WGS84
    assert samples.times_ns.tolist() == [NOON_NS, NOON_NS + 1]
    assert samples.values.tolist() == [[48.1, 11.5, 520], [48.1, 11.5, 521]]


def test_an_unknown_height_is_not_zero(tmp_path: Path) -> None:
    assert math.isnan(read_csv(write_file(tmp_path, "t_s,lat,lon\n1,48.1,11.5\n")).values[0, 2])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "has 0 time columns"),
        ("t,x_m,y_m\n", "has no position with a time"),
        ("t,x,y\n2026-11-22T12:00:00Z,1,2\n", "has no complete set of position columns"),
        ("t,lat,x_m\n2026-11-22T12:00:00Z,1,2\n", "has no complete set of position columns"),
        ("t,lat,lon,x_m,y_m\n2026-11-22T12:00:00Z,1,2,3,4\n", "has no complete set of position columns"),
        ("x_m,y_m\n1,2\n", "has 0 time columns"),
        ("t,t_s,x_m,y_m\n1,2,3,4\n", "has 2 time columns"),
        ("t,x_m,y_m\n2026-11-22T12:00:00,1,2\n", "csv:2: '2026-11-22T12:00:00' has no time zone"),
        ("t,x_m,y_m\nnoon,1,2\n", "csv:2: 'noon' is not a time"),
        ("t_s,x_m,y_m\n1e3,1,2\n", "csv:2: '1e3' is not a time"),
        ("t_s,x_m,y_m\n1.795348800e09,1,2\n", "csv:2: '1.795348800e09' is not a time"),
        ("t_s,x_m,y_m\n1_000,1,2\n", "csv:2: '1_000' is not a time"),
        ("t_s,x_m,y_m\n-0.5,1,2\n", "csv:2: a time is before 1970"),
        ("t_s,x_m,y_m\n-1,1,2\n", "csv:2: a time is before 1970"),
        ("t_s,x_m,y_m\n1,1,2\n1,1,2\n", "csv:3: a time occurs twice"),
        ("t_s,x_m,y_m\n2,1,2\n\n1,1,2\n", "csv:4: a time is earlier than the previous one"),
        ("t_s,x_m,y_m\n1,nan,2\n", "csv:2: 'nan' is not a valid coordinate"),
        ("t_s,x_m,y_m\n1,,2\n", "csv:2: '' is not a valid coordinate"),
        ("t_s,x_m,y_m\n1,inf,2\n", "csv:2: 'inf' is not a valid coordinate"),
        ("t_s,lat,lon\n1,91,2\n", "csv:2: '91' is not a valid coordinate"),
        ("t_s,x_m,y_m\n1,2\n", "csv:2: has 2 cells, but the header has 3"),
        ('t_s,x_m,y_m\n1,"2,3\n', "is not valid CSV"),
    ],
)
def test_invalid_positions_and_times_are_rejected_with_their_line(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(EvidenceError, match=message):
        read_csv(write_file(tmp_path, text))


@pytest.mark.parametrize(
    ("text", "remedy"),
    [("t,x_m,y_m\nnoon,1,2\n", "2026-11-22T10:00:00.5Z"), ("t_ms,x_m,y_m\n1.7e12,1,2\n", "t_ms is in ms")],
)
def test_the_remedy_for_an_invalid_time_fits_its_column(tmp_path: Path, text: str, remedy: str) -> None:
    with pytest.raises(EvidenceError) as error_info:
        read_csv(write_file(tmp_path, text))
    assert remedy in error_info.value.remedy


@given(st.text(alphabet='t_snxy,m\n"1.-eZ:latlo', max_size=60))
def test_any_content_raises_only_evidence_error(tmp_path_factory: pytest.TempPathFactory, text: str) -> None:
    path = write_file(tmp_path_factory.getbasetemp(), text)
    try:
        samples = read_csv(path)
    except EvidenceError:
        return
    assert (np.diff(samples.times_ns) > 0).all()
    assert np.isfinite(samples.values[:, :2]).all()


def test_gpx_tracks_are_read(tmp_path: Path) -> None:
    samples = position_files.read_file(write_file(tmp_path, GPX, "walk.GPX"))
    assert samples.frame == WGS84
    assert (samples.times_ns - NOON_NS).tolist() == [0, 1_250_000_000, 3_000_000_000]
    assert samples.values[:, :2].tolist() == [[48.1374, 11.5755], [48.1375, 11.5756], [48.1376, 11.5757]]
    assert samples.values[[0, 2], 2].tolist() == [520.5, 521]
    assert math.isnan(samples.values[1, 2])


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("</gpx>", "", "cannot be read as GPX"),
        (GPX, "", "cannot be read as GPX"),
        ("12:00:00Z</time></trkpt>", "12:00:00</time></trkpt>", "a time has no time zone"),
        ("<time>2026-11-22T12:00:01.250Z</time>", "", "1 of 3 points have no time"),
        ("12:00:01.250Z", "12:00:00Z", "point 2: a time occurs twice"),
        ("12:00:01.250Z", "12:00:04Z", "point 3: a time is earlier than the previous one"),
        ('lat="48.137500"', 'lat="95"', "invalid coordinates|cannot be read as GPX"),
        ('lat="48.137500"', 'lat="nan"', "invalid coordinates|cannot be read as GPX"),
        ("trkpt", "rtept", "cannot be read as GPX|has no position with a time"),
    ],
)
def test_gpx_without_valid_positions_and_times_is_rejected(tmp_path: Path, old: str, new: str, message: str) -> None:
    assert old in GPX
    with pytest.raises(EvidenceError, match=message):
        position_files.read_file(write_file(tmp_path, GPX.replace(old, new), "walk.gpx"))


def test_gpx_that_expands_while_it_is_read_is_rejected(tmp_path: Path) -> None:
    entities = "".join(f'<!ENTITY e{n} "{f"&e{n - 1};" * 10}">' for n in range(1, 10))
    entity_expansion = (
        f'<?xml version="1.0"?><!DOCTYPE gpx [<!ENTITY e0 "boom">{entities}]><gpx><trk><name>&e9;</name></trk></gpx>'
    )
    with pytest.raises(EvidenceError, match="cannot be read as GPX"):
        position_files.read_file(write_file(tmp_path, entity_expansion, "walk.gpx"))


def test_other_file_types_are_rejected(tmp_path: Path) -> None:
    with pytest.raises(EvidenceError, match="neither GPX nor CSV"):
        position_files.read_file(write_file(tmp_path, GPX, "walk.kml"))
