"""Robots that steps move by the sections of their profiles."""

from fieldkit.backends.protocols import Cast


def driving_cast(cast: Cast) -> Cast:
    """Return a cast whose ground robots are driven by steps."""
    return {
        role: robot.model_copy(update={"abilities": frozenset(robot.profile.sections) & {"drive"}})
        for role, robot in cast.items()
    }
