"""The section `telemetry` of profiles: the commands of its sources, and rejected sources."""

import pytest

from fieldkit.config import schema
from fieldkit.core.errors import ConfigurationError
from fieldkit.telemetry.telemetry_section import TelemetrySection, TelemetrySource

OID = "1.3.6.1.4.1.9.1.0"


def source(text: str) -> TelemetrySource:
    return schema.validate(schema.parse(text, source="source.yaml"), TelemetrySource)


def test_a_source_has_the_command_of_its_program() -> None:
    snmp = source(f"snmp: {{address: 'fd00::1', version: '3'}}\nvalues: {{signal_dbm: {{oid: {OID}}}}}\n")
    assert snmp.argv()[-2:] == ("udp6:[fd00::1]:161", OID)
    assert snmp.argv("/x/snmp.conf")[:3] == ("env", "SNMPCONFPATH=/x", "snmpget")
    http = source(
        "http: {url: 'http://192.168.8.1:80/api?a[]=1', credentials: {file: /home/r/router}}\n"
        "values: {signal_dbm: {json: rsrp}}\nlimit: 3s\n"
    )
    assert http.poll_words("wlan0")[:4] == ("192.168.8.1", "wlan0", "2", "3")
    assert http.argv()[-4:] == ("--config", "/home/r/router", "--url", "http://192.168.8.1:80/api?a[]=1")
    wired_http = http.model_copy(update={"wired": True})
    assert wired_http.poll_words("eth0")[:2] == ("192.168.8.1", "-")
    assert source("batctl: {}").poll_words("bat0")[:2] == ("-", "bat0")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("at: robot", "exactly one of modemmanager"),
        ("batctl: {}\nmodemmanager: {}", "exactly one of"),
        ("batctl: {}\nvalues: {signal_dbm: {json: a}}", "values of batctl are known"),
        ("command: [x]", "needs values"),
        ("command: []\nvalues: {signal_dbm: {json: a}}", "command"),
        ("command: [x]\nvalues: {signal_dbm: {oid: 1.3.6.1.2}}", "needs json: or regex:"),
        ("command: [x]\nvalues: {signal_dbm: {json: 'a['}}", "not a valid JMESPath"),
        ("command: [x]\nvalues: {signal_dbm: {regex: 'a'}}", "with one group"),
        ("command: [x]\nvalues: {signal_dbm: {json: a, regex: '(a)'}}", "one of json:, regex: and oid:"),
        ("command: [x]\nvalues: {sinal_dbm: {json: a}}", "did you mean 'signal_dbm'"),
        ("command: [x]\nvalues: {signal_dbm: {json: a}}\nwired: true", "wired applies only to snmp and http"),
        ("http: {url: 'http://router/api'}\nvalues: {signal_dbm: {json: a}}", "not an IP address"),
        ("http: {url: 'http://admin:x@10.0.0.1/'}\nvalues: {signal_dbm: {json: a}}", "use credentials"),
        ("http: {url: 'ftp://10.0.0.1/'}\nvalues: {signal_dbm: {json: a}}", "not a URL"),
        ("http: {url: 'http://[::1/'}\nvalues: {signal_dbm: {json: a}}", "not a URL"),
        ("http: {url: 'http://10.0.0.1/'}\nvalues: {signal_dbm: {regex: '(a)'}}", "needs json:"),
        (f"snmp: {{address: ap}}\nvalues: {{signal_dbm: {{oid: {OID}}}}}", "not an IP address"),
        ("snmp: {address: 10.0.0.1}\nvalues: {signal_dbm: {json: a}}", "needs oid:"),
        (
            f"snmp: {{address: 10.0.0.1, credentials: {{file: /x/y}}}}\nvalues: {{signal_dbm: {{oid: {OID}}}}}",
            "must have the name snmp.conf",
        ),
        (
            f"snmp: {{address: 10.0.0.1, credentials: {{environment: A}}}}\nvalues: {{signal_dbm: {{oid: {OID}}}}}",
            "credentials from the environment are possible only with at: laptop",
        ),
        (
            f"snmp: {{address: 10.0.0.1, credentials: {{}}}}\nvalues: {{signal_dbm: {{oid: {OID}}}}}",
            "either file: or environment:",
        ),
        ("batctl: {}\ninterval: 500ms", "interval"),
        ("batctl: {}\nlimit: 1.5s", "limit"),
        ("modemmanager: {modem: '0; reboot'}", "modem"),
    ],
)
def test_wrong_sources_are_rejected(text: str, message: str) -> None:
    with pytest.raises(ConfigurationError, match=message):
        source(text)


def test_the_section_needs_sources_with_short_names() -> None:
    with pytest.raises(ConfigurationError, match="lower-case letters, digits and underscores"):
        schema.validate(schema.parse("sources: {'a/b': {batctl: {}}}", source="s.yaml"), TelemetrySection)
