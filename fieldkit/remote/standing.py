"""Shells that stay open on a robot: commands go down their channels, and no session is opened for each.

A command is a line, `NONCE VERB WORD...`, quoted as everything remote is. The shell answers on either stream with the
nonce, what the command writes, and the nonce again with the exit code: this when another line asks for it, where
`held` stands before the verb. The nonce is drawn for each command, and no program on the robot is told it. So output
of any kind, whether it ends a line or not, is not taken for the end of an answer, and what a process left behind
writes between two commands is dropped.
"""

import re
import secrets
import threading
from contextlib import suppress
from typing import Final, Self

from fieldkit.core.deadline import Deadline, bounded
from fieldkit.remote.link import BROKEN, Channel, Link, Transport, UnfitServerError

_READY: Final = b"ready\n"
_CHUNK: Final = 1 << 15
_NONCE_BYTES: Final = 16
_END: Final = re.compile(rb" [0-9]{1,3}\n")
_END_BYTES: Final = 5
_SHELLS: Final = 2
"""How many a robot gets: a capture and a listener begin on it at the same time."""


class Standing:
    """The standing shells of one robot, opened anew on each link, each for one command at a time.

    What finds none that is free is carried as always, by a channel of its own.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()  # of what follows
        self._link: Link | None = None
        self._shells: list[StandingShell] = []
        self._opening = False
        self._opener: threading.Thread | None = None

    def begin(
        self, link: Link, words: str, deadline: Deadline, ended: threading.Event, *, held: bool = False
    ) -> "Turn | None":
        """Return a command that a shell on `link` has begun; None if none is free, or it has ended.

        With `held`, the shell tells its end when `Turn.ask` asks for it.

        Raises:
            ExpiredError: The deadline passed, or `ended` was set.
            OSError, SSHException, EOFError: The connection broke.
        """
        with self._lock:
            shells = list(self._shells) if self._link is link else []
        shell = next((one for one in shells if one.take()), None)
        if shell is None:
            return None
        line = f"held {words}" if held else words
        turn = bounded(lambda: shell.start(line), deadline, ended, what="start")
        link.acknowledge()
        return turn

    def restore(self, link: Link, command: str) -> None:
        """Begin to open a shell by `command` where `link` has too few, unless that failed on it before."""
        with self._lock:
            if self._link is not link:
                self._link, self._shells, self._opening = link, [], False
            self._shells = [shell for shell in self._shells if shell.alive]
            if self._opening or len(self._shells) == _SHELLS:
                return
            self._opening = True
            self._opener = threading.Thread(target=self._open, args=(link, command), daemon=True)
            self._opener.start()

    def settle(self, deadline: Deadline) -> None:
        """Wait until no shell is being opened, or the deadline has passed."""
        with self._lock:
            opener = self._opener
        if opener is not None:
            opener.join(deadline.remaining_s)

    def _open(self, link: Link, command: str) -> None:
        with suppress(*BROKEN):
            channel = link.another()
            shell = None if channel is None else StandingShell.open(channel, command)
            with self._lock:
                if shell is not None and self._link is link:
                    self._shells, self._opening = [*self._shells, shell], False


class StandingShell:
    """One command at a time: who has taken it starts a command, and closing that gives it back.

    Args:
        channel: Carries it; it has said that it is ready.
    """

    def __init__(self, channel: Channel) -> None:
        self._channel = channel
        self._taken = threading.Lock()

    @classmethod
    def open(cls, channel: Channel, command: str) -> Self:
        """Return the shell that `command` starts on `channel`, once it is ready.

        Raises:
            EOFError: It is none, or a login shell greets first.
            OSError, SSHException: The connection broke.
        """
        channel.exec_command(command)
        said = b""
        while len(said) < len(_READY) and (piece := channel.recv(len(_READY) - len(said))):
            said += piece
        if said != _READY:
            channel.close()
            raise EOFError("no shell that stays")
        return cls(channel)

    @property
    def alive(self) -> bool:
        """Whether it is not known to have ended."""
        return not (self._channel.closed or self._channel.eof_received)

    def take(self) -> bool:
        """Return whether it lives and has no command, and is the caller's now."""
        return self.alive and self._taken.acquire(blocking=False)

    def start(self, words: str) -> "Turn | None":
        """Return a command that the shell has begun; None if it has ended instead. It must have been taken.

        Raises:
            SSHException: The connection broke.
        """
        nonce = secrets.token_hex(_NONCE_BYTES).encode()
        turn = Turn(self._channel, nonce, self._taken)
        turn.settimeout(None)
        with suppress(OSError):  # it has ended; if the connection has, whoever asks for a session is told
            self._channel.sendall(nonce + b" " + words.encode() + b"\n")
        return turn if turn.has_begun() else None


