"""Trials as JUnit XML for CI servers: a suite for each trial, a case for each repeat and each expectation.

The format is the xunit schema of Jenkins, which GitLab, GitHub Actions and other servers read.
"""

from collections import defaultdict
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Final
from xml.etree import ElementTree as ET

from fieldkit.analysis import judgements, table_files
from fieldkit.analysis.cells import aggregate
from fieldkit.analysis.judgement_words import judgement_texts
from fieldkit.analysis.judgements import Judgement
from fieldkit.analysis.quantities import quantities
from fieldkit.core import files
from fieldkit.core.model import FINAL_STATUSES, RepeatId, Status
from fieldkit.core.text import sanitized
from fieldkit.trial import journal, store
from fieldkit.trial.journal import JournalEntry
from fieldkit.trial.plan import Plan
from fieldkit.trial.stored import plans

_SEPARATOR: Final = "."
"""Separator in class names. Servers group cases by class names."""


def write(path: Path, folders: Iterable[Path]) -> None:
    """Write trials to a file. An existing file is replaced.

    Args:
        path: The file.
        folders: The trials' folders.

    Raises:
        ConfigurationError: A folder is not a trial.
        EvidenceError: A journal or a table cannot be read.
        OSError: The file cannot be written.
    """
    files.write(path, text(folders))


def text(folders: Iterable[Path]) -> bytes:
    """Return trials as XML. Raises the same errors as `write`."""
    top = ET.Element("testsuites", name="fieldkit")
    # This is a list, because `extend` converts an exception of an iterator to a TypeError.
    top.extend([_suite(folder) for folder in folders])
    for element in top.iter():  # sanitizes all texts and attributes, which can have any source
        element.text = element.text and sanitized(element.text)
        element.attrib.update({name: sanitized(value) for name, value in element.attrib.items()})
    ET.indent(top)
    return bytes(ET.tostring(top, encoding="utf-8", xml_declaration=True)) + b"\n"


def _suite(folder: Path) -> ET.Element:
    plan = plans.read_plan(folder)
    cases = [*_repeat_cases(plan, journal.history(folder, plan)), *map(_expectation_case, _judgements(folder, plan))]
    group = _SEPARATOR.join(("fieldkit", plan.procedure.name, plan.distance.replace(_SEPARATOR, "_"), plan.topology))
    for case in cases:
        case.set("classname", group)
    failed, skipped = (sum(case.find(kind) is not None for case in cases) for kind in ("failure", "skipped"))
    attributes = {"name": plan.trial, "tests": len(cases), "failures": failed, "errors": 0, "skipped": skipped}
    suite = ET.Element("testsuite", {name: str(value) for name, value in attributes.items()})
    suite.extend(cases)
    return suite


def _repeat_cases(plan: Plan, entries: Iterable[JournalEntry]) -> Iterator[ET.Element]:
    """Yield a case for each planned repeat, in order. The case of a repeat that has not ended is skipped."""
    entries_by_repeat = defaultdict[RepeatId, list[JournalEntry]](list)
    for entry in entries:
        entries_by_repeat[entry.repeat].append(entry)
    for repeat in plan.repeats_in_order():
        duration_s, reasons = 0.0, list[str]()
        started_ns, last_status = 0, Status.PLANNED
        for entry in entries_by_repeat[repeat]:
            started_ns = entry.utc_ns if entry.status is Status.RUNNING else started_ns
            if entry.status in FINAL_STATUSES:
                duration_s += max(entry.utc_ns - started_ns, 0) / 1e9
                reasons += [f"attempt {entry.attempt} {entry.status}: {entry.reason}"] if entry.reason else []
            last_status = entry.status
        case = ET.Element("testcase", name=str(repeat), time=f"{duration_s:.3f}")
        if last_status is Status.FAILED:
            _add(case, "failure", reasons[-1] if reasons else "")
        elif last_status is not Status.VALID:
            _add(case, "skipped", "the repeat has not ended; fieldkit resume continues the trial")
        if reasons:
            ET.SubElement(case, "system-out").text = "\n".join(reasons)
        yield case


def _judgements(folder: Path, plan: Plan) -> tuple[Judgement, ...]:
    """Return the judgements of a trial's expectations. All are undecided before the first attempt has ended."""
    if not plan.procedure.expect:
        return ()
    table = folder / store.TRIAL_CSV
    rows = table_files.read([table], plan.table) if table.exists() else None
    cells = () if rows is None else aggregate(rows, quantities=quantities(plan.table))
    return judgements.judge(plan.procedure.expectations, cells)


def _expectation_case(judgement: Judgement) -> ET.Element:
    expected, subject, measured, interval, ruling = judgement_texts(judgement)
    case = ET.Element("testcase", name=f"{expected} ({subject})" if subject else expected, time="0")
    if not judgement.holds:
        _add(case, "failure", f"{ruling}: {measured} {interval}".rstrip())
    return case


def _add(case: ET.Element, kind: str, message: str) -> None:
    ET.SubElement(case, kind, message=message)
