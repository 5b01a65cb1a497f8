"""Section `telemetry` of robot profiles: sources of the state of a radio, in addition to `iw`."""

import ipaddress
from collections.abc import Iterator, Mapping, Sequence
from typing import Annotated, Final
from urllib.parse import urlsplit

from typing_extensions import override

from fieldkit.config import schema
from fieldkit.config.profiles import TELEMETRY, ProfileSection, RobotProfile
from fieldkit.config.schema import AfterValidator, Bool, Duration, Field, Int, Number, Strict, pattern_field
from fieldkit.measure.evidence import program_output

MAX_OUTPUT_BYTES: Final = 1 << 16
"""Maximum size of one output of a source; `MAX_OUTPUT` in telemetry.sh. A longer output has no value."""

# mmcli prints the extended signal since version 1.6, JSON since 1.10, and the neighbouring cells since 1.20.
_MODEM: Final = (
    'mmcli -m "$1" --signal-get -J && mmcli -m "$1" -J && '
    '{ mmcli -m "$1" --get-cell-info -J || mmcli -m "$1" --location-get -J || :; } 2>/dev/null'
)
# batctl prints JSON since version 2021.1. Option -m was replaced by `meshif` in 2019.0, and still works.
_MESH: Final = (
    'batctl meshif "$1" neighbors_json 2>/dev/null || batctl -m "$1" n -n || exit; echo; '
    'batctl meshif "$1" originators_json 2>/dev/null || batctl -m "$1" o -n || :'
)


def _require_path(text: str) -> str:
    if reason := program_output.path_error(text):
        raise schema.validation_error(f"{text!r} is not a valid JMESPath: {reason}")
    return text


def _require_expression(text: str) -> str:
    if reason := program_output.expression_error(text):
        raise schema.validation_error(f"{text!r} is not a regular expression (RE2) with one group: {reason}")
    return text


def _require_address(text: str) -> str:
    try:
        ipaddress.ip_address(text)
    except ValueError:
        raise schema.validation_error(
            f"{text!r} is not an IP address; a name would be resolved over the radio"
        ) from None
    return text


def _require_url(text: str) -> str:
    try:
        parts = urlsplit(text)
        host, has_user = parts.hostname or "", parts.username is not None or parts.password is not None
    except ValueError as error:
        raise schema.validation_error(f"{text!r} is not a URL: {error}") from None
    if parts.scheme not in {"http", "https"} or not host:
        raise schema.validation_error(f"{text!r} is not a URL, such as http://192.168.8.1/api/signal")
    if has_user:
        raise schema.validation_error("a URL with a password would be stored with each trial; use credentials")
    _require_address(host)
    return text


class CredentialsReference(Strict):
    """Reference to credentials, which are read on the computer that runs the query, and are never stored.

    For `http` they are lines of a [curl config](https://curl.se/docs/manpage.html#-K), such as
    `user = "admin:PASSWORD"`. For `snmp` they are lines of an `snmp.conf`, such as `defCommunity NAME`.

    Attributes:
        file: Absolute path of a file with the lines of a curl config (for `http`) or of an `snmp.conf` (for `snmp`,
            the required file name). Only its owner may have permission to read it.
        environment: Environment variable with such lines, instead of a file; on the laptop only.
    """

    file: Annotated[str, pattern_field(r"^/[^\x00-\x1f]{1,200}$", "an absolute path")] | None = None
    environment: (
        Annotated[str, pattern_field(r"^[A-Za-z_][A-Za-z0-9_]{0,60}$", "a name of an environment variable")] | None
    ) = None

    @schema.model_validator(mode="after")
    def _has_one_place(self) -> "CredentialsReference":
        if (self.file is None) == (self.environment is None):
            raise schema.validation_error("credentials need either file: or environment:")
        return self


class ModemManager(Strict):
    """A modem that ModemManager controls, read by `mmcli`. Nothing is sent over the air.

    Attributes:
        modem: `any`, or a number or path from `mmcli -L`.
    """

    modem: Annotated[
        str,
        pattern_field(
            r"^(any|[0-9]{1,3}|/org/freedesktop/ModemManager1/Modem/[0-9]{1,3})$", "any, or a modem of `mmcli -L`"
        ),
    ] = "any"


