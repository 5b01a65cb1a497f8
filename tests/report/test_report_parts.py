"""What stands in a report, against closed forms: packets, distributions, strips, summary, warnings."""

import re
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scapy.layers.inet import IP
from scapy.utils import rdpcap, wrpcap
from scipy import stats

from fieldkit.analysis.cells import aggregate
from fieldkit.analysis.repeats import Repeats, read
from fieldkit.core.columns import named
from fieldkit.core.model import Protocol, Role
from fieldkit.measure.attempt import AttemptEvidence
from fieldkit.measure.captures import pcap
from fieldkit.measure.evidence import iperf3, ping
from fieldkit.measure.transfers import fates, load, tcp, topics
from fieldkit.measure.transfers.transfer import Transfer
from fieldkit.report import bursts, distance, distribution, figures, headlines, strips, summary, timeline
from fieldkit.report.charts import Chart, Panel, Series
from fieldkit.report.conditions import Identities
from fieldkit.report.contents import put_together
from fieldkit.report.evidence import at_hand
from fieldkit.report.theme import Style
from fieldkit.trial.columns import trial_columns
from fieldkit.trial.rows import to_csv
from tests.helpers import lawns, tables
from tests.helpers.paths import DATA
from tests.helpers.tables import RepeatRow

CAPTURES = DATA / "tcpdump" / "4.99.3" / "two-way"


def table(folder: Path, rows: list[RepeatRow]) -> Repeats:
    return read([tables.write(folder, rows)], trial_columns())


def captured(folder: Path, protocol: Protocol, lost: set[int]) -> tuple[Transfer, list[int]]:
    """Lay down a recorded transfer without some of its packets, counted from 0, at the receiver.

    Returns:
        The transfer, and which packets are not there in all: on the way some were lost for real.
    """
    sent = rdpcap(str(CAPTURES / f"{protocol}-sender.pcap"))
    first = next(
        packet for packet in sent if packet.haslayer(IP) and packet[IP].proto == {"udp": 17, "tcp": 6}[protocol]
    )
    transfer = Transfer(
        protocol,
        Role.SENDER,
        Role.RECEIVER,
        first[IP].src,
        first[IP].dst,
        int(first.dport),
        "scan.bag",
        "recv.bag",
        captures=("sender.pcap", "receiver.pcap"),
    )
    ids = [one[IP].id * 65536 + one[IP].frag for one in sent if ours(one, transfer)]
    gone = {ids[index] for index in lost}
    received = rdpcap(str(CAPTURES / f"{protocol}-receiver.pcap"))
    kept = [one for one in received if not (ours(one, transfer) and one[IP].id * 65536 + one[IP].frag in gone)]
    arrived = {one[IP].id * 65536 + one[IP].frag for one in received if ours(one, transfer)}
    (folder / "sender.pcap").write_bytes((CAPTURES / f"{protocol}-sender.pcap").read_bytes())
    wrpcap(str(folder / "receiver.pcap"), kept)
    return transfer, [index for index, one in enumerate(ids) if one not in arrived - gone]


def ours(packet: object, transfer: Transfer) -> bool:
    if not packet.haslayer(IP):  # type: ignore[attr-defined]
        return False
    header = packet[IP]  # type: ignore[index]
    return bool(header.src == transfer.sender_address and header.proto == {"udp": 17, "tcp": 6}[transfer.protocol])


def test_exactly_the_lost_packets_are_marked(tmp_path: Path) -> None:
    transfer, missing = captured(tmp_path, Protocol.UDP, {2, 3, 7})
    found = fates.read(AttemptEvidence(tmp_path), transfer)
    assert found is not None
    assert {2, 3, 7} <= set(missing)
    assert np.flatnonzero(found.marked).tolist() == missing
    assert len(found.received_ns) == len(found.sent_ns) - len(missing)
    assert (np.diff(found.sent_bytes) > 0).all()
    assert set(found.received_bytes) == set(found.sent_bytes[~found.marked])


