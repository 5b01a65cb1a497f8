"""The Zenoh adapter: attachments compared with the serializer of Zenoh, and the configuration of the library."""

import json

import pytest
import zenoh
import zenoh.ext
from hypothesis import given
from hypothesis import strategies as st

from fieldkit.agent.messaging import zenoh as adapter
from fieldkit.agent.messaging.middleware import Network
from fieldkit.ros.middlewares import tuning

int64_values = st.integers(-(2**63), 2**63 - 1)


@given(int64_values, int64_values, st.binary(min_size=16, max_size=16))
def test_attachments_equal_those_of_the_zenoh_serializer(sequence: int, at_ns: int, gid: bytes) -> None:
    """`zenoh::ext::Serializer` with the three values that rmw_zenoh uses."""
    fields = (zenoh.ext.Int64(sequence), zenoh.ext.Int64(at_ns), gid)
    assert adapter.ATTACHMENT.pack(sequence, at_ns, len(gid), gid) == zenoh.ext.z_serialize(fields).to_bytes()


def test_publishers_have_different_identifiers() -> None:
    assert len(adapter.gid("a")) == adapter.GID_BYTES
    assert adapter.gid("a") != adapter.gid("b")


def test_peer_uses_scouting_only() -> None:
    configuration = adapter.configuration(Network("10.0.0.1"), "peer")
    assert configuration["scouting/multicast/enabled"] is True
    assert configuration["listen/endpoints"] == ["tcp/10.0.0.1:7447"]
    assert configuration["connect/endpoints"] == []


def test_peers_are_contacted_by_address() -> None:
    network = Network("10.0.0.1", discovery="peers", peers=("10.0.0.2",), transport="udp")
    configuration = adapter.configuration(network, "peer")
    assert configuration["scouting/multicast/enabled"] is False
    assert configuration["connect/endpoints"] == ["udp/10.0.0.2:7447"]


def test_client_contacts_its_router_only() -> None:
    configuration = adapter.configuration(
        Network("10.0.0.1", discovery="router", server="10.0.0.9", port=7555), "client"
    )
    assert configuration["connect/endpoints"] == ["tcp/10.0.0.9:7555"]
    assert "listen/endpoints" not in configuration


def test_router_contacts_no_peers() -> None:
    configuration = adapter.configuration(Network("10.0.0.9", discovery="router", server="10.0.0.9"), "router")
    assert configuration["listen/endpoints"] == ["tcp/10.0.0.9:7447"]
    assert "connect/endpoints" not in configuration


def test_settings_are_json_values_or_strings() -> None:
    network = Network("10.0.0.1", settings={"transport/link/tx/batch_size": "1400", "mode": "client"})
    configuration = adapter.configuration(network, "peer")
    assert (configuration["transport/link/tx/batch_size"], configuration["mode"]) == (1400, "client")


@pytest.mark.parametrize("transport", ["tcp", "udp"])
def test_library_accepts_the_recommended_settings(transport: str) -> None:
    """The library rejects unknown paths and values."""
    recommended_settings = tuning.recommended_settings("zenoh", transport)
    configuration = adapter.configuration(
        Network("10.0.0.1", transport=transport, settings=recommended_settings), "peer"
    )
    config = zenoh.Config()
    for path in recommended_settings:
        config.insert_json5(path, json.dumps(configuration[path]))
    (publication,) = json.loads(config.get_json("qos/publication"))
    assert publication["config"]["congestion_control"] == "block_first"
