"""Runs a scenario once per seed and reports the progress; SIGINT stops a run, but not while it records a window."""

import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, nullcontext
from functools import partial
from types import FrameType

from fieldkit.config import schema
from fieldkit.core.errors import ConfigurationError, FieldkitError
from fieldkit.core.events import Sink
from fieldkit.core.executors import Workers
from sim_backends.cosim.commands.results import SeedResult, seed_result
from sim_backends.cosim.commands.run_folder import RunFolder
from sim_backends.cosim.commands.settings import progress_reporter
from sim_backends.cosim.coordinator import Coordinator
from sim_backends.cosim.real_time import Pace, WindowLateness
from sim_backends.cosim.recording.manifest import RunSettings
from sim_backends.cosim.recording.recorder import CAPTURES, RunRecorder, StateSamples
from sim_backends.cosim.run_record import WindowObserver
from sim_backends.cosim.scenario.build import build, captured_flows
from sim_backends.cosim.scenario.emane import EmaneObserver, emane_observer
from sim_backends.cosim.scenario.external import has_addresses
from sim_backends.cosim.scenario.schema import CosimScenario
from sim_backends.cosim.studies.formation import has_followers
from sim_backends.cosim.studies.seeds import ALL_PROCESSORS, Task, as_completed_tasks, workers_for
from sim_backends.cosim.wall_time import DEADLINE_S


@contextmanager
def interrupt_between_windows(coordinator: Coordinator) -> Iterator[None]:
    """Delay the `KeyboardInterrupt` of SIGINT while a window is being hashed and recorded.

    Outside the main thread, or if SIGINT has another handler, this context manager has no effect.

    Args:
        coordinator: The coordinator of the run.
    """
    in_main_thread = threading.current_thread() is threading.main_thread()
    if not in_main_thread or signal.getsignal(signal.SIGINT) is not signal.default_int_handler:
        yield
        return

    def interrupt(number: int, frame: FrameType | None) -> None:
        if coordinator.is_committing:
            coordinator.is_interrupted = True
        else:
            signal.default_int_handler(number, frame)

    coordinator.is_committing = coordinator.is_interrupted = False
    signal.signal(signal.SIGINT, interrupt)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, signal.default_int_handler)


def simulate(
    scenario: CosimScenario,
    policy: str,
    seed: int,
    folder: RunFolder | None,
    *,
    progress: Callable[[int, float], None] | None = None,
    deadline_s: float | None = DEADLINE_S,
    pace: Pace | None = None,
) -> SeedResult:
    """Run a scenario with a seed, and return the result, also if the run failed or was interrupted.

    With a folder, the rows of the run are written to it.

    Args:
        scenario: The scenario.
        policy: Name of the sync policy.
        seed: The seed.
        folder: The folder for recording and rows, or None.
        progress: Called with the simulated nanoseconds so far and the elapsed wall time in seconds, or None.
        deadline_s: Longest wait for an answer of a federate, in seconds of wall time; None for no deadline.
        pace: Pace of a run in real time; None to run as fast as possible.

    Raises:
        FieldkitError: The simulation cannot be built, or physics returns no states at time 0.
        ConfigurationError: The run is complete, but its rows cannot be written.
    """
    recorder = None
    if folder is not None:
        run_settings = RunSettings(schema.dump(scenario), policy, scenario.policy.parameters, seed)
        recorder = RunRecorder(
            folder.recording(seed), run_settings, agents=scenario.lifetimes, flows=captured_flows(scenario.traffic)
        )
    samples = StateSamples(recorder) if has_followers(scenario) else None
    observer: WindowObserver | None = samples or recorder
    publisher: EmaneObserver | nullcontext[None] = nullcontext()
    if scenario.emane is not None:
        observer = publisher = emane_observer(scenario, seed, observer)
    captures = None if folder is None else folder.recording(seed) / CAPTURES
    simulation = build(
        scenario, policy=policy, seed=seed, recorder=observer, deadline_s=deadline_s, captures=captures
    )
    agents = simulation.agents
    start_states = {name: absence.state for name, absence in agents.absent.items()} | dict(agents.states(0).items())
    ended_by: FieldkitError | KeyboardInterrupt | None = None
    lateness = None if pace is None else WindowLateness()
    try:
        with simulation, publisher, recorder or nullcontext(), interrupt_between_windows(simulation.coordinator):
            if pace is None or lateness is None:
                simulation.run(progress=progress)
            else:
                pace.run(simulation, lateness, progress)
    except (FieldkitError, KeyboardInterrupt) as error:
        ended_by = error
    states = [] if samples is None else samples.states
    result = seed_result(
        scenario,
        seed,
        simulation.coordinator.run,
        states,
        ended_by=ended_by,
        starts=start_states,
        lateness=lateness,
    )
    if folder is not None:
        try:
            folder.write_rows(result)
        except ConfigurationError:
            # If the run failed, only its error is reported, because both errors may have the same cause.
            if ended_by is None:
                raise
    return result


def simulate_all(
    scenario: CosimScenario,
    policy: str,
    seeds: Sequence[int],
    folder: RunFolder | None,
    *,
    sink: Sink,
    deadline_s: float | None = DEADLINE_S,
    pace: Pace | None = None,
    workers: Workers = ALL_PROCESSORS,
) -> tuple[list[SeedResult], bool]:
    """Run a scenario with each seed; return the results, and True if Ctrl-C interrupted the runs.

    If the runs are not parallel, the last result after an interrupt may be that of the interrupted run. If they are
    parallel, there are no results for seeds whose runs had not finished. The runs are parallel unless a federate
    serves one run at a time, they run in real time, or they have few packets.

    Args:
        scenario: The scenario.
        policy: Name of the sync policy.
        seeds: The seeds.
        folder: The folder for all recordings and rows, or None.
        sink: Receives progress reports.
        deadline_s: Longest wait for an answer of a federate, in seconds of wall time; None for no deadline.
        pace: Pace of runs in real time, which are not parallel; None to run as fast as possible.
        workers: The workers that execute the runs of several seeds.
    """
    if len(seeds) == 1:
        report = partial(progress_reporter(sink, "s"), "simulate", scenario.duration)
        report(0)
        result = simulate(
            scenario,
            policy,
            seeds[0],
            folder,
            progress=lambda now_ns, _: report(round(now_ns / 1e9, 1)),
            deadline_s=deadline_s,
            pace=pace,
        )
        return [result], result.is_interrupted
    report = partial(progress_reporter(sink), "simulate", len(seeds))
    report(0)
    results: dict[int, SeedResult] = {}
    tasks = [Task(policy, seed) for seed in seeds]
    is_interrupted = False
    try:
        # A federate with an address serves one run at a time, and parallel runs in real time would delay each other.
        workers = (
            Workers(1)
            if has_addresses(scenario) or pace is not None
            else workers_for(scenario.packets * len(seeds), workers)
        )
        work = partial(_simulate, scenario, folder, deadline_s, pace)
        for number, result in as_completed_tasks(work, tasks, workers=workers):
            results[number] = result
            report(len(results))
            # With a single worker, `simulate` catches the KeyboardInterrupt, and returns an interrupted result.
            if result.is_interrupted:
                is_interrupted = True
                break
    except KeyboardInterrupt:
        is_interrupted = True
    return [results[number] for number in sorted(results)], is_interrupted


def _simulate(
    scenario: CosimScenario, folder: RunFolder | None, deadline_s: float | None, pace: Pace | None, task: Task
) -> SeedResult:
    return simulate(scenario, task.policy, task.seed, folder, deadline_s=deadline_s, pace=pace)