def test_tcp_marks_as_many_frames_as_are_counted_as_sent_again(tmp_path: Path) -> None:
    transfer, _ = captured(tmp_path, Protocol.TCP, set())
    found = fates.read(AttemptEvidence(tmp_path), transfer)
    assert found is not None
    sender, receiver = (pcap.read(tmp_path / name).packets for name in ("sender.pcap", "receiver.pcap"))
    assert found.marked.sum() == tcp.count(tcp.cross(sender, receiver, transfer)).retransmitted_frames
    assert found.sent_bytes[0] == found.sent_bytes.min()


def test_a_damaged_capture_gives_no_fates(tmp_path: Path) -> None:
    transfer, _ = captured(tmp_path, Protocol.UDP, set())
    path = tmp_path / "receiver.pcap"
    path.write_bytes(path.read_bytes()[:-3])
    assert fates.read(AttemptEvidence(tmp_path), transfer) is None
    path.unlink()
    assert fates.read(AttemptEvidence(tmp_path), transfer) is None


@given(st.lists(st.booleans(), max_size=50))
def test_runs_are_what_is_marked(marked: list[bool]) -> None:
    drawn = np.zeros(len(marked), dtype=np.bool_)
    runs = bursts._runs(np.array(marked, dtype=np.bool_))
    for start, length in runs:
        assert not drawn[max(0, start - 1) : start + length].any()
        drawn[start : start + length] = True
    assert drawn.tolist() == marked


@given(st.lists(st.floats(0, 10), min_size=1, max_size=distribution.MOST_STEPS))
def test_a_distribution_is_scipys(times: list[float]) -> None:
    x, shares = distribution._steps(np.sort(times))
    expected = stats.ecdf(times).cdf
    for at in times:
        assert shares[np.searchsorted(x, at, side="right") - 1] == pytest.approx(expected.evaluate(at))


def test_equal_distances_by_other_names_stand_in_the_order_of_their_names(tmp_path: Path) -> None:
    labels = ("30ft", "9.144m", "914.4cm")
    rows = [lawns.row(number, distance=label, distance_m=9.144) for number, label in enumerate(labels, start=1)]
    cells = aggregate(table(tmp_path, rows))
    places = [place.replace("\N{NO-BREAK SPACE}", " ") for place in distribution._places(cells)]
    assert places == ["30ft", "9.144m", "914.4cm"]


def test_a_long_distribution_is_drawn_through_quantiles() -> None:
    times = np.sort(np.random.default_rng(1).exponential(size=5000))
    x, shares = distribution._steps(times)
    assert len(x) == distribution.MOST_STEPS + 1
    assert np.abs(np.searchsorted(times, x, side="right") / len(times) - shares).max() <= 1 / 5000


def test_a_strip_of_many_keeps_every_void_one(tmp_path: Path) -> None:
    rows = [
        lawns.row(number, status="void", reason="no capture") if number % 50 == 0 else lawns.row(number)
        for number in range(1, 2401)
    ]
    found = at_hand(table(tmp_path, rows))
    cells = aggregate(found.repeats)
    ((strip,),) = (group.strips for group in strips.groups(cells, Identities(cells), found))
    assert len(strip.marks) == strips.MOST_MARKS
    assert sum(mark.status == "void" for mark in strip.marks) == 48
    assert strip.left_out == 2400 - strips.MOST_MARKS
    assert strip.marks[-1].title == "udp-2400, void: no capture, UDP datagram loss 5.56 %"


@pytest.mark.parametrize(("loss", "said"), [(0.0, "none"), (0.125, "full height 12.5 %")])
def test_a_strip_says_what_its_height_is(tmp_path: Path, loss: float, said: str) -> None:
    found = at_hand(
        table(tmp_path, [lawns.row(1, datagram_loss=loss, datagrams_sent=8, datagrams_received=8 - round(8 * loss))])
    )
    cells = aggregate(found.repeats)
    (group,) = strips.groups(cells, Identities(cells), found)
    assert group.scale == f"UDP datagram loss, {said}"


