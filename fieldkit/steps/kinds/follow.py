"""Follow robots while steps run: record what tells where they are, ask for their clocks, and keep who told it."""

import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from typing import Final

from fieldkit.backends.protocols import Testbed
from fieldkit.core.columns import Measured, columns
from fieldkit.core.errors import EvidenceError, FieldkitError
from fieldkit.core.model import Role
from fieldkit.core.threads import together
from fieldkit.measure.offsets import Exchange, Offset, offset
from fieldkit.measure.positions import accounts, where
from fieldkit.measure.positions.accounts import Account, Accounts
from fieldkit.measure.positions.samples import PLACED
from fieldkit.remote import jobs
from fieldkit.steps import clocks
from fieldkit.steps.base import Step
from fieldkit.steps.kinds.move import MoveStep
from fieldkit.steps.nest import Nest
from fieldkit.steps.scene import Announce, Planned, Scene
from fieldkit.steps.view import View

LIMIT_S: Final = 900.0
"""For how long a recording may outlast the limits of the steps inside."""
CLOSE_S: Final = 10.0
ASK_S: Final = 15.0
_ROUNDING_M: Final = 1e-3

COLUMNS: Final = columns(
    100,
    ("positions_from", "text", "Who tells where robots were: a topic, a message, a file, a place."),
    ("positions_clock_error_s", "s", "The most that times of two robots can be wrong against each other."),
)
"""In trials that have a step which tells it."""

Tell = Callable[[int, Mapping[Role, Offset]], Accounts]
"""Given when the steps inside began, nanoseconds since 1970 UTC by the laptop's clock, and how far robots' clocks
were ahead of that one."""


def follow(
    nest: Nest,
    scene: Scene,
    testbed: Testbed,
    announce: Announce,
    recordings: Sequence[Planned],
    *,
    tell: Tell | None,
    outlast: Callable[[Planned], int],
) -> Sequence[tuple[Planned, int]]:
    """Run the steps inside one while recordings run; return those, each with its exit code.

    Args:
        nest: The step.
        scene: The attempt.
        testbed: The robots.
        announce: As for `Step.run`.
        recordings: What records until it is stopped.
        tell: Makes who told where robots were; None where nobody did.
        outlast: Whole seconds for which a recording goes on behind the last step: where the robot was at its end is
            told between two messages.

    Raises:
        FieldkitError: A step inside failed, or a robot did not answer.
    """
    asked: dict[Role, list[Exchange]] = {role: [] for role in nest.roles()} if tell else {}

    def ask(role: Role) -> None:
        asked[role] += clocks.exchanges(testbed.shells[role], ASK_S)

    def wait(recording: Planned) -> None:
        seconds = outlast(recording)
        jobs.begin_wait(testbed.shells[recording.role], recording.job, seconds).end(seconds + jobs.REPLY_S)

    try:
        together(lambda planned: jobs.start(testbed.shells[planned.role], planned.job), recordings)
        together(ask, list(asked))
        began_utc_ns = time.time_ns()
        for entry in nest.during:
            entry.step.run(scene, testbed, announce)
        together(ask, list(asked))
        together(wait, recordings)
    except FieldkitError:
        # What was recorded is kept with the attempt that failed, whose reason is what failed first.
        with suppress(FieldkitError):
            _stop(testbed, recordings)
        raise
    codes = _stop(testbed, recordings)
    if scene.here is not None and tell is not None:
        offsets = {role: offset(found) for role, found in asked.items() if found}
        path = scene.here / accounts.FILE
        # Steps inside may have told of other robots.
        before = accounts.read(path) if path.exists() else Accounts()
        path.write_text(accounts.text(accounts.merged(before, tell(began_utc_ns, offsets))), encoding="utf-8")
    return list(zip(recordings, codes, strict=True))


def _stop(testbed: Testbed, recordings: Sequence[Planned]) -> Sequence[int]:
    def stop(recording: Planned) -> int:
        return jobs.stop(testbed.shells[recording.role], recording.job, grace_s=CLOSE_S)

    return together(stop, recordings)


def standing(nest: Nest, scene: Scene) -> Mapping[Role, Account]:
    """Return who stands where it was placed while the steps inside run."""
    moved = {step.robot for step in steps_inside(nest) if isinstance(step, MoveStep)}
    standing_m = {role: place_m for role, place_m in scene.places_m.items() if role not in moved}
    return {role: Account(place=standing_m[role]) for role in nest.roles() if role in standing_m}


def steps_inside(nest: Nest) -> Iterator[Step]:
    """Yield the steps inside one, at any depth."""
    for entry in nest.during:
        yield entry.step
        if isinstance(entry.step, Nest):
            yield from steps_inside(entry.step)


def placement_error(what: str, within: Sequence[Nest]) -> str | None:
    """Return why a step cannot tell where robots were inside others; None where it can."""
    if any(isinstance(nest, MoveStep) for nest in within):
        return f"a {what} begins where robots were placed: put the move into the {what}"
    if any(nest.disturbs or nest.parallel for nest in within):
        return f"a {what} stands in no fault and in no together: put them into the {what}"
    return None


def problems(view: View, roles: Sequence[Role]) -> Iterator[str]:
    """Yield why it is not known where robots were, though it was recorded."""
    try:
        told = where.given(view.evidence)
        for role in roles:
            where.samples_of(view.evidence, role)
    except EvidenceError as error:
        yield error.what
        return
    if not told.robots:
        yield f"{accounts.FILE} is missing"
    yield from _of_places(view, told)


def _of_places(view: View, told: Accounts) -> Iterator[str]:
    """Yield which robots are said to have stood, or begun, elsewhere than where the plan placed them."""
    for role, account in told.robots.items():
        planned_m = view.scene.places_m.get(role)
        said_m = account.place if account.place is not None else account.start
        if planned_m is None or account.frame != PLACED or account.offset_s or not (account.place or account.topic):
            continue
        off_m = math.dist(planned_m, [metres or 0.0 for metres in said_m])
        if off_m > _ROUNDING_M:
            yield f"{accounts.FILE} has the {role} {off_m:.1f} m from where it was placed"


def measure(view: View) -> Measured:
    """Return the columns that say who told where robots were."""
    values = {
        "positions_from": where.in_words(view.evidence),
        "positions_clock_error_s": where.clock_error_s(view.evidence),
    }
    return Measured.of(values, f"{accounts.FILE} does not say")
