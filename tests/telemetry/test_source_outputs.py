"""Values in real outputs of several versions of mmcli, batctl and snmpget, and in wrong and hostile outputs."""

import json

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fieldkit.config import schema
from fieldkit.core.columns import cell_text
from fieldkit.core.model import Role
from fieldkit.telemetry import source_outputs, telemetry_columns
from fieldkit.telemetry.source_outputs import Values
from fieldkit.telemetry.telemetry_section import TelemetrySource
from tests.helpers.paths import DATA

SIGNAL, MODEM, CELLS = (
    (DATA / "mmcli" / "1.20.4" / f"{name}.json").read_text(encoding="utf-8")
    for name in ("signal-get", "modem", "get-cell-info")
)
SNMP_OUTPUT = """\
.1.3.6.1.4.1.99999.1.1.0 -71
.1.3.6.1.4.1.99999.1.2.0 "B7"
.1.3.6.1.4.1.99999.1.3.0 "-98.5 dBm"
.1.3.6.1.4.1.99999.1.4.0 144
.1.3.6.1.4.1.99999.9.0 No Such Object available on this agent at this OID
.1.3.6.1.2.1.2.2.1.6.1 ""
"""
"""The output of snmpget 5.9.3 of Debian 12 for the objects of test_snmp_and_http.py."""


def source(text: str) -> TelemetrySource:
    return schema.validate(schema.parse(text, source="source.yaml"), TelemetrySource)


def older_output(name: str) -> str:
    return (DATA / "mmcli" / "1.14-1.18" / f"{name}.json").read_text(encoding="utf-8")


@pytest.mark.parametrize(
    ("output", "expected"),
    [
        (
            SIGNAL + MODEM + CELLS,
            {
                "signal_dbm": -97.0,
                "sinr_db": 12.4,
                "band": "lte, EARFCN 1575",
                "cell": "26202 01A2D001",
                "neighbours": 2.0,
            },
        ),
        (SIGNAL + MODEM, {"signal_dbm": -97.0, "sinr_db": 12.4, "band": "lte"}),
        (older_output("signal-get"), {"signal_dbm": -104.0, "sinr_db": 2.0}),
        (older_output("signal-get") + MODEM.replace('["lte"]', '["hspa"]'), {"band": "hspa"}),
        (
            older_output("signal-get") + MODEM.replace('["lte"]', '["gprs", "edge"]'),
            {"signal_dbm": -69.0, "band": "gprs/edge"},
        ),
        (older_output("signal-get-comma"), {}),
        (older_output("signal-get-off"), {}),
        (SIGNAL.replace("-97.00", "0.00"), {}),
    ],
)
def test_the_values_in_outputs_of_mmcli_are_read(output: str, expected: Values) -> None:
    assert source_outputs.values(source("modemmanager: {modem: any}"), output) == expected


@pytest.mark.parametrize(
    ("file", "neighbours"),
    [
        ("2018.4/neighbors-v.txt", 0),
        ("2019.1/neighbors-iv.txt", 4),
        ("2020.1/neighbors-v.txt", 1),
        ("2021.1/neighbors.json", 4),
        ("2024.3/neighbors.json", 3),
        ("2024.3/neighbors-iv.txt", 1),
    ],
)
def test_only_recent_neighbours_of_batctl_are_counted(file: str, neighbours: int) -> None:
    text = (DATA / "batctl" / file).read_text(encoding="utf-8")
    assert source_outputs.values(source("batctl: {}"), f"{text}\n[]\n") == {"neighbours": neighbours}


def test_an_empty_list_is_a_count_of_zero_and_another_output_is_rejected() -> None:
    mesh = source("batctl: {}")
    assert source_outputs.values(mesh, "[]\n\n[]\n") == {"neighbours": 0}
    for output in ("", "Error - interface bat0 is not present", '{"neigh_address": 1}'):
        with pytest.raises(ValueError, match="not a list of batctl"):
            source_outputs.values(mesh, output)


