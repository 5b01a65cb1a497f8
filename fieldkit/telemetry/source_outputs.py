"""Extract the values from an output of a telemetry source.

The outputs of mmcli and batctl have known formats. For every other program, the profile gives the location of each
value in the output. Outputs are not trusted: JSON may have any shape and any numbers. A value that is missing or of
the wrong type is omitted from the result; it is never 0.
"""

import json
import re
from collections.abc import Iterator, Mapping
from typing import Final

from fieldkit.core.text import shorten
from fieldkit.measure.evidence import program_output
from fieldkit.telemetry.telemetry_section import Extraction, TelemetrySource

Values = Mapping[str, float | str]
"""Values by name, as in `telemetry_section.Values`."""

TEXTS: Final = frozenset({"band", "cell"})
"""Names of the values that are text; the others are numbers."""
_NUMBER: Final = re.compile(r"([+-]?[0-9]{1,15}(?:\.[0-9]{1,9})?)(?: ?(dBm|dB))?", re.ASCII)
_UNITS: Final = {"signal_dbm": "dBm", "noise_dbm": "dBm", "sinr_db": "dB"}
_MISSING_TEXTS: Final = frozenset({"", "--", "unknown", "n/a", "none", "null", "nan"})

_MIN_POWER_DBM: Final = -200.0
_MAX_SINR_DB: Final = 100.0
_MAX_NEIGHBOURS: Final = 1e6
_MAX_RATE_BIT_S: Final = 1e12
"""Bounds far outside the values of any radio; a number beyond them is not a measurement."""

_MAX_AGE_S: Final = 10.0
"""A mesh node counts as a neighbour if it was heard within this time. Nodes announce themselves every second, and are
listed for 200 s after they have disappeared (batman-adv, `BATADV_PURGE_TIMEOUT`)."""

_UMTS: Final = frozenset({"umts", "hsdpa", "hsupa", "hspa", "hspa-plus"})
_SIGNALS: Final = (
    (frozenset({"lte", "lte-cat-m", "lte-nb-iot"}), "lte", "rsrp", "snr"),
    (frozenset({"5gnr"}), "5g", "rsrp", "snr"),
    (_UMTS, "umts", "rscp", ""),
    (frozenset({"evdo0", "evdoa", "evdob"}), "evdo", "rssi", "sinr"),
    (frozenset({"1xrtt"}), "cdma1x", "rssi", ""),
    (frozenset({"gsm", "gsm-compact", "gprs", "edge"}), "gsm", "rssi", ""),
)
"""Access technologies, their key in the output of `mmcli --signal-get -J`, and the keys of signal and SINR."""

_CHANNELS: Final = ("earfcn", "nrarfcn", "uarfcn", "arfcn")
"""Names of channel numbers in mmcli's `cell-info`."""

# Lines of batctl's table of neighbours. Lines of BATMAN IV start with the interface, lines of BATMAN V with the node.
_MESH_LINE: Final = re.compile(
    r"^[ \t]*(?:[A-Za-z0-9._-]{1,15}[ \t]+)?([0-9a-f]{2}(?::[0-9a-f]{2}){5})[ \t]+([0-9]{1,6}\.[0-9]{3})s",
    re.MULTILINE | re.ASCII,
)
_SNMP_LINE: Final = re.compile(r"^(\.[0-9.]{5,300}) (.{1,2000})$", re.MULTILINE | re.ASCII)


def values(source: TelemetrySource, output: str) -> Values:
    """Return the values in one output of a source.

    Raises:
        ValueError: The output has another format; the message continues a sentence that begins with `its output`.
    """
    match source.kind:
        case "modemmanager":
            return modem_values(output)
        case "batctl":
            return mesh_values(output)
        case "snmp":
            return _values_at_locations(source, dict(_SNMP_LINE.findall(output)))
        case _:
            return _values_at_locations(source, output)


