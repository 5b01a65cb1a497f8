"""The sending end of a connection: opens it, sends the stream, and sends again what is lost."""

from collections.abc import Callable, Mapping
from typing import Final

from sim_backends.network.tcp.congestion import NewReno
from sim_backends.network.tcp.cubic import Cubic
from sim_backends.network.tcp.linux_cubic import LinuxCubic
from sim_backends.network.tcp.messages import MessageStream
from sim_backends.network.tcp.options import Congestion, TcpOptions
from sim_backends.network.tcp.rack import RackScoreboard
from sim_backends.network.tcp.reduction import ProportionalReduction
from sim_backends.network.tcp.round_trips import RoundTrips
from sim_backends.network.tcp.scoreboard import Scoreboard, SentSegment
from sim_backends.network.tcp.segments import Segment
from sim_backends.network.timer import WireTimer
from sim_backends.network.wire import Wire

_CONTROLS: Final[Mapping[Congestion, tuple[type[NewReno], type[Scoreboard]]]] = {
    "cubic": (LinuxCubic, RackScoreboard),
    "cubic-rfc9438": (Cubic, Scoreboard),
    "newreno": (NewReno, Scoreboard),
}


class Sender:
    """Sends a stream and hears ACKs; the connection is opened as it is made, unless it is open already.

    Losses are detected by RFC 6675, or by RFC 8985 where the congestion control is Linux's. A loss begins a recovery:
    the window closes once, and what is lost is sent again, then new data, as far as the reduction of RFC 6937 allows.
    After a timeout everything that has not arrived is lost, and slow start begins (RFC 5681, 3.1). What arrived by
    SACK stays so, as the receiver never discards it.

    Args:
        wire: Its clock.
        host: Where it is.
        options: Of TCP.
        stream: What it sends.
        transmit: Sends a segment.
        give_up: Told why, when the connection is given up; nothing happens in it any more.
        log: Told what happened whenever the state may have changed: `ack`, `loss`, `timeout`, `idle`.
        round_trip_ns: The round trip of a connection that is open already; None opens it.

    Attributes:
        control: The congestion window.
        board: What is under way.
        round_trips: The timeout.
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
        self._timer = WireTimer(wire, host, self._expire)
        self._reordering_timer = WireTimer(wire, host, self._reordering_expired)
        self._open = False
        self._echoes_ns: int | None = None
        self._receive_window_bytes = 0
        # Timeouts without any progress in between.
        self._expired = 0
        # What must be acknowledged before a recovery is over (RecoveryPoint); None outside of one.
        self._recovery_end: int | None = None
        # Says how much may be under way in a recovery that no timeout began, in place of the congestion window.
        self._reduction: ProportionalReduction | None = None
        self._window_bytes = 0
        # Whether the window kept data back when it was tried last.
        self._full = False
        self._sent_ns = 0
        self._heard_ns = 0
        control, board = _CONTROLS[options.congestion]
        self.control = control(options)
        self.board = board()
        self.round_trips = RoundTrips(options)
        if round_trip_ns is None:
            self._synchronize()
        else:
            self._open = True
            self._receive_window_bytes = options.receive_window_bytes
            self.round_trips.sample(round_trip_ns)

    def written(self) -> None:
        """Send what was written to the stream, as far as may be."""
        if not self._open:
            return
        idle_ns = self._wire.now_ns - self._sent_ns
        if self._options.restart_after_idle and not self.board and idle_ns > self.round_trips.timeout_ns:
            self.control.restarted()
            self._log("idle")
        self._send()

    def receive(self, segment: Segment) -> None:
        """Take a segment of the other end."""
        if segment.syn:
            self._synchronized(segment)
        elif self._open:
            self._acknowledged(segment)

    def close(self) -> None:
        """Do nothing any more."""
        self._open = False
        self._timer.stop()
        self._reordering_timer.stop()

    def _synchronize(self) -> None:
        self._emit(0, 0, number=0, times=self._expired, syn=True)
        self._timer.set(self._wire.now_ns + self.round_trips.timeout_ns)

    def _synchronized(self, segment: Segment) -> None:
        """Take a SYN-ACK; one that came before is only acknowledged again."""
        if not self._open:
            self._open = True
            self._timer.stop()
            if self._expired > 1:
                self.control.begun_late()
            self._expired = 0
            self._receive_window_bytes = segment.window_bytes
            self._heard(segment)
        self._echoes_ns = segment.sent_ns
        self._emit(1, 0, number=segment.number, times=segment.times)
        self._send()

    def _heard(self, segment: Segment) -> None:
        """Measure the round trip by the timestamp that came back (RFC 7323, 4.1)."""
        assert segment.echoes_ns is not None
        self.round_trips.sample(self._wire.now_ns - segment.echoes_ns)

    def _acknowledged(self, segment: Segment) -> None:
        board, upto, now_ns = self.board, segment.acknowledges, self._wire.now_ns
        assert upto is not None
        self._receive_window_bytes = segment.window_bytes
        self._echoes_ns = segment.sent_ns
        delivered_bytes, losses = board.delivered_bytes, board.losses
        board.arrive(now_ns, segment.sacks)
        advances = upto > board.acknowledged
        if advances:
            board.acknowledge(now_ns, upto)
            self._expired = 0
            self._heard(segment)
            self._restart_timer()
            self._grow(board.delivered_bytes - delivered_bytes)
        self._detect_losses()
        if self._reduction is not None:
            self._window_bytes = self._reduction.window_bytes(
                board.pipe_bytes,
                board.delivered_bytes - delivered_bytes,
                safe=advances and board.losses == losses,
            )
        self._send()
        self._log("ack")

    def _detect_losses(self) -> None:
        """Find what is lost, and begin a recovery if there is none."""
        due_ns = self.board.detect_losses(self._wire.now_ns, recovering=self._recovery_end is not None)
        if due_ns is None:
            self._reordering_timer.stop()
        else:
            self._reordering_timer.set(due_ns)
        if self._recovery_end is None and (lost := self.board.lost()) is not None:
            self._recover(lost)

    def _reordering_expired(self) -> None:
        """Find what is lost now that the reordering window has passed (RFC 8985, 6.3)."""
        if self._open:
            self._detect_losses()
            if self._reduction is not None:
                self._window_bytes = self._reduction.window_bytes(self.board.pipe_bytes, 0, safe=False)
            self._send()

    def _grow(self, delivered_bytes: int) -> None:
        """Open the window by an ACK of new data, or end the recovery that it completes.

        What a SACK told of before does not count again: after a timeout one ACK may cover much that left the network
        long ago (RFC 3465, 2.3; Linux: acked_sacked).
        """
        now_ns = self._wire.now_ns
        heard_ns, self._heard_ns = self._heard_ns, now_ns
        recovering = self._reduction is not None
        if self._recovery_end is not None and self.board.acknowledged >= self._recovery_end:
            self._recovery_end = None
            self._reduction = None
        if recovering:
            return
        if self._full:
            assert self.round_trips.smoothed_ns is not None
            self.control.acknowledged(now_ns, delivered_bytes, self.round_trips.smoothed_ns)
        else:
            self.control.idled(now_ns - heard_ns)

    def _recover(self, lost: SentSegment) -> None:
        """Begin a recovery: close the window and send the first lost segment (RFC 6675, 5, step 4)."""
        board = self.board
        self._recovery_end = board.next
        self.control.lost(self._flight_bytes())
        self._reduction = ProportionalReduction(
            self.control.window_bytes, board.next - board.acknowledged, self._options.segment_bytes
        )
        self._log("loss")
        self._send_again(lost)

    def _flight_bytes(self) -> int:
        """Return FlightSize without what limited transmit sent beyond the window (RFC 5681, 3.2, step 2)."""
        return min(self.board.next - self.board.acknowledged, self.control.window_bytes)

    def _expire(self) -> None:
        self._expired += 1
        if not self._open:
            self._expire_opening()
            return
        if self._expired > self._options.retries:
            self._give_up(f"tcp: not acknowledged, sent {self._expired} times")
            return
        board = self.board
        again = self._expired > 1 or (self._reduction is not None and not self.control.reduces_in_recovery)
        self.control.timed_out(self._flight_bytes(), again=again)
        board.lose_all()
        self._recovery_end = board.next
        self._reduction = None
        self.round_trips.back_off()
        self._log("timeout")
        self._send()

    def _expire_opening(self) -> None:
        if self._expired > self._options.syn_retries:
            self._give_up(f"tcp: not connected after {self._expired} tries")
            return
        self.round_trips.back_off()
        self._synchronize()

    def _send(self) -> None:
        """Send lost segments again, then new ones, as far as the windows let (RFC 6675, 4, NextSeg)."""
        board = self.board
        if self._reduction is None:
            self._window_bytes = self.control.window_bytes
        self._full = False
        while True:
            again = board.lost()
            length = again.end - again.first if again else self._next_length()
            if not length and self._recovery_end is not None:
                again = board.overtaken()
                length = again.end - again.first if again else 0
            if not length:
                return
            if board.pipe_bytes + length > self._window_bytes:
                self._full = True
                return
            if again:
                self._send_again(again)
            else:
                self._send_new(length)

    def _next_length(self) -> int:
        """Return how much new data the next segment takes; 0 for none."""
        board, options = self.board, self._options
        length = min(options.segment_bytes, self._stream.end - board.next)
        if board.next + length > board.acknowledged + self._receive_window_bytes:
            return 0
        if options.nagle and length < options.segment_bytes and board:
            return 0
        return length

    def _send_new(self, length: int) -> None:
        segment = self.board.send(self._wire.now_ns, length, self._stream.number(self.board.next))
        self._emit(segment.first, length, number=segment.number, times=0)
        self._note_sent(length)
        if self._timer.due_ns is None:
            self._restart_timer()

    def _send_again(self, segment: SentSegment) -> None:
        self._emit(segment.first, segment.end - segment.first, number=segment.number, times=segment.times)
        self.board.send_again(self._wire.now_ns, segment)
        self._note_sent(segment.end - segment.first)
        # RFC 6675, 6: each one starts the timer anew, so that a long recovery ends in no needless timeout.
        self._restart_timer()

    def _note_sent(self, length: int) -> None:
        self._sent_ns = self._wire.now_ns
        if self._reduction is not None:
            self._reduction.sent(length)

    def _restart_timer(self) -> None:
        """Start the timer anew while anything is under way (RFC 6298, 5.1 to 5.3)."""
        if self.board:
            self._timer.set(self._wire.now_ns + self.round_trips.timeout_ns)
        else:
            self._timer.stop()

    def _emit(self, first: int, length: int, *, number: int, times: int, syn: bool = False) -> None:
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
                echoes_ns=self._echoes_ns,
                number=number,
                times=times,
            )
        )
