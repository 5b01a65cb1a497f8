"""Trials as JUnit XML, which CI servers show: a suite per trial, a case per repeat and per expectation.

The form is that of Jenkins' xunit schema, which GitLab, GitHub actions and others read.
"""

from collections import defaultdict
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Final
from xml.etree import ElementTree as ET

from fieldkit.analysis import judgements, repeats, wording
from fieldkit.analysis.cells import aggregate
from fieldkit.analysis.judgements import Judgement
from fieldkit.analysis.quantities import quantities
from fieldkit.core import files
from fieldkit.core.model import ENDED, RepeatId, Status
from fieldkit.core.text import harmless
from fieldkit.trial import journal, store
from fieldkit.trial.journal import JournalEntry
from fieldkit.trial.plan import Plan

_UNDER: Final = "."
"""Between the parts of a class name, by which servers make groups."""


def write(path: Path, folders: Iterable[Path]) -> None:
    """Write trials into a file, in place of what was there.

    Args:
        path: The file.
        folders: The trials' folders.

    Raises:
        ConfigurationError: A folder is no trial.
        EvidenceError: A journal or a table cannot be read.
        OSError: The file cannot be written.
    """
    files.write(path, text(folders))


def text(folders: Iterable[Path]) -> bytes:
    """Return trials as XML; errors as `write`."""
    top = ET.Element("testsuites", name="fieldkit")
    # A list: `extend` turns an error of what it is given into a TypeError of its own.
    top.extend([_suite(folder) for folder in folders])
    for element in top.iter():  # every text and attribute, whatever wrote it
        element.text = element.text and harmless(element.text)
        element.attrib.update({name: harmless(value) for name, value in element.attrib.items()})
    ET.indent(top)
    return bytes(ET.tostring(top, encoding="utf-8", xml_declaration=True)) + b"\n"


def _suite(folder: Path) -> ET.Element:
    plan = store.read_plan(folder)
    cases = [*_repeats(plan, journal.history(folder, plan)), *map(_expected, _judgements(folder, plan))]
    group = _UNDER.join(("fieldkit", plan.procedure.name, plan.distance.replace(_UNDER, "_"), plan.topology))
    for case in cases:
        case.set("classname", group)
    failed, skipped = (sum(case.find(kind) is not None for case in cases) for kind in ("failure", "skipped"))
    said = {"name": plan.trial, "tests": len(cases), "failures": failed, "errors": 0, "skipped": skipped}
    suite = ET.Element("testsuite", {name: str(value) for name, value in said.items()})
    suite.extend(cases)
    return suite


def _repeats(plan: Plan, entries: Iterable[JournalEntry]) -> Iterator[ET.Element]:
    """Yield a case per planned repeat, in order; one that is not over is skipped."""
    of_repeat = defaultdict[RepeatId, list[JournalEntry]](list)
    for entry in entries:
        of_repeat[entry.repeat].append(entry)
    for repeat in plan.order():
        took_s, said = 0.0, list[str]()
        began_ns, last = 0, Status.PLANNED
        for entry in of_repeat[repeat]:
            began_ns = entry.utc_ns if entry.status is Status.RUNNING else began_ns
            if entry.status in ENDED:
                took_s += max(entry.utc_ns - began_ns, 0) / 1e9
                said += [f"attempt {entry.attempt} {entry.status}: {entry.reason}"] if entry.reason else []
            last = entry.status
        case = ET.Element("testcase", name=str(repeat), time=f"{took_s:.3f}")
        if last is Status.FAILED:
            _add(case, "failure", said[-1] if said else "")
        elif last is not Status.VALID:
            _add(case, "skipped", "it is not over; fieldkit resume goes on with the trial")
        if said:
            ET.SubElement(case, "system-out").text = "\n".join(said)
        yield case


def _judgements(folder: Path, plan: Plan) -> tuple[Judgement, ...]:
    """Judge what a trial expects; without its table, which it has from the first attempt on, nothing is decided."""
    if not plan.procedure.expect:
        return ()
    table = folder / store.TRIAL_CSV
    rows = repeats.read([table], plan.table) if table.exists() else None
    cells = () if rows is None else aggregate(rows, quantities=quantities(plan.table))
    return judgements.judge(plan.procedure.expectations, cells)


def _expected(one: Judgement) -> ET.Element:
    expected, of, measured, interval, ruling = wording.judged(one)
    case = ET.Element("testcase", name=f"{expected} ({of})" if of else expected, time="0")
    if not one.holds:
        _add(case, "failure", f"{ruling}: {measured} {interval}".rstrip())
    return case


def _add(case: ET.Element, kind: str, message: str) -> None:
    ET.SubElement(case, kind, message=message)
