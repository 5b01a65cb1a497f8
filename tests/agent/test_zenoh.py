"""The adapter of Zenoh: attachments as Zenoh's own serializer writes them, and what the library is told."""

import json

import pytest
import zenoh
import zenoh.ext
from hypothesis import given
from hypothesis import strategies as st

from fieldkit.agent import zenoh as adapter
from fieldkit.agent.middleware import Network
from fieldkit.ros import tuning

numbers = st.integers(-(2**63), 2**63 - 1)


@given(numbers, numbers, st.binary(min_size=16, max_size=16))
def test_attachments_are_those_of_zenohs_serializer(sequence: int, at_ns: int, gid: bytes) -> None:
    """What `zenoh::ext::Serializer` makes of the three values that rmw_zenoh hands it."""
    whole = (zenoh.ext.Int64(sequence), zenoh.ext.Int64(at_ns), gid)
    assert adapter.ATTACHMENT.pack(sequence, at_ns, len(gid), gid) == zenoh.ext.z_serialize(whole).to_bytes()


def test_publishers_have_identifiers_of_their_own() -> None:
    assert len(adapter.gid("a")) == adapter.GID_BYTES
    assert adapter.gid("a") != adapter.gid("b")


def test_a_peer_looks_for_others_by_scouting_alone() -> None:
    found = adapter.configuration(Network("10.0.0.1"), "peer")
    assert found["scouting/multicast/enabled"] is True
    assert found["listen/endpoints"] == ["tcp/10.0.0.1:7447"]
    assert found["connect/endpoints"] == []


def test_peers_are_asked_by_address() -> None:
    network = Network("10.0.0.1", discovery="peers", peers=("10.0.0.2",), transport="udp")
    found = adapter.configuration(network, "peer")
    assert found["scouting/multicast/enabled"] is False
    assert found["connect/endpoints"] == ["udp/10.0.0.2:7447"]


def test_a_client_knows_its_router_alone() -> None:
    found = adapter.configuration(Network("10.0.0.1", discovery="router", server="10.0.0.9", port=7555), "client")
    assert found["connect/endpoints"] == ["tcp/10.0.0.9:7555"]
    assert "listen/endpoints" not in found


def test_a_router_asks_nobody() -> None:
    found = adapter.configuration(Network("10.0.0.9", discovery="router", server="10.0.0.9"), "router")
    assert found["listen/endpoints"] == ["tcp/10.0.0.9:7447"]
    assert "connect/endpoints" not in found


def test_settings_are_values_of_json_or_texts() -> None:
    network = Network("10.0.0.1", settings={"transport/link/tx/batch_size": "1400", "mode": "client"})
    found = adapter.configuration(network, "peer")
    assert (found["transport/link/tx/batch_size"], found["mode"]) == (1400, "client")


@pytest.mark.parametrize("transport", ["tcp", "udp"])
def test_the_library_knows_what_is_tuned(transport: str) -> None:
    """It refuses a path, or a value, that it does not know."""
    tuned = tuning.tuned("zenoh", transport)
    found = adapter.configuration(Network("10.0.0.1", transport=transport, settings=tuned), "peer")
    config = zenoh.Config()
    for path in tuned:
        config.insert_json5(path, json.dumps(found[path]))
    (publication,) = json.loads(config.get_json("qos/publication"))
    assert publication["config"]["congestion_control"] == "block_first"
