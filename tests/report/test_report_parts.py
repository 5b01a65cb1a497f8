"""Parts of a report compared with independent results: packets, distributions, strips, summary and warnings."""

import re
from pathlib import Path

import numpy as np
import pytest
import scipy
from hypothesis import given
from hypothesis import strategies as st
from scapy.layers.inet import IP
from scapy.utils import rdpcap, wrpcap

from fieldkit.analysis.cells import aggregate
from fieldkit.analysis.repeats import Repeats
from fieldkit.analysis.table_files import read
from fieldkit.core.columns import with_step_name
from fieldkit.core.model import Protocol, Role
from fieldkit.measure.attempt import AttemptEvidence
from fieldkit.measure.captures import pcap
from fieldkit.measure.evidence import iperf3, ping
from fieldkit.measure.transfers import fates, iperf3_load, tcp
from fieldkit.measure.transfers.transfer_spec import Transfer
from fieldkit.report import distance, distribution, figures, headlines, packet_rasters, strips, summary, timeline
from fieldkit.report.charts import Chart, Panel, Series
from fieldkit.report.contents import build_contents
from fieldkit.report.series import Identities
from fieldkit.report.theme import Style
from fieldkit.report.trial_folders import load_evidence
from fieldkit.ros.streams import topic_columns
from fieldkit.trial.columns import trial_columns
from fieldkit.trial.rows import to_csv
from tests.helpers import lawns, tables
from tests.helpers.paths import DATA
from tests.helpers.tables import RepeatRow

CAPTURES = DATA / "tcpdump" / "4.99.3" / "two-way"


def table(folder: Path, rows: list[RepeatRow]) -> Repeats:
    return read([tables.write(folder, rows)], trial_columns())


