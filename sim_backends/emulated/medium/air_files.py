"""Files with the log of the radio transmissions: their names and maximum size."""

from typing import Final

PCAP: Final = "air.pcap"
CSV: Final = "air.csv"
LIMIT_BYTES: Final = 64 << 20
"""Maximum size of both files together; later attempts are omitted."""
