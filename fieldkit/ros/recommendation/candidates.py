"""Judge which middleware settings meet a criterion on a measured link, from the repeats of `topics` steps.

A candidate is a middleware with its settings and its quality of service. It passes only if it meets the criterion in
every cell, that is, for every sample size at every place. Missing data never counts as a pass: a candidate stays
undecided if there are too few valid repeats, if a delay is empty because its measurement was not accurate enough, or
if a publisher discovered no subscription. The rule is the same as for expectations (`fieldkit.analysis.judgements`):
`every loss <= BOUND`, or `90 % of loss <= BOUND` if a share is given.
"""

import json
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from fieldkit.analysis import judgements
from fieldkit.analysis.judgements import Judgement, Ruling
from fieldkit.analysis.one_sided_bounds import share_low
from fieldkit.analysis.repeats import SOURCE, Repeats
from fieldkit.measure.evidence import reading
from fieldkit.ros.middlewares.middleware import MiddlewareName
from fieldkit.ros.recommendation.link_cells import LinkCell, LinkCriterion, estimate_text, link_cell, topic_columns
from fieldkit.ros.streams.stream_options import StreamOptions
from fieldkit.steps.base import Step
from fieldkit.trial.stored import plans

_RMW: Final = re.compile(r"\brmw_[a-z_]+")


@dataclass(frozen=True)
class Candidate:
    """A middleware with settings.

    Attributes:
        middleware: Name of the middleware.
        transport: Transport of Zenoh, `tcp` or `udp`; `tcp` for all other middlewares.
        settings: Its settings by path, as JSON with sorted keys.
        qos: Reliability, history and depth, with their names in ROS 2: `reliable keep_last 10`.
    """

    middleware: str
    transport: str
    settings: str
    qos: str

    @property
    def settings_by_path(self) -> Mapping[str, str]:
        """Its settings by path."""
        return dict(json.loads(self.settings))

    def __str__(self) -> str:
        transport = f" over {self.transport}" if self.middleware == "zenoh" else ""
        return f"{self.middleware}{transport}, {self.qos}, settings {self.settings}"


@dataclass(frozen=True)
class Assessment:
    """The assessment of one candidate.

    Attributes:
        candidate: The candidate.
        cells: Its measured cells.
        failures: Reasons why it does not meet the criterion; one sentence each.
        missing_evidence: Descriptions of the missing evidence; one sentence each.
    """

    candidate: Candidate
    cells: tuple[LinkCell, ...]
    failures: tuple[str, ...]
    missing_evidence: tuple[str, ...]

    @property
    def passed(self) -> bool:
        """Whether every cell meets the criterion, and no evidence is missing."""
        return not self.failures and not self.missing_evidence

    @property
    def rank(self) -> tuple[float, float]:
        """Largest loss of any cell and largest delay of any repeat, infinity if one is unknown; smaller is better.

        The ends of the intervals are not used: the interval of repeats without a loss is wider than the interval of
        repeats with few losses.
        """
        losses = [math.inf if cell.loss is None else cell.loss.value for cell in self.cells]
        return max(losses), max(cell.largest_delay_s for cell in self.cells)


def assess(attempts: Repeats, criterion: LinkCriterion) -> list[Assessment]:
    """Assess every candidate that the trials measured.

    Args:
        attempts: Repeats with their folders, as `Sources.read` returns them.
        criterion: The criterion.
    """
    tables: dict[tuple[Candidate, str, float], list[Repeats]] = {}
    for rows, stream, prefix, rmw in _attempts_by_step(attempts):
        if criterion.size_bytes is not None and round(stream.bytes) != round(criterion.size_bytes):
            continue
        for (topology, distance), index in rows.groups(("topology", "distance")).items():
            table = topic_columns(rows.where(index), prefix)
            tables.setdefault((_candidate(stream, rmw), f"{topology}, {distance}", stream.bytes), []).append(table)
    cells: dict[Candidate, list[LinkCell]] = {}
    for (candidate, place, size_bytes), cell_tables in sorted(tables.items(), key=str):
        cells.setdefault(candidate, []).append(link_cell(place, size_bytes, cell_tables))
    required_cells = {(cell.place, cell.size_bytes) for candidate_cells in cells.values() for cell in candidate_cells}
    return [
        assess_candidate(candidate, candidate_cells, required_cells, criterion)
        for candidate, candidate_cells in cells.items()
    ]


