"""The sending end of a connection: opens it, sends the stream, and retransmits lost segments."""

from collections.abc import Callable, Mapping
from typing import Final

from sim_backends.network.tcp.congestion import Cubic, NewReno
from sim_backends.network.tcp.linux_cubic import LinuxCubic
from sim_backends.network.tcp.recovery import ProportionalReduction, RackScoreboard, RoundTrips
from sim_backends.network.tcp.scoreboard import Scoreboard, SentSegment
from sim_backends.network.tcp.segments import MessageStream, Segment
from sim_backends.network.tcp.tcp_options import Congestion, TcpOptions
from sim_backends.network.wire import Wire, WireTimer

_CONTROLS: Final[Mapping[Congestion, tuple[type[NewReno], type[Scoreboard]]]] = {
    "cubic": (LinuxCubic, RackScoreboard),
    "cubic-rfc9438": (Cubic, Scoreboard),
    "newreno": (NewReno, Scoreboard),
}


class Sender:
    """Sends a stream and processes ACKs; opens the connection when it is created, unless it is already open.

    Losses are detected by RFC 6675, or by RFC 8985 with Linux's congestion control. A loss starts a recovery: the
    window is reduced once; then lost segments are sent again, followed by new data, as far as the rate reduction of
    RFC 6937 allows. After a timeout all segments that have not arrived count as lost, and slow start begins (RFC
    5681, 3.1). Segments reported by SACK count as arrived permanently, because the receiver never discards them.

    Args:
        wire: Provides the clock.
        host: Name of its host.
        options: Options of TCP.
        stream: The data to send.
        transmit: Sends a segment.
        give_up: Called with the reason when the connection is given up, after which nothing is sent.
        log: Called with the event whenever the state may have changed: `ack`, `loss`, `timeout`, `idle`.
        round_trip_ns: The round trip of a connection that is already open; None opens a new one.

    Attributes:
        control: The congestion window.
        scoreboard: The segments that are not acknowledged.
        round_trips: The estimate of the round trip, and the retransmission timeout.
    """

    def __init__(
        self,
        wire: Wire,
        host: str,
        options: TcpOptions,
        stream: MessageStream,
        *,
        transmit: Callable[[Segment], None],
        give_up: Callable[[str], None],
        log: Callable[[str], None],
        round_trip_ns: int | None = None,
    ) -> None:
        self._wire = wire
        self._options = options
        self._stream = stream
        self._transmit = transmit
        self._give_up = give_up
        self._log = log
        self._timer = WireTimer(wire, host, self._on_timeout)
        self._reordering_timer = WireTimer(wire, host, self._on_reordering_timeout)
        self._is_open = False
        self._echo_ns: int | None = None  # the last received timestamp, which later segments echo
        self._receive_window_bytes = 0
        # Consecutive timeouts without progress.
        self._timeouts = 0
        # Sequence number whose acknowledgement ends the recovery (RecoveryPoint); None outside a recovery.
        self._recovery_end: int | None = None
        # Limits the bytes in flight in a recovery after a loss (not a timeout), in place of the congestion window.
        self._reduction: ProportionalReduction | None = None
        self._window_bytes = 0
        # True if the window prevented sending at the last attempt.
        self._is_window_limited = False
        self._last_sent_ns = 0
        self._last_ack_ns = 0
        control, scoreboard = _CONTROLS[options.congestion]
        self.control = control(options)
        self.scoreboard = scoreboard()
        self.round_trips = RoundTrips(options)
        if round_trip_ns is None:
            self._send_syn()
        else:
            self._is_open = True
            self._receive_window_bytes = options.receive_window_bytes
            self.round_trips.sample(round_trip_ns)

    def on_written(self) -> None:
        """Send data that was written to the stream, as far as the windows allow."""
        if not self._is_open:
            return
        idle_ns = self._wire.now_ns - self._last_sent_ns
        if self._options.restart_after_idle and not self.scoreboard and idle_ns > self.round_trips.timeout_ns:
            self.control.on_restart()
            self._log("idle")
        self._send()

    def receive(self, segment: Segment) -> None:
        """Process a segment of the other end."""
        if segment.syn:
            self._on_syn_ack(segment)
        elif self._is_open:
            self._on_ack(segment)

    def close(self) -> None:
        """Stop sending, and stop all timers."""
        self._is_open = False
        self._timer.stop()
        self._reordering_timer.stop()

    def _send_syn(self) -> None:
        self._emit(0, 0, number=0, earlier_transmissions=self._timeouts, syn=True)
        self._timer.set(self._wire.now_ns + self.round_trips.timeout_ns)

    def _on_syn_ack(self, segment: Segment) -> None:
        """Process a SYN-ACK; a repeated SYN-ACK is only acknowledged again."""
        if not self._is_open:
            self._is_open = True
            self._timer.stop()
            if self._timeouts > 1:
                self.control.on_syn_losses()
            self._timeouts = 0
            self._receive_window_bytes = segment.window_bytes
            self._sample_round_trip(segment)
        self._echo_ns = segment.sent_ns
        self._emit(1, 0, number=segment.number, earlier_transmissions=segment.earlier_transmissions)
        self._send()

    def _sample_round_trip(self, segment: Segment) -> None:
        """Measure the round trip by the echoed timestamp (RFC 7323, 4.1)."""
        assert segment.echoes_ns is not None
        self.round_trips.sample(self._wire.now_ns - segment.echoes_ns)

    def _on_ack(self, segment: Segment) -> None:
        """Process an ACK: update the scoreboard, the round trip and the window, detect losses, and send."""
        scoreboard, ack_number, now_ns = self.scoreboard, segment.acknowledges, self._wire.now_ns
        assert ack_number is not None
        self._receive_window_bytes = segment.window_bytes
        self._echo_ns = segment.sent_ns
        delivered_bytes, losses = scoreboard.delivered_bytes, scoreboard.losses
        scoreboard.arrive(now_ns, segment.sacks)
        is_new_ack = ack_number > scoreboard.first_unacknowledged
        if is_new_ack:
            scoreboard.acknowledge(now_ns, ack_number)
            self._timeouts = 0
            self._sample_round_trip(segment)
            self._restart_timer()
            self._update_window(scoreboard.delivered_bytes - delivered_bytes)
        self._detect_losses()
        if self._reduction is not None:
            self._window_bytes = self._reduction.window_bytes(
                scoreboard.pipe_bytes,
                scoreboard.delivered_bytes - delivered_bytes,
                is_safe=is_new_ack and scoreboard.losses == losses,
            )
        self._send()
        self._log("ack")

    def _detect_losses(self) -> None:
        """Detect losses, and start a recovery if none is in progress."""
        due_ns = self.scoreboard.detect_losses(self._wire.now_ns, is_recovering=self._recovery_end is not None)
        if due_ns is None:
            self._reordering_timer.stop()
        else:
            self._reordering_timer.set(due_ns)
        if self._recovery_end is None and (lost_segment := self.scoreboard.next_lost()) is not None:
            self._start_recovery(lost_segment)

    def _on_reordering_timeout(self) -> None:
        """Detect losses after the reordering window has passed (RFC 8985, 6.2, step 5)."""
        if self._is_open:
            self._detect_losses()
            if self._reduction is not None:
                self._window_bytes = self._reduction.window_bytes(self.scoreboard.pipe_bytes, 0, is_safe=False)
            self._send()

    def _update_window(self, delivered_bytes: int) -> None:
        """Increase the window for an ACK of new data, or end the recovery that the ACK completes.

        Bytes that a SACK reported before are not counted again: after a timeout one ACK may cover much data that left
        the network long ago (RFC 3465, 2.3; Linux: acked_sacked).
        """
        now_ns = self._wire.now_ns
        last_ack_ns, self._last_ack_ns = self._last_ack_ns, now_ns
        is_recovering = self._reduction is not None
        if self._recovery_end is not None and self.scoreboard.first_unacknowledged >= self._recovery_end:
            self._recovery_end = None
            self._reduction = None
        if is_recovering:
            return
        if self._is_window_limited:
            assert self.round_trips.smoothed_ns is not None
            self.control.on_ack(now_ns, delivered_bytes, self.round_trips.smoothed_ns)
        else:
            self.control.on_idle(now_ns - last_ack_ns)

    def _start_recovery(self, lost_segment: SentSegment) -> None:
        """Start a recovery: reduce the window and send the first lost segment (RFC 6675, 5, step 4)."""
        scoreboard = self.scoreboard
        self._recovery_end = scoreboard.next_number
        self.control.on_loss(self._flight_bytes())
        self._reduction = ProportionalReduction(
            self.control.window_bytes,
            scoreboard.next_number - scoreboard.first_unacknowledged,
            self._options.segment_bytes,
        )
        self._log("loss")
        self._send_again(lost_segment)

    def _flight_bytes(self) -> int:
        """Return FlightSize without the data that limited transmit sent beyond the window (RFC 5681, 3.2, step 2)."""
        return min(self.scoreboard.next_number - self.scoreboard.first_unacknowledged, self.control.window_bytes)

    def _on_timeout(self) -> None:
        """Process a retransmission timeout: give up the connection, or begin to send all missing segments again."""
        self._timeouts += 1
        if not self._is_open:
            self._on_syn_timeout()
            return
        if self._timeouts > self._options.retries:
            self._give_up(f"tcp: not acknowledged, sent {self._timeouts} times")
            return
        scoreboard = self.scoreboard
        is_repeated = self._timeouts > 1 or (self._reduction is not None and not self.control.reduces_in_recovery)
        self.control.on_timeout(self._flight_bytes(), is_repeated=is_repeated)
        scoreboard.lose_all()
        self._recovery_end = scoreboard.next_number
        self._reduction = None
        self.round_trips.back_off()
        self._log("timeout")
        self._send()

    def _on_syn_timeout(self) -> None:
        if self._timeouts > self._options.syn_retries:
            self._give_up(f"tcp: not connected after {self._timeouts} tries")
            return
        self.round_trips.back_off()
        self._send_syn()

    def _send(self) -> None:
        """Send lost segments again, then new ones, as far as the windows allow (RFC 6675, 4, NextSeg)."""
        scoreboard = self.scoreboard
        if self._reduction is None:
            self._window_bytes = self.control.window_bytes
        self._is_window_limited = False
        while True:
            segment_to_resend = scoreboard.next_lost()
            length = segment_to_resend.end - segment_to_resend.first if segment_to_resend else self._next_length()
            if not length and self._recovery_end is not None:
                segment_to_resend = scoreboard.next_overtaken()
                length = segment_to_resend.end - segment_to_resend.first if segment_to_resend else 0
            if not length:
                return
            if scoreboard.pipe_bytes + length > self._window_bytes:
                self._is_window_limited = True
                return
            if segment_to_resend:
                self._send_again(segment_to_resend)
            else:
                self._send_new(length)

    def _next_length(self) -> int:
        """Return the length of the next new segment; 0 if there is none."""
        scoreboard, options = self.scoreboard, self._options
        length = min(options.segment_bytes, self._stream.end - scoreboard.next_number)
        if scoreboard.next_number + length > scoreboard.first_unacknowledged + self._receive_window_bytes:
            return 0
        if options.nagle and length < options.segment_bytes and scoreboard:
            return 0
        return length

    def _send_new(self, length: int) -> None:
        segment = self.scoreboard.send(self._wire.now_ns, length, self._stream.number(self.scoreboard.next_number))
        self._emit(segment.first, length, number=segment.number, earlier_transmissions=0)
        self._record_sent(length)
        if self._timer.due_ns is None:
            self._restart_timer()

    def _send_again(self, segment: SentSegment) -> None:
        self._emit(
            segment.first,
            segment.end - segment.first,
            number=segment.number,
            earlier_transmissions=segment.transmissions,
        )
        self.scoreboard.send_again(self._wire.now_ns, segment)
        self._record_sent(segment.end - segment.first)
        # RFC 6675, 6: each retransmission restarts the timer, so that a long recovery causes no needless timeout.
        self._restart_timer()

    def _record_sent(self, length: int) -> None:
        self._last_sent_ns = self._wire.now_ns
        if self._reduction is not None:
            self._reduction.on_sent(length)

    def _restart_timer(self) -> None:
        """Restart the timer if anything is not acknowledged, otherwise stop it (RFC 6298, 5.1 to 5.3)."""
        if self.scoreboard:
            self._timer.set(self._wire.now_ns + self.round_trips.timeout_ns)
        else:
            self._timer.stop()

    def _emit(self, first: int, length: int, *, number: int, earlier_transmissions: int, syn: bool = False) -> None:
        """Create a segment and send it."""
        acknowledges = None if syn else 1
        self._transmit(
            Segment(
                syn=syn,
                first=first,
                length=length,
                acknowledges=acknowledges,
                sacks=(),
                window_bytes=self._options.receive_window_bytes,
                sent_ns=self._wire.now_ns,
                echoes_ns=self._echo_ns,
                number=number,
                earlier_transmissions=earlier_transmissions,
            )
        )