def test_the_values_of_snmp_objects_are_read() -> None:
    agent = source(
        "at: laptop\nsnmp: {address: 127.0.0.1}\nvalues:\n"
        "  signal_dbm: {oid: .1.3.6.1.4.1.99999.1.1.0}\n  band: {oid: 1.3.6.1.4.1.99999.1.2.0}\n"
        "  noise_dbm: {oid: 1.3.6.1.4.1.99999.1.3.0}\n"
        "  tx_rate_bit_s: {oid: 1.3.6.1.4.1.99999.1.4.0, factor: 1000000}\n"
        "  sinr_db: {oid: 1.3.6.1.4.1.99999.9.0}\n  cell: {oid: 1.3.6.1.2.1.2.2.1.6.1}\n"
    )
    expected = {"signal_dbm": -71.0, "band": "B7", "noise_dbm": -98.5, "tx_rate_bit_s": 144e6}
    assert source_outputs.values(agent, SNMP_OUTPUT) == expected


HTTP = source(
    "at: laptop\nhttp: {url: http://127.0.0.1/signal}\nvalues:\n"
    "  signal_dbm: {json: lte.rsrp}\n  neighbours: {json: length(cells)}\n  band: {json: lte.band}\n"
)


@pytest.mark.parametrize(
    ("printed", "expected"),
    [
        ({"lte": {"rsrp": -97, "band": 3}, "cells": [1, 2]}, {"signal_dbm": -97.0, "neighbours": 2.0, "band": "3"}),
        ({"lte": {"rsrp": "-97.5 dBm", "band": "--"}, "cells": []}, {"signal_dbm": -97.5, "neighbours": 0.0}),
        ({"lte": {"rsrp": "-97 mW", "band": True}, "cells": []}, {"neighbours": 0.0}),
        ({"lte": {"rsrp": True, "band": {}}, "cells": []}, {"neighbours": 0.0}),
        ({"lte": {"rsrp": float("nan"), "band": None}, "cells": []}, {"neighbours": 0.0}),
        ({"lte": {"rsrp": 10**400}, "cells": []}, {"neighbours": 0.0}),
        ({"lte": {"rsrp": 0}, "cells": []}, {"neighbours": 0.0}),
        ({"lte": {"rsrp": -1e9, "band": float("nan")}, "cells": []}, {"neighbours": 0.0}),
        ({"lte": {"rsrp": -97, "band": "\x1b[31mB7"}, "cells": []}, {"signal_dbm": -97.0, "neighbours": 0.0}),
        ({"lte": {"rsrp": -97, "band": "B\ufffd7"}, "cells": []}, {"signal_dbm": -97.0, "neighbours": 0.0}),
    ],
)
def test_values_of_json_have_the_type_of_their_column(printed: object, expected: Values) -> None:
    assert source_outputs.values(HTTP, json.dumps(printed)) == expected


@pytest.mark.parametrize("printed", ["-1000000000", "200", "nan", "1e3"])
def test_an_impossible_number_gives_no_value(printed: str) -> None:
    command = source(
        "command: [x]\nvalues:\n  sinr_db: {regex: '(.+)'}\n  tx_rate_bit_s: {regex: '(.+)', factor: -1e12}\n"
        "  neighbours: {regex: '(.+)', factor: 0.003}"
    )
    assert source_outputs.values(command, printed) == {}


@pytest.mark.parametrize("printed", ["<html>", "", "[" * 60_000, '{"cells": 1}', "1" * 60_000])
def test_an_output_of_another_kind_gives_a_reason(printed: str) -> None:
    with pytest.raises(ValueError, match=r"."):
        source_outputs.values(HTTP, printed)


def test_an_expression_of_a_command_takes_linear_time() -> None:
    command = source("command: [x]\nvalues: {signal_dbm: {regex: '(a+)+$'}, cell: {regex: 'bss=(\\S+)'}}")
    assert source_outputs.values(command, "a" * 60_000 + "!bss=02:aa\n") == {"cell": "02:aa"}


@settings(max_examples=40)
@given(st.text(max_size=60).map(lambda text: f'{{"modem": {text}}}') | st.binary(max_size=80).map(repr))
def test_no_output_crashes_a_parser_or_gives_an_impossible_cell(text: str) -> None:
    for telemetry_source in (source("modemmanager: {}"), source("batctl: {}"), HTTP):
        try:
            values = source_outputs.values(telemetry_source, text)
        except ValueError:
            continue
        assert all(isinstance(value, float | str) for value in values.values())


def test_every_column_is_declared_correctly() -> None:
    for column in telemetry_columns.COLUMNS:
        assert column.declaration_error() is None, column.name
    assert cell_text(None) == ""
    assert len(telemetry_columns.of_role(Role.SENDER)) == len(telemetry_columns.COLUMNS) / 2
