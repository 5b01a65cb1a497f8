"""Log of the radio transmissions: one record in `air.pcap` and one line in `air.csv` per attempt.

An ACK, RTS or CTS is an attempt with the number 0.

The capture has link type 105, IEEE 802.11 without FCS (https://www.tcpdump.org/linktypes.html), and time stamps in
nanoseconds. Stations have the addresses 02:00:00:00:00:01 and so on, in the order of their names. If packets are in
Ethernet frames, the packet type is taken from these.
"""

import os
import struct
import time
from collections.abc import Sequence
from typing import Final

from sim_backends.emulated.medium.air_files import LIMIT_BYTES
from sim_backends.emulated.medium.framing import IP, Framing
from sim_backends.radio.mac.frames import ControlFrame, TransmissionAttempt

_SNAP_BYTES: Final = 160
"""Maximum number of bytes of a frame that the capture contains (snapshot length)."""
_PCAP_HEADER: Final = struct.pack("<IHHiIII", 0xA1B23C4D, 2, 4, 0, 0, _SNAP_BYTES, 105)
_RECORD_HEADER: Final = struct.Struct("<IIII")
# Frame control, duration, receiver, transmitter, BSSID, sequence control: as in an ad hoc network (IBSS).
_MAC: Final = struct.Struct("<BBH6s6s6sH")
# Type `data` in the first byte of frame control, and the flag Retry in the second one.
_DATA, _RETRY = 0x08, 0x08
# Frame control, duration (0 in an ACK of the last fragment; not modelled in RTS and CTS), receiver, and in RTS the
# transmitter: IEEE 802.11-2020, 9.3.1.2 to 9.3.1.4.
_CONTROL: Final = struct.Struct("<BBH6s")
_FRAME_CONTROL: Final[dict[ControlFrame, int]] = {"ACK": 0xD4, "RTS": 0xB4, "CTS": 0xC4}
# BSSID of all frames; the addresses of the stations begin with the same bytes.
_BSSID: Final = b"\x02" + bytes(5)
_BROADCAST: Final = b"\xff" * 6
# LLC and SNAP headers before the packet's type: RFC 1042.
_LLC: Final = bytes.fromhex("aaaa03000000")
_COLUMNS: Final = b"start_ns,end_ns,transmitter,receiver,mode,size_bytes,attempt,received\n"


class AirLog:
    """Writes attempts to two files.

    Args:
        descriptors: Descriptors of the capture and of the table, closed by `close`.
        names: Names of the stations.
        limit_bytes: Maximum size of both files together.
        framing: Framing of the payloads.
    """

    def __init__(
        self,
        descriptors: Sequence[int],
        names: Sequence[str],
        limit_bytes: int = LIMIT_BYTES,
        *,
        framing: Framing = IP,
    ) -> None:
        pcap, table = descriptors
        self._framing = framing
        self._pcap = os.fdopen(pcap, "wb", 1 << 16)
        self._table = os.fdopen(table, "wb", 1 << 16)
        self._addresses = {
            name: _BSSID[:4] + struct.pack(">H", number) for number, name in enumerate(sorted(names), 1)
        }
        # Attempts have times of the monotonic clock.
        self._utc_offset_ns = time.time_ns() - time.monotonic_ns()
        self._remaining_bytes = limit_bytes - len(_PCAP_HEADER) - len(_COLUMNS)
        self._pcap.write(_PCAP_HEADER)
        self._table.write(_COLUMNS)

    def write(self, attempt: TransmissionAttempt) -> None:
        """Write one attempt."""
        record, line = self._record(attempt), self._line(attempt)
        self._remaining_bytes -= len(record) + len(line)
        if self._remaining_bytes >= 0:
            self._pcap.write(record)
            self._table.write(line)

    def close(self) -> None:
        """Write buffered data and close the files."""
        self._pcap.close()
        self._table.close()

    def _record(self, attempt: TransmissionAttempt) -> bytes:
        receiver = _BROADCAST if attempt.receiver is None else self._addresses[attempt.receiver]
        frame = self._control_frame(attempt, receiver) if attempt.control else self._data_frame(attempt, receiver)
        seconds, nanoseconds = divmod(attempt.start_ns + self._utc_offset_ns, 1_000_000_000)
        snapshot = frame[:_SNAP_BYTES]
        return _RECORD_HEADER.pack(seconds, nanoseconds, len(snapshot), len(frame)) + snapshot

    def _control_frame(self, attempt: TransmissionAttempt, receiver: bytes) -> bytes:
        transmitter = self._addresses[attempt.transmitter] if attempt.control == "RTS" else b""
        return _CONTROL.pack(_FRAME_CONTROL[attempt.control], 0, 0, receiver) + transmitter

    def _data_frame(self, attempt: TransmissionAttempt, receiver: bytes) -> bytes:
        retry = _RETRY if attempt.number > 1 else 0
        mac = _MAC.pack(_DATA, retry, 0, receiver, self._addresses[attempt.transmitter], _BSSID, 0)
        packet = attempt.payload[self._framing.header_bytes :]
        frame: bytes = mac + _LLC + self._framing.ether_type(attempt.payload) + packet
        return frame

    def _line(self, attempt: TransmissionAttempt) -> bytes:
        values = (
            attempt.start_ns + self._utc_offset_ns,
            attempt.end_ns + self._utc_offset_ns,
            attempt.transmitter,
            attempt.receiver or "",
            attempt.mode.name,
            attempt.size_bytes,
            attempt.number,
            " ".join(attempt.received),
        )
        return (",".join(map(str, values)) + "\n").encode()