def test_a_strip_is_of_a_loss_that_its_own_repeats_have(tmp_path: Path) -> None:
    """Else a repeat of steps that have names would look as if it had lost nothing."""
    without = dict.fromkeys(("datagram_loss", "datagrams_sent", "datagrams_received"))
    lost = {"ip_loss": 0.5, "ip_packets_sent": 8, "ip_packets_received": 4}
    found = at_hand(table(tmp_path, [lawns.row(1), lawns.row(2, topology="masterless", **without, **lost)]))
    cells = aggregate(found.repeats)
    scales = {group.title: group.scale for group in strips.groups(cells, Identities(cells), found)}
    assert scales["UDP, masterless"] == "IP packet loss, full height 50.0 %"
    assert scales["UDP, master"].startswith("UDP datagram loss")


def test_a_series_without_points_takes_no_room() -> None:
    series = Series("sent", Style("blue", "o", "none"), [1.0, 2.0], [3.0, 4.0])
    empty = Series("lost", Style("lost", "x", "none"), [], [])
    panels = [Panel("packets", "time", "place", kept, "") for kept in ([series], [series, empty])]
    assert figures.panel_svg(panels[0]) == figures.panel_svg(panels[1])
    assert Chart("packets", "packets", "", [panels[1]]).legend == {}


def test_a_logarithmic_axis_has_its_powers_of_ten_as_numbers() -> None:
    series = Series("a", Style("blue", "o"), [1, 2], [3.0, 400.0])
    drawn = figures.panel_svg(Panel("", "", "ms", [series], "", bottom=1.0, top=1000.0, log=True))
    found = re.findall(r"<text[^>]*>([^<]*)</text>", drawn)
    assert {"1", "10", "100", "1000"} <= set(found)
    assert not {"200", "500"} & set(found)


def test_the_page_warns_of_what_matters(tmp_path: Path) -> None:
    rows = [
        lawns.row(1, code_sha256="a"),
        lawns.row(2, code_sha256="b", one_way_withheld="the clock drifts"),
        lawns.row(3, code_sha256="b", status="void", reason="tcpdump dropped 3 packets"),
        lawns.row(4, code_sha256="b", distance="20ft", distance_m=6.096, status="failed", reason="no answer"),
    ]
    found = at_hand(table(tmp_path, rows))
    cells = aggregate(found.repeats)
    said = [(one.text, list(map(plain, one.reasons))) for one in summary.warnings(cells, found)]
    assert said[0] == ("1 attempt void.", ["tcpdump dropped 3 packets (1)"])
    assert said[1] == ("1 attempt failed.", ["no answer (1)"])
    assert said[2] == ("Nothing valid in 1 condition.", ["UDP, 20ft"])
    assert said[3][0].startswith("* 95\N{NO-BREAK SPACE}% interval assuming a normal distribution")
    assert "2 repeats give 50 %" in plain(said[3][0])
    assert said[4] == ("One-way delay withheld, all or in part, in 1 valid repeat.", ["the clock drifts (1)"])
    assert said[5][0].startswith("Different versions of fieldkit")
    assert len(said) == 6


def test_the_paragraph_counts_and_places(tmp_path: Path) -> None:
    found = at_hand(table(tmp_path, lawns.lawn(4)))
    said = summary.paragraph(aggregate(found.repeats), found).replace("\N{NO-BREAK SPACE}", " ")
    assert said == (
        "24 trials of los and nlos on 2026-11-21 12:00 UTC: 10ft to 55ft; "
        "TCP and UDP; master and masterless; emulated and field robots. 192 attempts: 176 valid, 16 void. "
        "All figures are of the valid ones."
    )


def test_a_headline_names_the_ends_with_their_intervals(tmp_path: Path) -> None:
    rows = [lawns.row(number) for number in (1, 2)]
    rows += [lawns.row(number, distance="20ft", distance_m=6.096, rtt_median_s=0.02) for number in (1, 2)]
    found = at_hand(table(tmp_path, rows))
    _, loss, rtt = headlines.headlines(aggregate(found.repeats), found)
    assert (loss.subject, ends(loss)) == ("UDP datagram loss", ["in all conditions 5.56 %"])
    assert rtt.subject == "RTT with UDP"
    assert ends(rtt) == [
        "most 20.00 ms [20.00, 20.00]* 20ft",
        "least 16.00 ms [16.00, 16.00]* 10ft",
    ]


