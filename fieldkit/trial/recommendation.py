"""Which settings of a middleware kept a criterion on a measured link, by the repeats of steps `topics`.

A candidate is a middleware with its settings and quality of service. It passes only if it kept the criterion in every
cell, which is a size of samples at a place. What is missing never counts as good: too few valid repeats, a delay that
was withheld, or a publisher that found no subscription leave a candidate undecided. The rule is that of expectations
(`fieldkit.analysis.judgements`): `every loss <= BOUND`, or `90 % of loss <= BOUND` with a share.
"""

import json
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from fieldkit.analysis import judgements
from fieldkit.analysis.bounds import share_low
from fieldkit.analysis.judgements import Judgement, Ruling
from fieldkit.analysis.repeats import SOURCE, Repeats
from fieldkit.measure.evidence import reading
from fieldkit.steps.base import Step
from fieldkit.steps.middlewares import Over
from fieldkit.steps.streams import StreamOptions
from fieldkit.trial import store
from fieldkit.trial.link_cells import LinkCell, LinkCriterion, figure, link_cell, topic_columns

_RMW: Final = re.compile(r"\brmw_[a-z_]+")


@dataclass(frozen=True)
class Candidate:
    """A middleware with settings.

    Attributes:
        over: The middleware.
        transport: What carries Zenoh.
        settings: Its settings by their path, as JSON with sorted keys.
        quality: `reliability history depth` in ROS 2's words.
    """

    over: str
    transport: str
    settings: str
    quality: str

    @property
    def by_path(self) -> Mapping[str, str]:
        """Its settings by their path."""
        return dict(json.loads(self.settings))

    def __str__(self) -> str:
        carried = f" by {self.transport}" if self.over == "zenoh" else ""
        return f"{self.over}{carried}, {self.quality}, settings {self.settings}"


@dataclass(frozen=True)
class Assessment:
    """A candidate, judged.

    Attributes:
        candidate: The candidate.
        cells: Its evidence.
        failed: Why it does not keep the criterion; a sentence each.
        lacking: What evidence is missing; a sentence each.
    """

    candidate: Candidate
    cells: tuple[LinkCell, ...]
    failed: tuple[str, ...]
    lacking: tuple[str, ...]

    @property
    def passed(self) -> bool:
        """Whether every cell kept the criterion."""
        return not self.failed and not self.lacking

    @property
    def rank(self) -> tuple[float, float]:
        """The loss of the worst cell, and the largest delay of any repeat: the smaller, the better.

        Not the end of an interval: that of repeats without a loss is wider than that of repeats with few.
        """
        losses = [math.inf if cell.loss is None else cell.loss.value for cell in self.cells]
        return max(losses), max(cell.largest_delay_s for cell in self.cells)


def assess(attempts: Repeats, criterion: LinkCriterion) -> list[Assessment]:
    """Judge every candidate that trials measured.

    Args:
        attempts: Repeats with their folders, as `Sources.read` returns them.
        criterion: What must be kept.
    """
    tables: dict[tuple[Candidate, str, float], list[Repeats]] = {}
    for rows, stream, prefix, rmw in _measured(attempts):
        if criterion.size_bytes is not None and round(stream.bytes) != round(criterion.size_bytes):
            continue
        for (topology, distance), index in rows.groups(("topology", "distance")).items():
            table = topic_columns(rows.where(index), prefix)
            tables.setdefault((_candidate(stream, rmw), f"{topology}, {distance}", stream.bytes), []).append(table)
    cells: dict[Candidate, list[LinkCell]] = {}
    for (candidate, place, size_bytes), several in sorted(tables.items(), key=str):
        cells.setdefault(candidate, []).append(link_cell(place, size_bytes, several))
    wanted = {(cell.place, cell.size_bytes) for own in cells.values() for cell in own}
    return [judged(candidate, own, wanted, criterion) for candidate, own in cells.items()]


