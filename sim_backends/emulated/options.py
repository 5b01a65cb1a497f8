"""The `emulated:` section of a site file."""

from enum import StrEnum

from fieldkit import config
from fieldkit.config import Document, Strict
from sim_backends.radio.options import RadioOptions


class RosChoice(StrEnum):
    """Where a robot's ROS comes from."""

    AUTO = "auto"
    DEBIAN = "debian"
    BUILTIN = "builtin"


class EmulatedOptions(Strict):
    """Options of the emulated backend.

    Attributes:
        ros: `debian`, ROS's own master and rosbag from Debian's packages; `builtin`, fieldkit's own sensors and
            `rosbag` command; `auto`, Debian's where they are installed.
        radio: The radio between the robots.
    """

    ros: RosChoice = RosChoice.AUTO
    radio: RadioOptions = RadioOptions()


def load_options(document: Document | None) -> EmulatedOptions:
    """Return the options in a site file's document; the defaults without one.

    Raises:
        ConfigurationError: The section is wrong; the message has file and line.
    """
    if document is None or not document.data.get("emulated"):
        return EmulatedOptions()
    return config.validate(document.part("emulated"), EmulatedOptions)