class Turn:
    """A command in a standing shell, read as a channel of its own is by `drain`.

    Args:
        channel: The shell's.
        nonce: The command's.
        taken: Held as long as the shell has the command.
    """

    def __init__(self, channel: Channel, nonce: bytes, taken: threading.Lock) -> None:
        self._channel = channel
        self._taken: threading.Lock | None = taken
        self._over = threading.Event()
        self._out, self._err = _Stream(nonce), _Stream(nonce)

    def __del__(self) -> None:
        """Close it where nobody did, as a channel does."""
        self.close()

    def has_begun(self) -> bool:
        """Wait until the shell has begun the command; return whether it has, and not ended instead."""
        while not self._out.begun and (piece := self._channel.recv(_CHUNK)):
            self._out.feed(piece)
        return self._out.begun

    def ask(self) -> None:
        """Ask for the end of a command that is held.

        Raises:
            OSError, SSHException: The connection broke.
        """
        self._channel.sendall(b"\n")

    @property
    def eof_received(self) -> bool:
        """Whether all that the command writes is here; takes in what has come since the last look."""
        if self._channel.recv_ready():
            self._out.feed(self._channel.recv(_CHUNK))
        if self._channel.recv_stderr_ready():
            self._err.feed(self._channel.recv_stderr(_CHUNK))
        return self._ended or self._cut

    @property
    def closed(self) -> bool:
        """Whether nothing can come any more."""
        return self._cut

    @property
    def status_event(self) -> threading.Event:
        """Set when there is an exit code, or will be none."""
        return self._over if self._ended else self._channel.status_event

    def fileno(self) -> int:
        """Return a descriptor to read from when something came that `eof_received` has not taken in."""
        return self._channel.fileno()

    def get_transport(self) -> Transport:
        """Return what carries the shell's channel."""
        return self._channel.get_transport()

    def settimeout(self, seconds: float | None) -> None:
        """Bound each wait of `recv`."""
        self._channel.settimeout(seconds)

    def recv_ready(self) -> bool:
        """Return whether standard output of the command is here."""
        return bool(self._out.said)

    def recv_stderr_ready(self) -> bool:
        """Return whether standard error of the command is here."""
        return bool(self._err.said)

    def recv(self, size_bytes: int) -> bytes:
        """Return up to so much standard output, nothing at its end.

        Raises:
            TimeoutError: Nothing came in time.
        """
        while self._out.lacks and (piece := self._channel.recv(_CHUNK)):
            self._out.feed(piece)
        while not self._out.said and self._err.code is None and (piece := self._channel.recv_stderr(_CHUNK)):
            self._err.feed(piece)
        return self._out.take(size_bytes)

    def recv_stderr(self, size_bytes: int) -> bytes:
        """Return up to so much standard error of what is here."""
        return self._err.take(size_bytes)

    def recv_exit_status(self) -> int:
        """Return the exit code, -1 if the shell was ended by a signal or the connection broke.

        Raises:
            EOFError: The shell ended by itself, and left the command.
        """
        if self._out.code is not None:
            return self._out.code
        if self._channel.recv_exit_status() >= 0:
            raise EOFError("its shell ended before the command")
        return -1

    def close(self) -> None:
        """Give the shell back where the command has ended, else end it."""
        taken, self._taken = self._taken, None
        if not self._ended:
            self._channel.close()
        elif taken is not None:
            taken.release()

    @property
    def _ended(self) -> bool:
        if self._out.code is not None and self._err.code is not None:
            self._over.set()
        return self._over.is_set()

    @property
    def _cut(self) -> bool:
        """Whether the channel has ended, and all that came has been taken in."""
        ended = self._channel.closed or self._channel.eof_received
        return bool(ended) and not (self._channel.recv_ready() or self._channel.recv_stderr_ready())


Running = Channel | Turn
"""A command that runs: in a session of its own, or in a standing shell, without standard input."""


class _Stream:
    """What a command writes to one stream, told from what came before and from the end of the answer.

    Args:
        nonce: Tells both.

    Attributes:
        begun: Whether the answer has begun.
        said: What the command has written and nobody has taken.
        code: Its exit code, once the end is here.
    """

    def __init__(self, nonce: bytes) -> None:
        self.begun = False
        self.said = b""
        self.code: int | None = None
        self._nonce = nonce
        self._held = b""

    @property
    def lacks(self) -> bool:
        """Whether there is neither something to take nor the end."""
        return not self.said and self.code is None

    def take(self, size_bytes: int) -> bytes:
        """Return up to so much of what was written."""
        taken, self.said = self.said[:size_bytes], self.said[size_bytes:]
        return taken

    def feed(self, piece: bytes) -> None:
        """Take in what came; what comes before the answer and behind it is dropped.

        Raises:
            UnfitServerError: The end has no exit code.
        """
        if self.code is not None:
            return
        came, self._held = self._held + piece, b""
        if not self.begun:
            stray, mark, came = came.partition(self._nonce + b"\n")
            self.begun = bool(mark)
            if not mark:
                self._held = stray[-len(self._nonce) :]
                return
        said, nonce, rest = came.partition(self._nonce)
        if nonce:
            self._held = nonce + rest
            if _END.match(rest):
                self.code = int(rest.partition(b"\n")[0])
            elif len(rest) >= _END_BYTES:
                raise UnfitServerError("a command's exit code is none")
        else:
            # Only what the nonce may begin with is held back: somebody may wait for what the command said.
            held = next((n for n in range(len(self._nonce) - 1, 0, -1) if said.endswith(self._nonce[:n])), 0)
            said, self._held = said[: len(said) - held], said[len(said) - held :]
        self.said += said
