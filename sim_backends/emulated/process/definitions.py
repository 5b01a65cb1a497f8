"""What ROS message types look like, as publishers announce them; looked up on the lab's side, for all its robots."""

from functools import cache

from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.store import Typestore

from sim_backends.emulated.robot.spec import Definition


@cache
def _store() -> Typestore:
    """Return the types of ROS 1: it takes 50 ms, and a dry run needs none."""
    return get_typestore(Stores.ROS1_NOETIC)


@cache
def definition(kind: str) -> Definition:
    """Return the definition of the ROS 1 message type `package/Name`, one that `messages` has a generator for."""
    package, name = kind.split("/")
    text, md5 = _store().generate_msgdef(f"{package}/msg/{name}", ros_version=1)
    return Definition(text, md5)
