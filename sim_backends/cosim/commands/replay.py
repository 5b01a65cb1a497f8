"""The command `fieldkit cosim replay`, which prints the numbers of a run again, from its recording."""

import argparse
import io
from pathlib import Path

from fieldkit.cli.display import show_note
from fieldkit.config import schema
from fieldkit.core import files
from fieldkit.core.errors import ConfigurationError, EvidenceError
from sim_backends.cosim.commands.results import seed_result
from sim_backends.cosim.commands.run import show_results
from sim_backends.cosim.recording.manifest import RunEnding
from sim_backends.cosim.recording.recorder import PART_S
from sim_backends.cosim.recording.replay import Recording, read_recording
from sim_backends.cosim.scenario.schema import CosimScenario


def run(arguments: argparse.Namespace) -> int:
    """Print the output of the recorded run, and write it as MCAP on request."""
    recording = recording_at(arguments.recording)
    scenario = scenario_of(recording)
    result = seed_result(scenario, recording.manifest.about.seed, recording.run, recording.states)
    show_results(arguments.format, title_of(recording), scenario, [result])
    ending, reason = recording.manifest.ending, recording.manifest.why
    if ending in {RunEnding.KILLED, RunEnding.UNDER_WAY}:
        reason = f"the recording lacks about the last {PART_S:g} s of wall time"
    if ending is not RunEnding.COMPLETE:
        show_note(f"the run did not complete ({ending}){f': {reason}' if reason else ''}")
    if arguments.mcap is not None:
        _write_mcap(arguments.mcap, recording)
    return 0


def _write_mcap(path: Path, recording: Recording) -> None:
    from sim_backends.cosim.recording.mcap import write_mcap  # noqa: PLC0415 (only --mcap needs the library mcap)

    content = io.BytesIO()
    write_mcap(content, recording)
    try:
        files.write(path, content.getvalue())
    except OSError as error:
        raise ConfigurationError(
            f"cannot be written: {error.strerror}", where=str(path), remedy="choose another --mcap"
        ) from error
    show_note(f"written: {path}")


def recording_at(folder: Path) -> Recording:
    """Return the recording in a folder.

    Raises:
        EvidenceError: The recording does not exist or is damaged, or the folder contains several recordings.
    """
    seed_folders = sorted(path.parent for path in folder.glob("seed-*/run.json"))
    if seed_folders and not (folder / "run.json").exists():
        raise EvidenceError(
            f"this folder contains the recordings of {len(seed_folders)} runs",
            where=str(folder),
            remedy=f"give the folder of one recording: {seed_folders[0]}",
        )
    return read_recording(folder)


def scenario_of(recording: Recording) -> CosimScenario:
    """Return the scenario of a recording.

    Raises:
        EvidenceError: This version of fieldkit cannot read the scenario.
    """
    manifest = recording.manifest
    try:
        return schema.validate(schema.parse(manifest.about.scenario, source="scenario"), CosimScenario)
    except ConfigurationError as error:
        remedy = f"replay it with fieldkit {manifest.versions.get('fieldkit', '')}".rstrip()
        raise EvidenceError(f"the recorded scenario cannot be read: {error.located}", remedy=remedy) from error


def title_of(recording: Recording) -> str:
    """Return a title of the recorded run: scenario, policy and seed.

    Raises:
        EvidenceError: This version of fieldkit cannot read the scenario.
    """
    about = recording.manifest.about
    name = scenario_of(recording).name
    return f"{name}, {about.policy}, seed {about.seed}"