def _attempts_by_step(attempts: Repeats) -> Iterator[tuple[Repeats, StreamOptions, str, str]]:
    """Yield the attempts of each trial, once for each `topics` step, with the step, its column prefix and RMW."""
    for folder in dict.fromkeys(attempts.texts[SOURCE]):
        if not folder or not Path(folder).is_dir():
            continue  # a CSV file without its trial does not contain the plan
        rows = attempts.where(attempts.texts[SOURCE] == folder)
        for placed in plans.read_plan(Path(folder)).procedure.walk():
            if isinstance(placed.step, StreamOptions) and not placed.disturbed:
                yield rows, placed.step, placed.step.prefix, _rmw(Path(folder), placed.step)


def _rmw(folder: Path, step: StreamOptions) -> str:
    """Return the RMW that the publishers of a trial reported, or `unknown` if they reported none or several.

    It is empty if the step does not use the robot's ROS 2.
    """
    if step.over is not MiddlewareName.ROS2 or not isinstance(step, Step):
        return ""
    logs = folder.glob(f"repeats/*/{step.prefixed_name(f'{step.sender}-topic.log')}")
    rmws = {match[0] for log in logs for match in _RMW.finditer(reading.text(log))}
    return rmws.pop() if len(rmws) == 1 else "unknown"


def _candidate(stream: StreamOptions, rmw: str) -> Candidate:
    quality = stream.qos.resolved()
    words = (quality.reliability.name.lower(), quality.history.name.lower(), str(quality.depth))
    by_path = {
        **stream.middleware_settings,
        **({"RMW_IMPLEMENTATION": rmw} if stream.over is MiddlewareName.ROS2 else {}),
    }
    settings = json.dumps(by_path, sort_keys=True)
    return Candidate(stream.over.value, stream.transport, settings, " ".join(words))


def assess_candidate(
    candidate: Candidate, cells: Sequence[LinkCell], required_cells: set[tuple[str, float]], criterion: LinkCriterion
) -> Assessment:
    """Return the assessment of a candidate.

    Args:
        candidate: The candidate.
        cells: Its measured cells.
        required_cells: The places and sample sizes at which any candidate was measured.
        criterion: The criterion.
    """
    failures: list[str] = []
    missing_evidence: list[str] = []
    for place, size_bytes in sorted(required_cells - {(cell.place, cell.size_bytes) for cell in cells}):
        missing_evidence.append(f"{place}, {size_bytes:g} B: not measured, although other candidates were")
    for cell in cells:
        valid_count = 0 if cell.loss is None else cell.loss.n
        if valid_count < criterion.repeats:
            missing_evidence.append(
                f"{cell}: {valid_count} of {criterion.repeats} valid repeats with samples; run more"
            )
        for judgement in judgements.judge(criterion.expectations, [cell.cell]):
            if not judgement.holds:
                reasons = failures if judgement.ruling is Ruling.FAILS else missing_evidence
                reasons.append(f"{cell}: {_reason(judgement)}")
    return Assessment(candidate, tuple(cells), tuple(failures), tuple(missing_evidence))


def _reason(judgement: Judgement) -> str:
    """Return the reason why an expectation is not met, with the measured values."""
    expectation_text = judgement.expectation.text
    if judgement.estimate is None or judgement.met is None:
        return f"{expectation_text}: {judgement.why or 'undecided'}"
    note = f"; {judgement.why}" if judgement.why else ""
    counts = f"in {judgement.met} of {judgement.estimate.n} repeats, up to {judgement.estimate.maximum:.3g}"
    return f"{expectation_text} {counts}{note}"


def evidence(assessment: Assessment, criterion: LinkCriterion) -> Iterator[str]:
    """Yield the lines of the comment that documents a candidate's measurements in its settings file."""
    yield "Written by fieldkit middleware recommend from measured trials."
    yield f"Measured: {assessment.candidate}."
    yield f"Criterion: {criterion}."
    for cell in assessment.cells:
        valid_text = f"{cell.cell.n_valid} of {cell.attempts} repeats are valid"
        yield f"{cell.place}, samples of {cell.size_bytes:g} B: {valid_text}."
        for judgement in judgements.judge(criterion.expectations, [cell.cell]):
            if judgement.estimate is not None and judgement.met is not None:
                met, n = judgement.met, judgement.estimate.n
                share_text = f"at least {100 * share_low(met, n):.0f} % of all repeats, with 95 % confidence"
                yield f"  {judgement.expectation.text} in {met} of {n} repeats: in {share_text}"
        yield f"  loss in %: {estimate_text(cell.loss, 100.0)}"
        yield f"  95th percentile of the sample delay in ms: {estimate_text(cell.delay, 1e3)}"
        yield f"  trials: {', '.join(cell.sources)}"