class Batctl(Strict):
    """A mesh of batman-adv, read by `batctl`. Nothing is sent over the air.

    Attributes:
        interface: Mesh interface.
    """

    interface: Annotated[
        str, pattern_field(r"^[a-z][a-z0-9._-]{0,14}$", "the name of a network interface, such as bat0")
    ] = "bat0"


class Snmp(Strict):
    """A device with an SNMP agent, read by `snmpget` of Net-SNMP.

    Attributes:
        address: Its IP address.
        port: Its UDP port.
        version: `1`, `2c` or `3`.
        credentials: Reference to the community or the user.
    """

    address: Annotated[str, AfterValidator(_require_address)]
    port: Annotated[Int, Field(gt=0, lt=65536)] = 161
    version: Annotated[str, Field(pattern="^(1|2c|3)$")] = "2c"
    credentials: CredentialsReference | None = None

    def argv(self, oids: Sequence[str], credentials_file: str | None) -> tuple[str, ...]:
        """Return the command that prints a line `OID VALUE` per object."""
        folder = credentials_file.rpartition("/")[0] if credentials_file else ""
        agent = f"udp6:[{self.address}]:{self.port}" if ":" in self.address else f"udp:{self.address}:{self.port}"
        environment = ("env", f"SNMPCONFPATH={folder or '/'}") if credentials_file else ()
        # Without MIBs, with numeric OIDs and enumerations, and without the types of values.
        options = ("-v", self.version, "-m", "", "-t", "1", "-r", "0", "-OnqUe")
        return (*environment, "snmpget", *options, agent, *oids)


class Http(Strict):
    """A device that answers HTTP requests (GET) with JSON, read by `curl`.

    Attributes:
        url: URL whose host is an IP address.
        credentials: Reference to a header or a user for the request.
    """

    url: Annotated[str, AfterValidator(_require_url)]
    credentials: CredentialsReference | None = None

    @property
    def address(self) -> str:
        """IP address of the device."""
        return urlsplit(self.url).hostname or ""

    def argv(self, limit_s: int, credentials_file: str | None) -> tuple[str, ...]:
        """Return the command that prints the answer."""
        config = ("--config", credentials_file) if credentials_file else ()
        limits = ("--max-time", str(limit_s), "--max-filesize", str(MAX_OUTPUT_BYTES))
        options = ("-q", "--silent", "--fail", "--globoff", "--noproxy", "*", "--proto", "=http,https")
        return ("curl", *options, *limits, *config, "--url", self.url)


class Extraction(Strict):
    """Location of a value in the output of a source.

    Attributes:
        path: Location in JSON output, such as `lte.rsrp`: a [JMESPath](https://jmespath.org).
        expression: Instead of `json`, a regular expression ([RE2](https://github.com/google/re2/wiki/Syntax)) with
            one group.
        oid: For `snmp`, the numeric OID of the object.
        factor: Factor that converts the number in the output to the unit of the value: 1000000 from Mbit/s to bit/s.
    """

    path: Annotated[str, AfterValidator(_require_path)] | None = Field(default=None, alias="json")
    expression: Annotated[str, AfterValidator(_require_expression)] | None = Field(default=None, alias="regex")
    oid: Annotated[str, pattern_field(r"^\.?[0-9]+(\.[0-9]+){3,40}$", "a numeric OID")] | None = None
    factor: Number | Int = 1

    @schema.model_validator(mode="after")
    def _has_one_location(self) -> "Extraction":
        if sum(location is not None for location in (self.path, self.expression, self.oid)) != 1:
            raise schema.validation_error("a value needs one of json:, regex: and oid:")
        return self