def test_a_headline_of_several_steps_says_at_which_its_ends_are(tmp_path: Path) -> None:
    pings = {f"{step}.rtt_median_s": at_s for step, at_s in (("small", 0.002), ("middle", 0.004), ("big", 0.016))}
    columns = trial_columns(named(step, one) for step in ("small", "middle", "big") for one in ping.COLUMNS)
    rows = [{**lawns.row(number), **pings, "rtt_median_s": None} for number in (1, 2)]
    path = tmp_path / "trial.csv"
    path.write_text(to_csv(rows, columns), encoding="utf-8")
    found = at_hand(read([path], columns))
    _, _, rtt = headlines.headlines(aggregate(found.repeats), found)
    assert rtt.subject == "RTT with UDP"
    assert ends(rtt) == [
        "most 16.00 ms [16.00, 16.00]* big, 10ft",
        "least 2.00 ms [2.00, 2.00]* small, 10ft",
    ]


def test_a_report_of_topics_begins_with_them_and_draws_them(tmp_path: Path) -> None:
    topic = {"topic_sent": 20, "topic_received": 18, "topic_loss": 0.1, "topic_delay_median_s": 0.03}
    columns = trial_columns(topics.COLUMNS)
    path = tmp_path / "trial.csv"
    far = {"distance": "20ft", "distance_m": 6.096}
    rows = [{**lawns.row(number), **topic, **there} for there in ({}, far) for number in (1, 2)]
    path.write_text(to_csv(rows, columns), encoding="utf-8")
    found = at_hand(read([path], columns))
    cells = aggregate(found.repeats)
    said = {one.subject: ends(one) for one in headlines.headlines(cells, found)}
    assert said == {
        "Repeats": ["4 of 4 valid"],
        "topic loss": ["in all conditions 10.00 %"],
        "topic delay": ["in all conditions 30.00 ms"],
    }
    drawn = distance.charts(cells, Identities(cells), found, (*distance.LOSS, *distance.DELAY))
    assert {"topic-loss", "topic-delay-median"} <= {chart.name for chart in drawn}


def test_what_iperf3_measured_is_drawn_against_distance_under_its_own_name(tmp_path: Path) -> None:
    tested = {"iperf3_throughput_bit_s": 5e6, "iperf3_loss": 0.1, "iperf3_captured_loss": 0.12}
    counts = {"iperf3_datagrams_sent": 100, "iperf3_datagrams_received": 90}
    columns = trial_columns((*iperf3.COLUMNS, *load.COLUMNS))
    path = tmp_path / "trial.csv"
    far = {"distance": "20ft", "distance_m": 6.096}
    rows = [{**lawns.row(number), **tested, **counts, **there} for there in ({}, far) for number in (1, 2)]
    path.write_text(to_csv(rows, columns), encoding="utf-8")
    page = put_together(read([path], columns), title="", repeat="", command=["fieldkit"])
    titles = {section.name: [chart.title for chart in section.charts] for section in page.against_distance}
    assert {"iperf3 loss against distance", "iperf3 loss, captured against distance"} <= set(titles["loss"])
    assert "iperf3 throughput against distance" in titles["rate"]


def ends(headline: headlines.Headline) -> list[str]:
    """Return what a headline says, an end each."""
    said = (filter(None, (one.which, one.value, one.interval, one.place)) for one in headline.ends)
    return [plain(" ".join(parts)) for parts in said]


def plain(text: str) -> str:
    return text.replace("\N{NO-BREAK SPACE}", " ")


