"""Samples of links: files of robots, complete, truncated and compressed, and files of testbeds."""

import gzip
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fieldkit.core.errors import EvidenceError
from fieldkit.core.model import FIXED_ROLES, LinkSample, Role, StationSample
from fieldkit.measure.evidence import link_samples, robot_link_samples
from tests.helpers.paths import DATA

S = 10**9
BOOTED_S = 1_700_000_000
STATE = f"==> clock <==\n100.00 {BOOTED_S + 100}.000000000 100.00\n==> iw station dump <==\n"


def output(name: str) -> str:
    return (DATA / "iw" / f"{name}.txt").read_text(encoding="utf-8")


SAMPLER_OUTPUT = (
    f"==> 101.00 link <==\n{output('link-station')}\n==> 101.00 survey <==\n{output('survey-mt7996-6')}"
    f"==> 101.00 station <==\n{output('station-iwlwifi-6')}"
    "==> 101.20 wireless <==\n0000   54.  -56.  -256        0      0      0      0      0        0\n"
    f"==> 101.40 station <==\n{output('station-iwlwifi-6').replace('3441', '3451')}"
)

COUNTS = st.none() | st.integers(0, 10**18 - 1)
POWERS = st.none() | st.integers(-30000, 1000).map(lambda hundredths: hundredths / 100)
RATES = st.none() | st.integers(1, 10**10)
STATIONS = st.builds(
    StationSample,
    st.sampled_from(("duckiedrone-1", "turtlebot-2")),
    POWERS,
    RATES,
    RATES,
    COUNTS,
    COUNTS,
    COUNTS,
    COUNTS,
)
SAMPLES = st.lists(
    st.builds(
        LinkSample,
        st.integers(0, 2**62),
        st.lists(STATIONS, max_size=2, unique_by=lambda item: item.station).map(tuple),
        st.sampled_from((None, "west", "02:00:00:00:00:01")),
        POWERS,
        COUNTS,
        COUNTS,
    ),
    max_size=5,
    unique_by=lambda item: item.utc_ns,
).map(lambda samples_read: sorted(samples_read, key=lambda item: item.utc_ns))


@given(samples=st.dictionaries(st.sampled_from(FIXED_ROLES), SAMPLES.filter(bool)))
def test_samples_of_a_testbed_are_written_and_read(
    samples: dict[Role, list[LinkSample]], tmp_path_factory: pytest.TempPathFactory
) -> None:
    path = tmp_path_factory.mktemp("links") / link_samples.FILE
    path.write_text(link_samples.text(samples), encoding="ascii")
    assert link_samples.read(path) == samples


@pytest.mark.parametrize("damage", [lambda text: text[:-5], lambda text: text.replace("-5", "x5"), lambda _: ""])
def test_an_incomplete_file_of_a_testbed_is_an_error(tmp_path: Path, damage: "type[str]") -> None:
    sample = LinkSample(5, (StationSample("turtlebot-1", -50.0, 6e6, None, 1, 2, 3, 4),), noise_dbm=-95.0)
    path = tmp_path / link_samples.FILE
    path.write_text(damage(link_samples.text({Role.SENDER: [sample]})), encoding="ascii")
    with pytest.raises(EvidenceError, match="is not a file of link samples"):
        link_samples.read(path)


def test_a_truncated_file_of_a_testbed_is_an_error_and_an_earlier_format_is_read(tmp_path: Path) -> None:
    samples = {Role.SENDER: [LinkSample(at_ns, noise_dbm=-95.0) for at_ns in range(3)]}
    path, content = tmp_path / link_samples.FILE, link_samples.text(samples)
    count, *lines = content.splitlines(keepends=True)
    path.write_text("".join([count, *lines[:-1]]), encoding="ascii")
    with pytest.raises(EvidenceError, match="is truncated: it has 2 of 3 lines"):
        link_samples.read(path)
    path.write_text("".join(lines), encoding="ascii")
    assert link_samples.read(path) == samples


@pytest.mark.parametrize("compressed", [False, True])
def test_a_robots_file_is_read_with_its_clock_and_host_states(tmp_path: Path, compressed: bool) -> None:
    (tmp_path / "sender-before.txt").write_text(STATE + output("station-iwlwifi-6").replace("3441", "3431"))
    (tmp_path / "sender-after.txt").write_text(
        STATE.replace("100.00 ", "102.00 ").replace(f"{BOOTED_S + 100}", f"{BOOTED_S + 102}")
        + output("station-iwlwifi-6").replace("3441", "3461")
    )
    if compressed:
        (tmp_path / "sender-link.txt.gz").write_bytes(gzip.compress(SAMPLER_OUTPUT.encode()))
    else:
        (tmp_path / "sender-link.txt").write_text(SAMPLER_OUTPUT, encoding="utf-8")
    samples_read = robot_link_samples.read(tmp_path, Role.SENDER)
    at_s = [item.utc_ns / S - BOOTED_S for item in samples_read]
    assert at_s == pytest.approx([100.0, 101.0, 101.2, 101.4, 102.0], abs=0.02)
    packets = [[station.tx_packets for station in item.stations if station.station] for item in samples_read]
    assert packets == [[3431], [1263, 3441], [], [3451], [3461]]
    assert samples_read[1].cell == "f0:99:bf:0e:86:98"
    assert (samples_read[1].noise_dbm, samples_read[1].active_ns, samples_read[1].busy_ns) == (
        -84.0,
        497753 * 10**6,
        104676 * 10**6,
    )
    assert samples_read[2].stations == (StationSample("", -56.0),)


@given(st.integers(0, len(SAMPLER_OUTPUT)))
def test_a_truncated_file_of_a_sampler_has_the_earlier_samples(end: int) -> None:
    complete_samples, truncated = (
        robot_link_samples.parse(SAMPLER_OUTPUT),
        robot_link_samples.parse(SAMPLER_OUTPUT[:end]),
    )
    assert [item.utc_ns for item in truncated] == [item.utc_ns for item in complete_samples][: len(truncated)]
    for item, complete_sample in zip(truncated, complete_samples, strict=False):
        for station in item.stations:
            (complete_station,) = (
                candidate for candidate in complete_sample.stations if candidate.station == station.station
            )
            known_values = {name: value for name, value in vars(station).items() if value is not None}
            changed_later = {
                "tx_packets",
                "rx_packets",
                "signal_dbm",
                "tx_rate_bit_s",
            }  # `link` reports these values first
            assert all(
                value == getattr(complete_station, name)
                for name, value in known_values.items()
                if name not in changed_later
            )


def test_a_missing_clock_is_an_error_and_a_missing_file_has_no_samples(tmp_path: Path) -> None:
    with pytest.raises(EvidenceError, match="does not contain the clock"):
        robot_link_samples.read(tmp_path, Role.SENDER)
    (tmp_path / "sender-before.txt").write_text(STATE, encoding="utf-8")
    assert robot_link_samples.read(tmp_path, Role.SENDER) == ()
    (tmp_path / "sender-link.txt.gz").write_bytes(gzip.compress(SAMPLER_OUTPUT.encode())[:-20])
    with pytest.raises(EvidenceError, match="cannot be read"):
        robot_link_samples.read(tmp_path, Role.SENDER)
