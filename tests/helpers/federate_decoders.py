"""The decoder of each message that has a body, by the message's name; it uses the agents of the examples."""

from collections.abc import Callable, Mapping
from typing import Final

from docs.generator.federate_frames import agents
from sim_backends.federates import exchanges
from sim_backends.federates.exchanges import AdvanceNetwork, NetworkOutcomes
from sim_backends.federates.handshake import Hello, Welcome, decode_join
from sim_backends.federates.link_records import decode_links

DECODERS: Final[Mapping[str, Callable[[bytes], object]]] = {
    "join": decode_join,
    "hello": Hello.decode,
    "welcome": Welcome.decode,
    "advance physics": lambda body: exchanges.decode_advance_physics(body, agents()),
    "states": lambda body: exchanges.decode_states(body, agents()),
    "advance network": lambda body: AdvanceNetwork.decode(body, agents()),
    "outcomes": lambda body: NetworkOutcomes.decode(body, agents()),
    "links": lambda body: decode_links(body, agents(), 0),
    "ping": exchanges.decode_number,
    "fork": exchanges.decode_fork,
    "error": exchanges.decode_text,
}