def _values_at_locations(source: TelemetrySource, output: str | Mapping[str, str]) -> Values:
    """Return the values at the locations of the profile, in text or in objects of SNMP."""
    document: object = None
    values_by_name: dict[str, float | str] = {}
    for name, location in source.values.items() if source.values is not None else ():
        if isinstance(output, str):
            if location.path is not None and document is None:
                document = program_output.parse_json(output)
            extracted = (
                program_output.search_json(document, location.path)
                if location.path is not None
                else program_output.search_text(output, location.expression or "")
            )
        else:
            extracted = _snmp_value(output, location)
        if (value := _value(name, extracted, location.factor)) is not None:
            values_by_name[name] = value
    return values_by_name


def _snmp_value(objects: Mapping[str, str], location: Extraction) -> str | None:
    """Return the value of an object; None if the agent has no such object."""
    text = objects.get(f".{(location.oid or '').lstrip('.')}", "").strip()
    if not text or text.startswith(("No Such ", "No more variables")):
        return None
    return text[1:-1] if len(text) > 1 and text[0] == text[-1] == '"' else text


def _value(name: str, extracted: object, factor: float = 1) -> float | str | None:
    """Return a value in the type of its column; None if it cannot be converted."""
    if isinstance(extracted, bool | list | dict) or extracted is None:
        return None
    if name in TEXTS:
        text = " ".join(str(extracted)[:200].split())
        # The replacement character stands for bytes that are not UTF-8.
        if text.lower() in _MISSING_TEXTS or not text.isprintable() or "\N{REPLACEMENT CHARACTER}" in text:
            return None
        return shorten(text)
    if isinstance(extracted, str):
        match = _NUMBER.fullmatch(extracted.strip())
        if match is None or (match[2] and match[2] != _UNITS.get(name)):
            return None
        number = float(match[1])
    else:
        try:
            number = float(extracted)  # type: ignore[arg-type]
        except (TypeError, ValueError, OverflowError):
            return None
    number *= factor
    return number if _is_possible(name, number) else None


def _is_possible(name: str, number: float) -> bool:
    """Return True if a radio can have a value; False for NaN."""
    match name:
        case "signal_dbm" | "noise_dbm":
            # Drivers of modems and radios report 0 or a positive number for an unknown signal, as Wi-Fi drivers do.
            return _MIN_POWER_DBM <= number < 0
        case "sinr_db":
            return abs(number) <= _MAX_SINR_DB
        case "neighbours":
            return 0 <= number <= _MAX_NEIGHBOURS and number.is_integer()
        case _:  # tx_rate_bit_s, rx_rate_bit_s
            return 0 <= number <= _MAX_RATE_BIT_S


def _documents(output: str) -> Iterator[object]:
    """Yield the JSON values in an output with one value per line; other lines are skipped."""
    for line in output.splitlines():
        if line[:1] in {"{", "["}:
            try:
                yield json.loads(line)
            except (ValueError, RecursionError):
                continue


def _value_at(document: object, *keys: str) -> object:
    for key in keys:
        document = document.get(key) if isinstance(document, dict) else None
    return document


