"""Columns that only trials with a certain step have, and the rows of printed tables."""

from collections.abc import Mapping
from typing import Final

from docs.generator.markdown import page, table
from fieldkit.core.columns import Column
from fieldkit.core.model import FaultKind
from fieldkit.measure.checks import monitor_columns, ping_duplicates, ping_links
from fieldkit.measure.evidence import handovers, iperf3, ping_gaps
from fieldkit.measure.transfers import iperf3_load, recoveries, stalls
from fieldkit.motion.logs import drive_log, fly_log, tlog
from fieldkit.ros.bags import recorded_topics
from fieldkit.ros.streams import sample_reads, topic_columns, topic_stalls
from fieldkit.ros.video import video_columns
from fieldkit.telemetry import telemetry_columns
from fieldkit.trial.columns import installed_columns

STEP_COLUMNS: Final[Mapping[str, tuple[Column, ...]]] = {
    "`ping` with `gap: true`": (*ping_gaps.GAP_COLUMNS, *ping_gaps.OPEN_GAP_COLUMNS),
    "`ping` with `duplicates: true`": ping_duplicates.COLUMNS,
    "`ping` with `links`": ping_links.declare_columns("LINK"),
    "`capture` with `monitor`": monitor_columns.COLUMNS,
    "`roam`": handovers.COLUMNS,
    "`iperf3`": (*iperf3.COLUMNS, *iperf3_load.COLUMNS, *iperf3_load.JITTER),
    "`iperf3`, `soak`": stalls.declare_columns("FLOW", "FLOW", 0),
    "`topics`": (*topic_columns.COLUMNS, *topic_stalls.COLUMNS),
    "`topics` with `reads`": sample_reads.declare_columns("used", "topic_sent"),
    "`video`; `topics` with `reads` and `image`: `seen_*`": video_columns.COLUMNS,
    "`record` with `reception: true`": recorded_topics.COLUMNS,
    "a flow inside `fault`": recoveries.declare_columns("FLOW", FaultKind.REBOOT),
    "`mavlink`": tlog.COLUMNS,
    "any step, with `telemetry` in a robot's profile": telemetry_columns.COLUMNS,
    "`fly`": fly_log.COLUMNS,
    "`move` of a robot that fieldkit drives": drive_log.COLUMNS,
}
"""Columns by the step that fills them; FLOW is the kind of step, and LINK the name of a link."""


def escaped(text: str) -> str:
    """Return a text of the code for a cell of a table."""
    return text.replace("<", "&lt;").replace("*", "\\*")


def step_columns() -> str:
    """Return the table of the columns of steps that not every trial has."""
    lines = (
        (
            f"`{column.name}`",
            column.unit,
            str(column.figure.kind) if column.figure else "",
            step,
            escaped(column.meaning),
        )
        for step, columns in STEP_COLUMNS.items()
        for column in columns
    )
    return table(("column", "unit", "estimate", "step", "meaning"), lines)


def table_rows() -> str:
    """Return the page of the rows of printed tables, with their columns."""
    lines = (
        (column.figure.label, f"`{column.name}`", escaped(column.meaning))
        for columns in (installed_columns(), *STEP_COLUMNS.values())
        for column in columns
        if column.figure is not None
    )
    return page(
        "Rows of tables",
        "This page lists the rows of the tables of `trial`, `aggregate`, `compare` and `report`, with their columns "
        "in `trial.csv`. FLOW is `transfer`, `iperf3`, `soak` or `topic`. For flows, only the rows of the fault "
        "`reboot` are listed; the rows of other faults contain their names instead. The [glossary](../glossary.md) "
        "explains losses and marks.",
        table(("row", "column", "meaning"), lines),
    )
