"""The section `on_abort` of a procedure: the action of each drone if a repeat is aborted."""

from collections.abc import Iterator
from contextlib import AbstractContextManager
from enum import StrEnum
from typing import Final

from typing_extensions import override

from fieldkit.config.schema import ConfigDict, RootModel
from fieldkit.core.model import Role
from fieldkit.motion.profile_sections import mavlink_of
from fieldkit.steps.scene import Refusal, Scene, Shells
from fieldkit.trial.procedure_section import ProcedureSection, TrialOutline

ON_ABORT: Final = "on_abort"


class OnAbort(StrEnum):
    """Action of a drone whose trial is aborted: land at its position, or return to its take-off position and land."""

    LAND = "land"
    RETURN = "return"


class AbortActions(ProcedureSection, RootModel[dict[Role, OnAbort]]):
    """Action of each drone when a repeat is aborted, by role: `land` at its current position, or `return`.

    See [MAVLink](mavlink.md#when-a-trial-is-aborted).
    """

    model_config = ConfigDict(frozen=True, hide_input_in_errors=True, defer_build=True)

    @override
    def roles(self) -> frozenset[Role]:
        return frozenset(self.root)

    @override
    def refusals(self, plan: TrialOutline) -> Iterator[Refusal]:
        """Yield a refusal for each robot that cannot be landed, because its profile has no `mavlink`."""
        for role in self.root:
            if mavlink_of(plan.cast[role].profile) is None:
                reason = "on_abort must bring it down, but its profile has no mavlink"
                yield Refusal(role, reason, f"remove {role} from on_abort, or use a drone")

    @override
    def dry_run_notes(self, plan: TrialOutline) -> Iterator[str]:
        for role, action in self.root.items():
            yield f"if a repeat is aborted: {plan.cast[role].name} is commanded to {action}"

    @override
    def abort_notes(self, plan: TrialOutline) -> Iterator[str]:
        for role in self.guarded_roles(plan):
            yield f"{plan.cast[role].name} is commanded to {self.root[role]}"

    @override
    def around_steps(self, plan: TrialOutline, scene: Scene, shells: Shells) -> AbstractContextManager[None]:
        from fieldkit.motion.running.guards import guard_drones  # noqa: PLC0415 (it imports the code that flies drones)

        actions = {role: self.root[role].value for role in self.guarded_roles(plan)}
        return guard_drones(actions, plan, scene, shells)

    def guarded_roles(self, plan: TrialOutline) -> tuple[Role, ...]:
        """Return the roles of drones that no step flies; each of them is monitored by a guard."""
        moved = plan.procedure.moved_roles()
        return tuple(role for role in self.root if role not in moved)


def abort_of(scene: Scene, role: Role) -> OnAbort:
    """Return the action of a drone if the attempt is aborted; without an entry in `on_abort` it lands."""
    actions = scene.sections.get(ON_ABORT)
    return actions.root.get(role, OnAbort.LAND) if isinstance(actions, AbortActions) else OnAbort.LAND
