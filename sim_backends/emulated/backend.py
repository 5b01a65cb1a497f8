"""The emulated backend: the robots of a site file, or the robots of the paper, in namespaces on this machine."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Final

from fieldkit.backends.protocols import CLOCK, INSTRUCTIONS, Cast, Robot, Testbed
from fieldkit.backends.registry import cast_of, profiles_of
from fieldkit.config.schema import Document
from fieldkit.config.site import Site, load_site
from fieldkit.core.errors import ConfigurationError, FieldkitError
from fieldkit.core.events import Note, PhaseStarted, Sink
from fieldkit.core.model import Control, Topology
from fieldkit.core.prompts import Operator
from fieldkit.remote.shell import Shell
from sim_backends.emulated import lab_checks
from sim_backends.emulated.emulated_options import RosChoice, load_options
from sim_backends.emulated.medium.air_files import LIMIT_BYTES
from sim_backends.emulated.motion_sections import DRIVE, MAVLINK, drive_of, mavlink_of
from sim_backends.emulated.provisioning import (
    LAPTOP_ADDRESS,
    NETWORK,
    RobotKey,
    drives_by_topic,
    link_addresses,
    profile_in_lab,
)
from sim_backends.world.world import load_world

if TYPE_CHECKING:
    from fieldkit.lab.protocol import Lab, Overview  # not needed for a trial
    from fieldkit.lab.robots import LabRobot

DEFAULT_SITE: Final = Path(__file__).with_name("default.yaml")

# Measured on 2 cores: time from the start of three robots until they publish topics.
_START_S: Final = {RosChoice.BUILTIN: 0.5, RosChoice.DEBIAN: 1.0}


class EmulatedBackend:
    """Backend that runs each robot in namespaces of this machine.

    Args:
        site: The site file; None for the paper's lab. A site file without robots has the robots of the paper's lab.
        document: The document of the site file, for error messages with line numbers; None without a site file.

    Raises:
        ConfigurationError: The `emulated:` section is wrong or names a robot that the lab does not have, the lab has
            more robots than addresses, or, with `control: radio`, a robot has the name of the laptop or the lab has
            `wifi: linux`.
    """

    by_hand: Final = False
    """No person sets up the robots or carries them to their places."""
    permissions: frozenset[str] = frozenset()
    """No permission is needed, because emulated robots endanger no person."""

    def __init__(self, site: Site | None, document: Document | None) -> None:
        if site is None:
            site, document = load_site(DEFAULT_SITE)
        elif site.has_default_robots:
            default_site, _ = load_site(DEFAULT_SITE)
            site = site.model_copy(update={"robots": default_site.robots, "roles": default_site.roles})
        self._site = site
        self._document = document
        self._options = load_options(document)
        with document.locating_errors("emulated", "world") if document else nullcontext():
            self._world = load_world(self._options.world)
        hosts = [str(host) for host in NETWORK.hosts() if host != LAPTOP_ADDRESS]
        lab_checks.check_site(site, document, self._options, len(hosts))
        self._addresses = dict(zip(site.robots, hosts, strict=False))

    @property
    def simulators(self) -> Mapping[str, str]:
        """Implement `Simulating.simulators`: Linux Wi-Fi, or the simulators of a co-simulation; otherwise empty."""
        if self._options.has_linux_wifi:
            from sim_backends.emulated.linux_wifi import virtual_machine  # noqa: PLC0415 (only some labs use it)

            clock = {CLOCK: INSTRUCTIONS} if virtual_machine.clock_counts_instructions() else {}
            return {"wifi": "linux", **clock}
        if not self._options.is_cosimulated:
            return {}
        from sim_backends.emulated import simulator_choice  # noqa: PLC0415 (other labs import no simulator)

        return simulator_choice.summary(self._options)

    @property
    def must_relocate(self) -> bool:
        """Implement `Relocating.must_relocate`: Linux Wi-Fi needs hwsim radios in this kernel."""
        if not self._options.has_linux_wifi:
            return False
        from sim_backends.emulated.linux_wifi import radios  # noqa: PLC0415 (only some labs use it)

        return not radios.can_use_radios()

    def run_elsewhere(self, argv: Sequence[str], results: Path) -> int:
        """Implement `Relocating.run_elsewhere`: the command runs in a virtual machine."""
        from sim_backends.emulated.linux_wifi import guest  # noqa: PLC0415 (as above)

        return guest.run_command(argv, results, radios=self._radio_count, mesh=self._options.mesh)

    @property
    def _radio_count(self) -> int:
        """Number of radios of robots and access points."""
        return len(self._site.robots) + len(self._options.radio.access_points)

    def use_wifi(self, kind: str) -> None:
        """Implement `ChoosesWifi.use_wifi`: replace the option `wifi` of the site file."""
        self._options = self._options.with_wifi(kind)

    def _site_of_guest(self) -> dict[str, object]:
        """Return the content of the site file for this lab in a virtual machine."""
        content = dict(self._document.data) if self._document is not None else {}
        emulated = content.get("emulated") or {}
        assert isinstance(emulated, dict)
        site = self._site.model_dump(mode="json", exclude_defaults=True)
        return {"roles": {}} | site | {"backend": "emulated", "emulated": emulated | {"wifi": self._options.wifi}}

    @property
    def lab_bytes(self) -> int:
        """Implement `Backend.lab_bytes`: the size limit of the record of transmission attempts.

        The result is 0 if the site file requests no record, or fixes the links, which have no attempts.
        """
        if not self._options.record_air or self._options.radio.is_fixed:
            return 0
        return LIMIT_BYTES

    def cast(self, topology: Topology) -> Cast:
        """Implement `Backend.cast`; robots get addresses in their order in the site file."""
        cast = cast_of(self._site, self._document, topology, self._addresses, self._link_addresses(topology))
        names = (robot.name for robot in cast.values())
        self._check_robots(cast, names, has_relay=topology is Topology.MASTER)
        return {
            role: robot.model_copy(
                update={
                    "abilities": self._abilities(robot, cast),
                    "profile": profile_in_lab(robot.profile, self._options),
                }
            )
            for role, robot in cast.items()
        }

    def _link_addresses(self, topology: Topology) -> dict[str, dict[str, str]]:
        """Return each robot's addresses on its links other than the radio, for the robots of a topology."""
        profiles = profiles_of(self._site, self._document, self._site.roles.get(topology, {}).values())
        return {
            name: link_addresses(profile, self._addresses[name], self._options)
            for name, profile in profiles.items()
            if profile.further_links
        }

    def _abilities(self, robot: Robot, cast: Cast) -> frozenset[str]:
        """Return the names of the profile sections with which steps of a trial may move the robot.

        If other robots of the cast would also receive its commanded velocities, the section `drive` is omitted, and
        the lab moves the robot itself.
        """
        drive = drive_of(robot.profile)
        is_driven = (
            drive is not None
            and drives_by_topic(robot.profile, self._options)
            and drive.topic_conflict(robot, cast.values()) is None
        )
        has_autopilot = mavlink_of(robot.profile) is not None
        return frozenset({DRIVE} if is_driven else ()) | frozenset({MAVLINK} if has_autopilot else ())

    @contextmanager
    def open(
        self,
        cast: Cast,
        *,
        seed: int,
        sink: Sink,
        operator: Operator,
    ) -> Iterator[Testbed]:
        """Implement `Backend.open` after a check that this machine has the programs of the robots."""
        # A dry run needs only `cast`, and imports neither SSH nor keys.
        from sim_backends.emulated import requirements, testbed  # noqa: PLC0415

        ros = self._find_ros(robot.name for robot in cast.values())
        lab_checks.check_bridges(cast, ros)
        if any(robot.ros_master for robot in cast.values()):
            requirements.check_shared_master(ros)
        self._note_simulators(sink)
        sink(PhaseStarted("start robots", expected_s=_START_S[ros]))
        with testbed.bring_up(
            cast,
            options=self._options,
            world=self._world,
            ros=ros,
            seed=seed,
            control=self._site.control,
            reconnect_timeout_s=self._site.patience,
            on_notice=lambda text: sink(Note(text)),
            operator=operator,
        ) as opened_testbed:
            yield opened_testbed

    def persistent_shells(self, *, sink: Sink) -> AbstractContextManager[Mapping[str, Shell | FieldkitError]]:  # noqa: ARG002 (none)
        """Implement `Backend.persistent_shells`: emulated robots stop with their lab, so there are none."""
        return nullcontext({})

    @contextmanager
    def open_lab(self, *, seed: int, sink: Sink) -> "Iterator[Lab]":
        """Implement `LabBackend.open_lab`: in this process, or for Linux Wi-Fi in a virtual machine if necessary."""
        from sim_backends.emulated import interactive_lab  # noqa: PLC0415 (as in `open`)

        if self._site.control is Control.RADIO:
            sink(Note("control: radio applies to trials; in a lab SSH bypasses the radio and reaches every robot"))
        members = self._members()
        if self.must_relocate:
            from sim_backends.emulated.linux_wifi import guest_lab  # noqa: PLC0415 (only some labs use it)

            sink(Note("starting a virtual machine, because mac80211_hwsim cannot be used here"))
            draw = partial(interactive_lab.overview, members, options=self._options, world=self._world)
            site, mesh = self._site_of_guest(), self._options.mesh
            with guest_lab.bring_up(members, site, seed=seed, radios=self._radio_count, draw=draw, mesh=mesh) as lab:
                yield lab
            return
        ros = self._find_ros(members)
        lab_checks.check_bridges(members, ros)
        self._note_simulators(sink)
        sink(PhaseStarted("start robots"))
        with interactive_lab.bring_up(members, options=self._options, world=self._world, ros=ros, seed=seed) as lab:
            yield lab

    def overview(self) -> "Overview":
        """Implement `LabBackend.overview`, without shadowing, which depends on the seed."""
        from sim_backends.emulated import interactive_lab, interactive_placement  # noqa: PLC0415 (as in `open`)

        members = self._members()
        positions_m = interactive_placement.square_m(members, self._world)
        return interactive_lab.overview(members, positions_m, self._options, self._world)

    def gazebo_world(self, version: str) -> str:
        """Implement `GazeboWorlds.gazebo_world`; the robots are at their positions in an interactive lab."""
        from sim_backends.emulated import interactive_placement, simulator_choice  # noqa: PLC0415 (as in `open`)
        from sim_backends.gazebo.sdf import SdfRobot, world_sdf  # noqa: PLC0415 (as above)

        members = self._members()
        places_m = interactive_placement.square_m(members, self._world)
        robots = {
            name: SdfRobot(body.limits, interactive_placement.below_antenna_m(places_m[name]), 0.0)
            for name, body in simulator_choice.bodies_of(members.values()).items()
        }
        step_ns = simulator_choice.sync_of(self._options).step_ns
        return world_sdf(
            self._world, robots, step_ns=step_ns, version="garden" if version == "garden" else "fortress"
        )

    def _members(self) -> "dict[str, LabRobot]":
        from sim_backends.emulated import interactive_lab  # noqa: PLC0415 (as in `open`)

        if not self._site.robots:
            raise ConfigurationError(
                "a lab has at least one robot, and this site file has none",
                where=self._document.where(("robots",)) if self._document else "",
                remedy="fieldkit lab up --robots 2",
            )
        members = interactive_lab.members_of(self._site, self._document, self._addresses)
        self._check_robots(members, members, has_relay=False)
        return {
            name: replace(robot, profile=profile_in_lab(robot.profile, self._options))
            for name, robot in members.items()
        }

    def _check_robots(
        self, robots: "Mapping[RobotKey, Robot | LabRobot]", names: Iterable[str], *, has_relay: bool
    ) -> None:
        """Raise ConfigurationError if the lab does not support the profiles, or the names of the robots."""
        lab_checks.check_profiles(robots, self._options)
        lab_checks.check_infrastructure(names, self._options, self._document, has_relay=has_relay)

    def _note_simulators(self, sink: Sink) -> None:
        if self.simulators:
            subject = "the robots have:" if self._options.has_linux_wifi else "the robots run on the co-simulation:"
            texts = (f"{purpose} {simulator}" for purpose, simulator in self.simulators.items())
            sink(Note(f"{subject} {', '.join(texts)}"))

    def _find_ros(self, names: Iterable[str]) -> RosChoice:
        """Check that this machine has the programs that these robots need, and return the source of their ROS."""
        from sim_backends.emulated import requirements  # noqa: PLC0415 (as in `open`)

        has_linux_wifi, variants = self._options.has_linux_wifi, self._options.robots
        robot_variants = (variants[name] for name in names if name in variants)
        mesh = set() if self._options.mesh is None else {self._options.mesh.program}
        wifi = {"hostapd", "iw", "nft", "wpa_supplicant"} if has_linux_wifi else set()
        programs = {program for options in robot_variants for program in options.programs()}
        requirements.check(programs | mesh | wifi, needs_tun=not has_linux_wifi)
        if self._options.has_batman:
            requirements.check_batman()
        return requirements.ros_in_use(self._options.ros)