def _measured(attempts: Repeats) -> Iterator[tuple[Repeats, StreamOptions, str, str]]:
    """Yield the attempts of each trial with each of its steps `topics`, the prefix of its columns, and its RMW."""
    for folder in dict.fromkeys(attempts.texts[SOURCE]):
        if not folder or not Path(folder).is_dir():
            continue  # a table alone does not say what was streamed
        rows = attempts.where(attempts.texts[SOURCE] == folder)
        for placed in store.read_plan(Path(folder)).procedure.walk():
            if isinstance(placed.step, StreamOptions) and not placed.disturbed:
                yield rows, placed.step, placed.step.prefix, _rmw(Path(folder), placed.step)


def _rmw(folder: Path, step: StreamOptions) -> str:
    """Return the RMW that the publishers of a trial reported; `unknown` if none, or several, did."""
    if step.over is not Over.ROS2 or not isinstance(step, Step):
        return ""
    logs = folder.glob(f"repeats/*/{step.own_name(f'{step.sender}-topic.log')}")
    reported = {match[0] for log in logs for match in _RMW.finditer(reading.text(log))}
    return reported.pop() if len(reported) == 1 else "unknown"


def _candidate(stream: StreamOptions, rmw: str) -> Candidate:
    quality = stream.qos.resolved()
    words = (quality.reliability.name.lower(), quality.history.name.lower(), str(quality.depth))
    by_path = {**stream.own_settings, **({"RMW_IMPLEMENTATION": rmw} if stream.over is Over.ROS2 else {})}
    settings = json.dumps(by_path, sort_keys=True)
    return Candidate(stream.over.value, stream.transport, settings, " ".join(words))


def judged(
    candidate: Candidate, cells: Sequence[LinkCell], wanted: set[tuple[str, float]], criterion: LinkCriterion
) -> Assessment:
    """Return whether a candidate kept a criterion.

    Args:
        candidate: The candidate.
        cells: What was measured of it.
        wanted: Places and sizes that any candidate has.
        criterion: What must be kept.
    """
    failed: list[str] = []
    lacking: list[str] = []
    for place, size_bytes in sorted(wanted - {(cell.place, cell.size_bytes) for cell in cells}):
        lacking.append(f"{place}, {size_bytes:g} B: it was not measured; the others were")
    for cell in cells:
        n = 0 if cell.loss is None else cell.loss.n
        if n < criterion.repeats:
            lacking.append(f"{cell}: {n} of {criterion.repeats} valid repeats with samples; run more")
        for judgement in judgements.judge(criterion.expectations, [cell.cell]):
            if not judgement.holds:
                (failed if judgement.ruling is Ruling.FAILS else lacking).append(f"{cell}: {_reason(judgement)}")
    return Assessment(candidate, tuple(cells), tuple(failed), tuple(lacking))


def _reason(judgement: Judgement) -> str:
    """Return why a judgement does not hold, with its figure."""
    unknown, demand = judgement.why or "not shown", judgement.expectation.text
    if judgement.found is None or judgement.met is None:
        return f"{demand}: {unknown}"
    why = f"; {judgement.why}" if judgement.why else ""
    return f"{demand} in {judgement.met} of {judgement.found.n} repeats, up to {judgement.found.maximum:.3g}{why}"


def evidence(assessment: Assessment, criterion: LinkCriterion) -> Iterator[str]:
    """Yield what was measured of a candidate, line by line, for the comment of its file."""
    yield "Written by fieldkit middleware recommend from measured trials."
    yield f"Measured: {assessment.candidate}."
    yield f"Criterion: {criterion}."
    for cell in assessment.cells:
        yield f"{cell.place}, samples of {cell.size_bytes:g} B: {cell.cell.n_valid} of {cell.attempts} repeats count."
        for judgement in judgements.judge(criterion.expectations, [cell.cell]):
            if judgement.found is not None and judgement.met is not None:
                met, n = judgement.met, judgement.found.n
                least = f"{100 * share_low(met, n):.0f} % of all repeats do, with 95 % confidence"
                yield f"  {judgement.expectation.text} in {met} of {n} repeats: at least {least}"
        yield f"  loss in %: {figure(cell.loss, 100.0)}"
        yield f"  delay of 95 % of the samples in ms: {figure(cell.delay, 1e3)}"
        yield f"  trials: {', '.join(cell.sources)}"