class Values(Strict):
    """Location of each value that the source gives.

    Attributes:
        signal_dbm: Received signal; RSRP of a cellular modem.
        sinr_db: Signal to interference and noise ratio.
        noise_dbm: Noise in the channel.
        band: Band or channel, as text.
        cell: Cell or access point, as text.
        tx_rate_bit_s: PHY rate of transmission, in bit/s.
        rx_rate_bit_s: PHY rate of reception, in bit/s.
        neighbours: Number of other cells, stations or mesh nodes in reach.
    """

    signal_dbm: Extraction | None = None
    sinr_db: Extraction | None = None
    noise_dbm: Extraction | None = None
    band: Extraction | None = None
    cell: Extraction | None = None
    tx_rate_bit_s: Extraction | None = None
    rx_rate_bit_s: Extraction | None = None
    neighbours: Extraction | None = None

    def items(self) -> Iterator[tuple[str, Extraction]]:
        """Yield the name and the location of each value."""
        for name in QUANTITIES:
            location: Extraction | None = getattr(self, name)
            if location is not None:
                yield name, location


QUANTITIES: Final = tuple(Values.model_fields)
_QUANTITIES_BY_KIND: Final[Mapping[str, tuple[str, ...]]] = {
    "modemmanager": ("signal_dbm", "sinr_db", "band", "cell", "neighbours"),
    "batctl": ("neighbours",),
}
"""Values of the kinds whose output has a known format."""
KINDS: Final = ("modemmanager", "batctl", "snmp", "http", "command")
"""Kinds of sources; each is a key of a source."""

_WholeSeconds = Annotated[Duration, Field(ge=1, le=60, multiple_of=1)]


