"""Casts with robots that steps can move."""

from fieldkit.backends.protocols import Cast


def driving_cast(cast: Cast) -> Cast:
    """Return a cast in which steps can drive the robots that have a `drive` section in their profile."""
    return {
        role: robot.model_copy(update={"abilities": frozenset(robot.profile.sections) & {"drive"}})
        for role, robot in cast.items()
    }
