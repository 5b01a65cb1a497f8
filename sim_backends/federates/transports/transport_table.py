"""The table of all transports. `--physics`, `--network`, `serve` and the documentation page read it."""

from collections.abc import Sequence
from typing import Final

from fieldkit.core.errors import ConfigurationError
from sim_backends.federates.transports import dds, ros1, tcp, udp_transport
from sim_backends.federates.transports.contract import FederateTransport, TransportAddress

TRANSPORTS: Final[Sequence[FederateTransport]] = (
    tcp.TRANSPORT,
    udp_transport.TRANSPORT,
    dds.TRANSPORT,
    ros1.TRANSPORT,
)
FORMS: Final[Sequence[str]] = [form for transport in TRANSPORTS for form in transport.forms]
_BY_SCHEME: Final = {form.partition(":")[0]: transport for transport in TRANSPORTS for form in transport.forms}


def parse_address(text: str) -> TransportAddress | None:
    """Return the address of a text; None if the text does not begin with the scheme of a transport.

    Raises:
        ConfigurationError: The text is not a valid address of this transport.
    """
    scheme, colon, _ = text.partition(":")
    transport = _BY_SCHEME.get(scheme) if colon else None
    if transport is None:
        return None
    try:
        return transport.parse(text)
    except ValueError as error:
        raise ConfigurationError(
            f"{text!r} is not an address: {error}", remedy=f"write for example {transport.example}"
        ) from None