class TelemetrySource(Strict):
    """One source, which has exactly one of `modemmanager`, `batctl`, `snmp`, `http` and `command`.

    Attributes:
        at: Computer that runs the query: `robot`, or `laptop` for a device in the control network.
        modemmanager: A modem of ModemManager.
        batctl: A mesh of batman-adv.
        snmp: A device with SNMP.
        http: A device with HTTP and JSON.
        command: Words of a command that prints the state of the radio. It must send nothing over the radio.
        values: Location of each value in the output of `snmp`, `http` or `command`.
        interval: Time between two queries, in whole seconds.
        limit: Time limit of a query, in whole seconds. A query that takes longer is killed and has no value.
        wired: True if `snmp` or `http` reaches the radio itself over a cable on the interface under test. If false, a
            source whose address is reached over this interface is not queried.
    """

    at: Annotated[str, Field(pattern="^(robot|laptop)$")] = "robot"
    modemmanager: ModemManager | None = None
    batctl: Batctl | None = None
    snmp: Snmp | None = None
    http: Http | None = None
    command: Annotated[tuple[Annotated[str, Field(pattern=r"^[^\x00]*$")], ...], Field(min_length=1)] | None = None
    values: Values | None = None
    interval: _WholeSeconds = 2.0
    limit: _WholeSeconds = 2.0
    wired: Bool = False

    @schema.model_validator(mode="after")
    def _is_consistent(self) -> "TelemetrySource":
        if sum(getattr(self, kind) is not None for kind in KINDS) != 1:
            raise schema.validation_error(f"a source needs exactly one of {', '.join(KINDS)}")
        if self.kind in _QUANTITIES_BY_KIND:
            if self.values is not None:
                raise schema.validation_error(f"the values of {self.kind} are known; omit values", "values")
        elif self.values is None or not list(self.values.items()):
            raise schema.validation_error(f"{self.kind} needs values: the location of each value")
        else:
            self._require_locations(self.values)
        if self.wired and self.address is None:
            raise schema.validation_error("wired applies only to snmp and http, which have an address", "wired")
        credentials = self.credentials
        if credentials is not None and credentials.environment and self.at == "robot":
            raise schema.validation_error(
                "credentials from the environment are possible only with at: laptop; use file", self.kind
            )
        is_snmp_conf = credentials is None or credentials.file is None or credentials.file.endswith("/snmp.conf")
        if self.snmp is not None and not is_snmp_conf:
            raise schema.validation_error("the file with credentials of snmp must have the name snmp.conf", "snmp")
        return self

    def _require_locations(self, values: Values) -> None:
        for name, location in values.items():
            if (location.oid is not None) != (self.snmp is not None):
                needed = "oid:" if self.snmp is not None else "json: or regex:"
                raise schema.validation_error(f"a value of {self.kind} needs {needed}", "values", name)
            if self.http is not None and location.path is None:
                raise schema.validation_error("a value of http needs json:", "values", name)

    @property
    def kind(self) -> str:
        """One of `KINDS`."""
        return next(kind for kind in KINDS if getattr(self, kind) is not None)

    @property
    def quantities(self) -> tuple[str, ...]:
        """Names of the values that it gives."""
        return _QUANTITIES_BY_KIND.get(self.kind) or tuple(name for name, _ in (self.values or Values()).items())

    def absent_quantities(self, readings: Sequence[Mapping[str, float | str]]) -> tuple[str, ...]:
        """Return the quantities whose location is in the profile, but which are missing from all readings.

        Args:
            readings: Values of each reading, by quantity.
        """
        located_quantities = self.quantities if self.values is not None else ()
        return tuple(name for name in located_quantities if not any(name in values for values in readings))

    @property
    def address(self) -> str | None:
        """IP address to which its queries are sent; None unless its kind is `snmp` or `http`."""
        device = self.snmp or self.http
        return device.address if device is not None else None

    @property
    def credentials(self) -> CredentialsReference | None:
        """Its credentials, if it needs any."""
        device = self.snmp or self.http
        return device.credentials if device is not None else None

    @property
    def program(self) -> str:
        """Name of the program that it needs."""
        programs = {"modemmanager": "mmcli", "batctl": "batctl", "snmp": "snmpget", "http": "curl"}
        return programs.get(self.kind) or (self.command or ("",))[0]

    def argv(self, credentials_file: str | None = None) -> tuple[str, ...]:
        """Return the command of one query.

        Args:
            credentials_file: File with the credentials; None for the file of the profile, if any.
        """
        file = credentials_file or (self.credentials.file if self.credentials else None)
        if self.snmp is not None:
            oids = (location.oid or "" for _, location in (self.values or Values()).items())
            return self.snmp.argv(tuple(dict.fromkeys(oids)), file)
        if self.http is not None:
            return self.http.argv(round(self.limit), file)
        if self.modemmanager is not None:
            return ("sh", "-c", _MODEM, "sh", self.modemmanager.modem)
        if self.batctl is not None:
            return ("sh", "-c", _MESH, "sh", self.batctl.interface)
        return self.command or ()

    def poll_words(self, radio: str, credentials_file: str | None = None) -> tuple[str, ...]:
        """Return the words `ADDRESS INTERFACE INTERVAL LIMIT ARGV...` of `poll` in telemetry.sh.

        Args:
            radio: The interface under test, over which nothing may be sent; `-` if the laptop runs the query.
            credentials_file: File with the credentials of the command; see `argv`.
        """
        tested_interface = "-" if self.wired else radio
        times = (f"{self.interval:.0f}", f"{self.limit:.0f}")
        return (self.address or "-", tested_interface, *times, *self.argv(credentials_file))


SourceName = Annotated[
    str, pattern_field(r"^[a-z][a-z0-9_]{0,19}$", "up to 20 lower-case letters, digits and underscores")
]


class TelemetrySection(ProfileSection):
    """[Sources](telemetry.md) of the state of the robot's radio, in addition to `iw`.

    A source that fails has no value. If several sources declare a value, only the first of them is used.

    Attributes:
        sources: The sources by name.
    """

    sources: dict[SourceName, TelemetrySource]

    @override
    def contradiction(self, profile: RobotProfile) -> str | None:
        return None if self.sources else "telemetry without sources; omit it"

    def at(self, computer: str) -> dict[str, TelemetrySource]:
        """Return the sources that are queried by this computer, `robot` or `laptop`."""
        return {name: source for name, source in self.sources.items() if source.at == computer}


def telemetry_of(profile: RobotProfile) -> TelemetrySection | None:
    """Return the section `telemetry` of a profile, or None if it has no such section."""
    return profile.section(TELEMETRY, TelemetrySection)