def test_round_trips_of_different_sizes_have_charts_of_their_own(tmp_path: Path) -> None:
    udp = {"rtt_payload_bytes": 8192}
    tcp = {"protocol": "tcp", "rtt_payload_bytes": 502, "rtt_median_s": 0.004}
    far = {"distance": "20ft", "distance_m": 6.096}
    rows = [lawns.row(number, **one, **there) for one in (udp, tcp) for there in ({}, far) for number in (1, 2)]
    found = at_hand(table(tmp_path, rows))
    cells = aggregate(found.repeats)
    of_rtt = list(distance.charts(cells, Identities(cells), found, ["rtt_median_s"]))
    assert [(one.name, [panel.title for panel in one.panels]) for one in of_rtt] == [
        ("rtt-median-502-bytes", ["TCP, master"]),
        ("rtt-median-8192-bytes", ["UDP, master"]),
    ]
    distributions = [one.name for one in distribution.charts(cells, Identities(cells), found)]
    assert distributions[:2] == ["rtt-distribution-502-bytes", "rtt-distribution-8192-bytes"]


def test_points_are_joined_from_four_distances_on_and_repeats_stand_behind(tmp_path: Path) -> None:
    for count, join in ((3, "none"), (4, "line")):
        rows = [
            lawns.row(number, distance=f"{metres}m", distance_m=float(metres), rtt_median_s=0.01 * number)
            for metres in range(1, 1 + count)
            for number in (1, 2)
        ]
        found = at_hand(table(tmp_path / join, rows))
        cells = aggregate(found.repeats)
        (chart,) = distance.charts(cells, Identities(cells), found, ["rtt_median_s"])
        (series,) = chart.panels[0].series
        assert series.join == join
        assert [y for _, y in series.behind] == pytest.approx([10, 20] * count)


def test_an_interval_that_leaves_the_axis_ends_in_an_arrow_and_a_repeat_beyond_is_not_drawn() -> None:
    def marks(high: float, repeat: float) -> int:
        series = Series("", Style("blue", "o"), [1.0], [2.0], [1.0], [high], behind=[(1.0, repeat)])
        return figures.panel_svg(Panel("", "", "", [series], "", top=4.0)).count("<use ")

    assert marks(9.0, 3.0) == marks(3.0, 3.0) + 1
    assert marks(3.0, 8.0) == marks(3.0, 3.0) - 1


def test_a_lost_last_ping_stands_behind_the_last_reply() -> None:
    seq, at_s = np.array([1.0, 2.0, 4.0]), np.array([10.0, 10.5, 11.5])
    assert timeline.left_at(np.array([0, 3, 5, 7]), seq, at_s) == pytest.approx([9.5, 11.0, 12.0, 13.0])
    assert timeline.left_at(np.array([2]), seq[:1], at_s[:1]) == pytest.approx([11.0])


@pytest.mark.parametrize("procedures", ["los nlos", "nlos", "driveaway los nlos", "abroad los selfheal", "driveaway"])
def test_los_and_nlos_keep_their_looks_whatever_is_beside_them(tmp_path: Path, procedures: str) -> None:
    names = procedures.split()
    scenarios = ["nlos" if name == "nlos" else "los" for name in names]
    rows = [
        lawns.row(1, scenario=one, procedure=name, trial=name) for one, name in zip(scenarios, names, strict=True)
    ]
    cells = aggregate(table(tmp_path, rows))
    identities = Identities(cells)
    found = {str(cell.key["procedure"]): identities.of(cell) for cell in cells}
    looks = {(one.style.colour, one.style.marker): name for name, one in found.items()}
    assert len(looks) == len(names)
    assert looks.get(("blue", "o")) == next((name for name in ("los", "driveaway") if name in names), None)
    assert looks.get(("red", "s")) == ("nlos" if "nlos" in names else None)
    several = scenarios.count("los") > 1
    assert {name: one.label for name, one in found.items()} == {
        name: name.upper() if name in {"los", "nlos"} else f"LOS, {name}" if several else "LOS" for name in names
    }


def test_a_table_that_somebody_edited_leads_to_no_folder(tmp_path: Path) -> None:
    found = at_hand(table(tmp_path, [lawns.row(1, protocol="../../../etc")]))
    assert found.attempt(0) is None