def modem_values(output: str) -> Values:
    """Return the values in the outputs of mmcli: signal, modem, and cells or location, each a line of JSON.

    The signal is measured in the access technology in use: RSRP for LTE and 5G, RSCP for UMTS, otherwise RSSI. If LTE
    and 5G are in use at the same time (NSA), the signal of LTE is used, because LTE has the serving cell.

    Raises:
        ValueError: There is no JSON of mmcli.
    """
    modems = [modem for document in _documents(output) if isinstance(modem := _value_at(document, "modem"), dict)]
    if not modems:
        raise ValueError("is not JSON of mmcli")
    merged: dict[str, object] = {}
    for modem in modems:
        for key, content in modem.items():
            earlier_content = merged.get(key)
            are_mappings = isinstance(earlier_content, dict) and isinstance(content, dict)
            merged[key] = {**earlier_content, **content} if are_mappings else content  # type: ignore[dict-item]
    technologies = _texts(_value_at(merged, "generic", "access-technologies"))
    values_by_name = _modem_signal(_value_at(merged, "signal"), technologies)
    cells = [dict(_cell_fields(text)) for text in _texts(_value_at(merged, "generic", "cell-info"))]
    serving = next((cell for cell in cells if cell.get("serving") == "yes"), {})
    channels = (f", {key.upper()} {serving[key]}" for key in _CHANNELS if key in serving)
    channel = next(channels, "")
    band = f"{serving.get('cell type') or '/'.join(technologies)}{channel}"
    cell = serving.get("ci") or _value_at(merged, "location", "3gpp", "cid")
    operator = _value_at(merged, "3gpp", "operator-code")
    for name, text in (("band", band), ("cell", cell)):
        if (value := _value(name, text)) is not None:
            values_by_name[name] = value
    known_operator = _value("cell", operator)
    if "cell" in values_by_name and known_operator is not None:
        values_by_name["cell"] = f"{known_operator} {values_by_name['cell']}"
    if cells:
        values_by_name["neighbours"] = float(sum(cell.get("serving") == "no" for cell in cells))
    return values_by_name


def _modem_signal(signal: object, technologies: list[str]) -> dict[str, float | str]:
    """Return signal and SINR of the first technology in use that has a signal."""
    for names, key, power, ratio in _SIGNALS:
        # Values of another technology are from an earlier connection, and have another meaning.
        if technologies and not names & set(technologies):
            continue
        signal_dbm = _value("signal_dbm", _value_at(signal, key, power))
        if signal_dbm is None:
            continue
        sinr_db = _value("sinr_db", _value_at(signal, key, ratio)) if ratio else None
        return {"signal_dbm": signal_dbm} | ({} if sinr_db is None else {"sinr_db": sinr_db})
    return {}


def _texts(items: object) -> list[str]:
    """Return the texts of a JSON list. Their number and lengths are limited, because outputs are not trusted."""
    return [item[:500] for item in items[:100] if isinstance(item, str)] if isinstance(items, list) else []


def _cell_fields(text: str) -> Iterator[tuple[str, str]]:
    """Yield the name and value of each field in a text such as `cell type: lte, serving: yes, ci: 01A2D001`."""
    for field in text.split(", "):
        name, separator, value = field.partition(": ")
        if separator:
            yield name, value


def mesh_values(output: str) -> Values:
    """Return the number of neighbours in the outputs of batctl: its neighbours, an empty line, and its originators.

    The list of originators, which are all nodes of the mesh, is not used.

    Raises:
        ValueError: The output is neither JSON nor a table of batctl.
    """
    tables = re.split(r"\n\s*\n", output.strip(), maxsplit=1)
    ages = _mesh_ages(tables[0])
    return {"neighbours": float(sum(min(seen_s) <= _MAX_AGE_S for seen_s in ages.values()))}


def _mesh_ages(table: str) -> dict[str, list[float]]:
    """Return the times since each node was heard, by its address; a node can be heard on several interfaces."""
    ages: dict[str, list[float]] = {}
    text = table.strip()
    if text.startswith("["):
        try:
            nodes = program_output.parse_json(text)
        except ValueError:
            nodes = None  # the header line of a table also begins with a bracket
        if isinstance(nodes, list):
            for node in nodes:
                address, age_ms = _value_at(node, "neigh_address"), _value_at(node, "last_seen_msecs")
                if isinstance(address, str) and isinstance(age_ms, int) and not isinstance(age_ms, bool):
                    ages.setdefault(address[:40], []).append(age_ms / 1e3)
            return ages
    if "B.A.T.M.A.N" not in text and _MESH_LINE.search(text) is None:
        raise ValueError("is not a list of batctl")
    for match in _MESH_LINE.finditer(text):
        ages.setdefault(match[1], []).append(float(match[2]))
    return ages
