"""Values of a robot's telemetry sources over time, for the time line of a repeat and for exports."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from fieldkit.config.profiles import RobotProfile
from fieldkit.core.model import Role
from fieldkit.measure.attempt import AttemptEvidence
from fieldkit.measure.evidence import host
from fieldkit.telemetry import source_readings
from fieldkit.telemetry.source_outputs import Values
from fieldkit.telemetry.telemetry_section import telemetry_of


@dataclass(frozen=True)
class TelemetrySample:
    """Values of one run of a source.

    Attributes:
        utc_ns: Start of the run by the robot's clock, in nanoseconds since 1970 UTC.
        source: Name of the source.
        values: Values by quantity (`telemetry_section.Values`).
    """

    utc_ns: int
    source: str
    values: Values


def read(evidence: AttemptEvidence, role: Role, profile: RobotProfile) -> Sequence[TelemetrySample]:
    """Return the values of the sources that a robot queried during an attempt, in the order of time.

    Sources that the laptop queried are omitted: their times are counted from the boot of the laptop, and the evidence
    does not contain the time of this boot.
    """
    telemetry = telemetry_of(profile)
    state = evidence.read_or_none(host.read_state, host.before_file(role))
    if telemetry is None or state is None or state.clock is None:
        return ()
    boot_ns = (state.clock.lowest_ns + state.clock.highest_ns) // 2
    samples = []
    for name, source in telemetry.at("robot").items():
        readings = evidence.read_or_none(source_readings.read, "", role, name, source)
        if readings is not None:
            timed = zip(readings.since_boot_ns, readings.values, strict=True)
            samples += [TelemetrySample(boot_ns + at_ns, name, values) for at_ns, values in timed]
    return sorted(samples, key=lambda sample: sample.utc_ns)


def series(evidence: AttemptEvidence, role: Role, profile: RobotProfile) -> Mapping[str, Sequence[tuple[int, float]]]:
    """Return the times and numbers of each quantity that a source of the profile reports.

    The source of a quantity is the first one in the profile, as in the columns. The sequence is empty for a text, and
    for a quantity without a known time or value.
    """
    telemetry = telemetry_of(profile)
    if telemetry is None:
        return {}
    sources: dict[str, str] = {}
    for name, source in telemetry.sources.items():
        sources = dict.fromkeys(source.quantities, name) | sources
    samples = read(evidence, role, profile)
    return {
        quantity: [
            (sample.utc_ns, value)
            for sample in samples
            if sample.source == name and isinstance(value := sample.values.get(quantity), float)
        ]
        for quantity, name in sources.items()
    }