def write_captures(folder: Path, protocol: Protocol, lost: set[int]) -> tuple[Transfer, list[int]]:
    """Write the captures of a recorded transfer, without the `lost` packets (counted from 0) at the receiver.

    Returns:
        The transfer, and the indices of all missing packets, including those lost in the recording.
    """
    sent_packets = rdpcap(str(CAPTURES / f"{protocol}-sender.pcap"))
    first = next(
        packet
        for packet in sent_packets
        if packet.haslayer(IP) and packet[IP].proto == {"udp": 17, "tcp": 6}[protocol]
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
    ids = [packet[IP].id * 65536 + packet[IP].frag for packet in sent_packets if is_of_transfer(packet, transfer)]
    removed_ids = {ids[index] for index in lost}
    received_packets = rdpcap(str(CAPTURES / f"{protocol}-receiver.pcap"))
    kept_packets = [
        packet
        for packet in received_packets
        if not (is_of_transfer(packet, transfer) and packet[IP].id * 65536 + packet[IP].frag in removed_ids)
    ]
    arrived_ids = {
        packet[IP].id * 65536 + packet[IP].frag for packet in received_packets if is_of_transfer(packet, transfer)
    }
    (folder / "sender.pcap").write_bytes((CAPTURES / f"{protocol}-sender.pcap").read_bytes())
    wrpcap(str(folder / "receiver.pcap"), kept_packets)
    return transfer, [index for index, packet_id in enumerate(ids) if packet_id not in arrived_ids - removed_ids]


def is_of_transfer(packet: object, transfer: Transfer) -> bool:
    if not packet.haslayer(IP):  # type: ignore[attr-defined]
        return False
    header = packet[IP]  # type: ignore[index]
    return bool(header.src == transfer.sender_address and header.proto == {"udp": 17, "tcp": 6}[transfer.protocol])


def test_exactly_the_lost_packets_are_marked(tmp_path: Path) -> None:
    transfer, missing = write_captures(tmp_path, Protocol.UDP, {2, 3, 7})
    packet_fates = fates.read(AttemptEvidence(tmp_path), transfer)
    assert packet_fates is not None
    assert {2, 3, 7} <= set(missing)
    assert np.flatnonzero(packet_fates.lost_or_repeated).tolist() == missing
    assert len(packet_fates.received_ns) == len(packet_fates.sent_ns) - len(missing)
    assert (np.diff(packet_fates.sent_offset_bytes) > 0).all()
    assert set(packet_fates.received_offset_bytes) == set(
        packet_fates.sent_offset_bytes[~packet_fates.lost_or_repeated]
    )


def test_marked_tcp_frames_equal_the_count_of_retransmissions(tmp_path: Path) -> None:
    transfer, _ = write_captures(tmp_path, Protocol.TCP, set())
    packet_fates = fates.read(AttemptEvidence(tmp_path), transfer)
    assert packet_fates is not None
    sender, receiver = (pcap.read(tmp_path / name).packets for name in ("sender.pcap", "receiver.pcap"))
    assert (
        packet_fates.lost_or_repeated.sum()
        == tcp.count(tcp.match_transfer(sender, receiver, transfer)).retransmitted_frames
    )
    assert packet_fates.sent_offset_bytes[0] == packet_fates.sent_offset_bytes.min()


def test_damaged_capture_is_not_read(tmp_path: Path) -> None:
    transfer, _ = write_captures(tmp_path, Protocol.UDP, set())
    path = tmp_path / "receiver.pcap"
    path.write_bytes(path.read_bytes()[:-3])
    assert fates.read(AttemptEvidence(tmp_path), transfer) is None
    path.unlink()
    assert fates.read(AttemptEvidence(tmp_path), transfer) is None


@given(st.lists(st.booleans(), max_size=50))
def test_runs_cover_the_marked_packets(marked: list[bool]) -> None:
    drawn_charts = np.zeros(len(marked), dtype=np.bool_)
    runs = packet_rasters._runs(np.array(marked, dtype=np.bool_))
    for start, length in runs:
        assert not drawn_charts[max(0, start - 1) : start + length].any()
        drawn_charts[start : start + length] = True
    assert drawn_charts.tolist() == marked


@given(st.lists(st.floats(0, 10), min_size=1, max_size=distribution.MAX_STEPS))
def test_distribution_equals_that_of_scipy(times: list[float]) -> None:
    x, shares = distribution._steps(np.sort(times))
    expected = scipy.stats.ecdf(times).cdf
    for at in times:
        assert shares[np.searchsorted(x, at, side="right") - 1] == pytest.approx(expected.evaluate(at))


def test_labels_of_equal_distances_are_sorted_by_text(tmp_path: Path) -> None:
    labels = ("30ft", "9.144m", "914.4cm")
    rows = [lawns.row(number, distance=label, distance_m=9.144) for number, label in enumerate(labels, start=1)]
    cells = aggregate(table(tmp_path, rows))
    places = [place.replace("\N{NO-BREAK SPACE}", " ") for place in distribution._shown_distances(cells)]
    assert places == ["30ft", "9.144m", "914.4cm"]


def test_a_long_distribution_is_drawn_through_quantiles() -> None:
    times = np.sort(np.random.default_rng(1).exponential(size=5000))
    x, shares = distribution._steps(times)
    assert len(x) == distribution.MAX_STEPS + 1
    assert np.abs(np.searchsorted(times, x, side="right") / len(times) - shares).max() <= 1 / 5000


def test_strip_of_many_repeats_shows_all_void_repeats(tmp_path: Path) -> None:
    rows = [
        lawns.row(number, status="void", reason="no capture") if number % 50 == 0 else lawns.row(number)
        for number in range(1, 2401)
    ]
    evidence = load_evidence(table(tmp_path, rows))
    cells = aggregate(evidence.repeats)
    ((strip,),) = (group.strips for group in strips.groups(cells, Identities(cells), evidence))
    assert len(strip.marks) == strips.MAX_MARKS
    assert sum(mark.status == "void" for mark in strip.marks) == 48
    assert strip.omitted_count == 2400 - strips.MAX_MARKS
    assert strip.marks[-1].title == "udp-2400, void: no capture, UDP datagram loss 5.56 %"


def test_the_void_marks_of_a_page_are_limited(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(strips, "MAX_OTHER_MARKS", 30)
    rows = [lawns.row(number, status="void" if number % 2 else "valid") for number in range(1, 101)]
    evidence = load_evidence(table(tmp_path, rows))
    cells = aggregate(evidence.repeats)
    ((strip,),) = (group.strips for group in strips.groups(cells, Identities(cells), evidence))
    assert sum(mark.status == "void" for mark in strip.marks) == 30
    assert (strip.omitted_count, strip.omitted_other_count) == (0, 20)


@pytest.mark.parametrize(("loss", "expected"), [(0.0, "none"), (0.125, "full height 12.5 %")])
def test_strip_states_its_scale(tmp_path: Path, loss: float, expected: str) -> None:
    evidence = load_evidence(
        table(tmp_path, [lawns.row(1, datagram_loss=loss, datagrams_sent=8, datagrams_received=8 - round(8 * loss))])
    )
    cells = aggregate(evidence.repeats)
    (group,) = strips.groups(cells, Identities(cells), evidence)
    assert group.scale == f"UDP datagram loss, {expected}"


def test_strip_shows_a_loss_that_its_repeats_have(tmp_path: Path) -> None:
    """Otherwise, a repeat with named steps would appear to have no loss."""
    without_datagrams = dict.fromkeys(("datagram_loss", "datagrams_sent", "datagrams_received"))
    lost = {"ip_loss": 0.5, "ip_packets_sent": 8, "ip_packets_received": 4}
    evidence = load_evidence(
        table(tmp_path, [lawns.row(1), lawns.row(2, topology="masterless", **without_datagrams, **lost)])
    )
    cells = aggregate(evidence.repeats)
    scales = {group.title: group.scale for group in strips.groups(cells, Identities(cells), evidence)}
    assert scales["UDP, masterless"] == "IP packet loss, full height 50.0 %"
    assert scales["UDP, master"].startswith("UDP datagram loss")


def test_empty_series_does_not_change_the_panel() -> None:
    series = Series("sent", Style("blue", "o", "none"), [1.0, 2.0], [3.0, 4.0])
    empty = Series("lost", Style("lost", "x", "none"), [], [])
    panels = [Panel("packets", "time", "place", series_list, "") for series_list in ([series], [series, empty])]
    assert figures.panel_svg(panels[0]) == figures.panel_svg(panels[1])
    assert Chart("packets", "packets", "", [panels[1]]).legend == {}


def test_logarithmic_axis_is_labelled_with_powers_of_ten() -> None:
    series = Series("a", Style("blue", "o"), [1, 2], [3.0, 400.0])
    figure = figures.panel_svg(Panel("", "", "ms", [series], "", bottom=1.0, top=1000.0, log=True))
    texts = re.findall(r"<text[^>]*>([^<]*)</text>", figure)
    assert {"1", "10", "100", "1000"} <= set(texts)
    assert not {"200", "500"} & set(texts)


def test_warnings_of_a_page(tmp_path: Path) -> None:
    rows = [
        lawns.row(1, code_sha256="a"),
        lawns.row(2, code_sha256="b", one_way_withheld="the clock drifts"),
        lawns.row(3, code_sha256="b", status="void", reason="tcpdump dropped 3 packets"),
        lawns.row(4, code_sha256="b", distance="20ft", distance_m=6.096, status="failed", reason="no answer"),
    ]
    evidence = load_evidence(table(tmp_path, rows))
    cells = aggregate(evidence.repeats)
    listed_warnings = [
        (warning.text, list(map(plain_text, warning.reasons))) for warning in summary.warnings(cells, evidence)
    ]
    assert listed_warnings[0] == ("1 attempt void.", ["tcpdump dropped 3 packets (1)"])
    assert listed_warnings[1] == ("1 attempt failed.", ["no answer (1)"])
    assert listed_warnings[2] == ("No valid repeat in 1 condition.", ["UDP, 20ft"])
    assert listed_warnings[3][0].startswith("* 95\N{NO-BREAK SPACE}% interval assuming a normal distribution")
    assert "2 repeats give 50 %" in plain_text(listed_warnings[3][0])
    assert listed_warnings[4] == (
        "One-way delay withheld, completely or partly, in 1 valid repeat.",
        ["the clock drifts (1)"],
    )
    assert listed_warnings[5][0].startswith("Different versions of fieldkit")
    assert len(listed_warnings) == 6


def test_summary_paragraph_has_counts_and_conditions(tmp_path: Path) -> None:
    evidence = load_evidence(table(tmp_path, lawns.lawn(4)))
    paragraph = summary.paragraph(aggregate(evidence.repeats), evidence, {}).replace("\N{NO-BREAK SPACE}", " ")
    assert paragraph == (
        "24 trials of los and nlos on 2026-11-21 12:00 UTC: 10ft to 55ft; "
        "TCP and UDP; master and masterless; emulated and field robots. 192 attempts: 176 valid, 16 void. "
        "All figures use only the valid ones."
    )


def test_headline_has_the_extremes_with_their_intervals(tmp_path: Path) -> None:
    rows = [lawns.row(number) for number in (1, 2)]
    rows += [lawns.row(number, distance="20ft", distance_m=6.096, rtt_median_s=0.02) for number in (1, 2)]
    evidence = load_evidence(table(tmp_path, rows))
    _, loss, rtt = headlines.headlines(aggregate(evidence.repeats), evidence)
    assert (loss.subject, ends(loss)) == ("UDP datagram loss", ["in all conditions 5.56 %"])
    assert rtt.subject == "RTT with UDP"
    assert ends(rtt) == [
        "most 20.00 ms [20.00, 20.00]* 20ft",
        "least 16.00 ms [16.00, 16.00]* 10ft",
    ]


def test_headline_of_several_steps_names_the_step_of_each_extreme(tmp_path: Path) -> None:
    pings = {f"{step}.rtt_median_s": at_s for step, at_s in (("small", 0.002), ("middle", 0.004), ("big", 0.016))}
    columns = trial_columns(
        with_step_name(step, column) for step in ("small", "middle", "big") for column in ping.COLUMNS
    )
    rows = [{**lawns.row(number), **pings, "rtt_median_s": None} for number in (1, 2)]
    path = tmp_path / "trial.csv"
    path.write_text(to_csv(rows, columns), encoding="utf-8")
    evidence = load_evidence(read([path], columns))
    _, _, rtt = headlines.headlines(aggregate(evidence.repeats), evidence)
    assert rtt.subject == "RTT with UDP"
    assert ends(rtt) == [
        "most 16.00 ms [16.00, 16.00]* big, 10ft",
        "least 2.00 ms [2.00, 2.00]* small, 10ft",
    ]


def test_report_of_topics_has_their_headlines_and_charts(tmp_path: Path) -> None:
    topic = {"topic_sent": 20, "topic_received": 18, "topic_loss": 0.1, "topic_delay_median_s": 0.03}
    columns = trial_columns(topic_columns.COLUMNS)
    path = tmp_path / "trial.csv"
    farther = {"distance": "20ft", "distance_m": 6.096}
    rows = [{**lawns.row(number), **topic, **place} for place in ({}, farther) for number in (1, 2)]
    path.write_text(to_csv(rows, columns), encoding="utf-8")
    evidence = load_evidence(read([path], columns))
    cells = aggregate(evidence.repeats)
    lines_by_subject = {headline.subject: ends(headline) for headline in headlines.headlines(cells, evidence)}
    assert lines_by_subject == {
        "Repeats": ["4 of 4 valid"],
        "topic loss": ["in all conditions 10.00 %"],
        "topic delay": ["in all conditions 30.00 ms"],
    }
    drawn_charts = distance.charts(cells, Identities(cells), evidence, (*distance.LOSS, *distance.DELAY))
    assert {"topic-loss", "topic-delay-median"} <= {chart.name for chart in drawn_charts}


def test_iperf3_results_are_separate_charts_against_distance(tmp_path: Path) -> None:
    iperf3_values = {"iperf3_throughput_bit_s": 5e6, "iperf3_loss": 0.1, "iperf3_captured_loss": 0.12}
    counts = {"iperf3_datagrams_sent": 100, "iperf3_datagrams_received": 90}
    columns = trial_columns((*iperf3.COLUMNS, *iperf3_load.COLUMNS))
    path = tmp_path / "trial.csv"
    farther = {"distance": "20ft", "distance_m": 6.096}
    rows = [{**lawns.row(number), **iperf3_values, **counts, **place} for place in ({}, farther) for number in (1, 2)]
    path.write_text(to_csv(rows, columns), encoding="utf-8")
    page = build_contents(read([path], columns), title="", repeat="", command=["fieldkit"])
    titles = {section.name: [chart.title for chart in section.charts] for section in page.against_distance}
    assert {"iperf3 loss against distance", "iperf3 loss, captured against distance"} <= set(titles["loss"])
    assert "iperf3 throughput against distance" in titles["rate"]


def ends(headline: headlines.Headline) -> list[str]:
    """Return one text per end of a headline."""
    lines = (filter(None, (end.extreme, end.value, end.interval, end.place)) for end in headline.lines)
    return [plain_text(" ".join(parts)) for parts in lines]


def plain_text(text: str) -> str:
    return text.replace("\N{NO-BREAK SPACE}", " ")


def test_pings_of_different_sizes_have_separate_charts(tmp_path: Path) -> None:
    udp = {"rtt_payload_bytes": 8192}
    tcp = {"protocol": "tcp", "rtt_payload_bytes": 502, "rtt_median_s": 0.004}
    farther = {"distance": "20ft", "distance_m": 6.096}
    rows = [
        lawns.row(number, **values, **place) for values in (udp, tcp) for place in ({}, farther) for number in (1, 2)
    ]
    evidence = load_evidence(table(tmp_path, rows))
    cells = aggregate(evidence.repeats)
    rtt_charts = list(distance.charts(cells, Identities(cells), evidence, ["rtt_median_s"]))
    assert [(chart.name, [panel.title for panel in chart.panels]) for chart in rtt_charts] == [
        ("rtt-median-502-bytes", ["TCP, master"]),
        ("rtt-median-8192-bytes", ["UDP, master"]),
    ]
    distributions = [chart.name for chart in distribution.charts(cells, Identities(cells), evidence)]
    assert distributions[:2] == ["rtt-distribution-502-bytes", "rtt-distribution-8192-bytes"]


def test_points_are_joined_from_four_distances_with_repeats_in_the_background(tmp_path: Path) -> None:
    for count, join in ((3, "none"), (4, "line")):
        rows = [
            lawns.row(number, distance=f"{metres}m", distance_m=float(metres), rtt_median_s=0.01 * number)
            for metres in range(1, 1 + count)
            for number in (1, 2)
        ]
        evidence = load_evidence(table(tmp_path / join, rows))
        cells = aggregate(evidence.repeats)
        (chart,) = distance.charts(cells, Identities(cells), evidence, ["rtt_median_s"])
        (series,) = chart.panels[0].series
        assert series.join == join
        assert [y for _, y in series.behind] == pytest.approx([10, 20] * count)


def test_interval_beyond_the_axis_has_an_arrow_and_repeats_beyond_it_are_not_drawn() -> None:
    def marks(high: float, repeat: float) -> int:
        series = Series("", Style("blue", "o"), [1.0], [2.0], [1.0], [high], behind=[(1.0, repeat)])
        return figures.panel_svg(Panel("", "", "", [series], "", top=4.0)).count("<use ")

    assert marks(9.0, 3.0) == marks(3.0, 3.0) + 1
    assert marks(3.0, 8.0) == marks(3.0, 3.0) - 1


def test_lost_last_ping_is_after_the_last_reply() -> None:
    seq, at_s = np.array([1.0, 2.0, 4.0]), np.array([10.0, 10.5, 11.5])
    assert timeline.estimate_send_times(np.array([0, 3, 5, 7]), seq, at_s) == pytest.approx([9.5, 11.0, 12.0, 13.0])
    assert timeline.estimate_send_times(np.array([2]), seq[:1], at_s[:1]) == pytest.approx([11.0])


@pytest.mark.parametrize("procedures", ["los nlos", "nlos", "driveaway los nlos", "abroad los selfheal", "driveaway"])
def test_los_and_nlos_keep_their_style_among_other_procedures(tmp_path: Path, procedures: str) -> None:
    names = procedures.split()
    scenarios = ["nlos" if name == "nlos" else "los" for name in names]
    rows = [
        lawns.row(1, scenario=scenario, procedure=name, trial=name)
        for scenario, name in zip(scenarios, names, strict=True)
    ]
    cells = aggregate(table(tmp_path, rows))
    identities = Identities(cells)
    identities_by_procedure = {str(cell.key["procedure"]): identities.of(cell) for cell in cells}
    names_by_style = {
        (identity.style.colour, identity.style.marker): name for name, identity in identities_by_procedure.items()
    }
    assert len(names_by_style) == len(names)
    assert names_by_style.get(("blue", "o")) == next((name for name in ("los", "driveaway") if name in names), None)
    assert names_by_style.get(("red", "s")) == ("nlos" if "nlos" in names else None)
    has_several_los = scenarios.count("los") > 1
    assert {name: identity.label for name, identity in identities_by_procedure.items()} == {
        name: name.upper() if name in {"los", "nlos"} else f"LOS, {name}" if has_several_los else "LOS"
        for name in names
    }


def test_edited_table_cannot_refer_to_other_folders(tmp_path: Path) -> None:
    evidence = load_evidence(table(tmp_path, [lawns.row(1, protocol="../../../etc")]))
    assert evidence.attempt(0) is None


def test_a_title_names_few_procedures(tmp_path: Path) -> None:
    rows = [tables.replace(tables.COMPARABLE, procedure=f"run {number}") for number in range(6)]
    assert summary.title(aggregate(table(tmp_path, rows)), {}) == "Loss and delay: run 0, run 1 and 4 others"
    three_procedures = aggregate(table(tmp_path / "three", rows[:3]))
    assert summary.title(three_procedures, {}) == "Loss and delay: run 0, run 1 and run 2"
