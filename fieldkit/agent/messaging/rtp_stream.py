"""Send and receive the video of a synthetic camera over RTP with GStreamer pipelines, and log each frame.

The pipelines are arguments, so this module contains no element of GStreamer. A frame is in the format I420: its luma
(`fieldkit.agent.video.frame_code`), then grey chroma of half its size.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from typing import IO, Iterator, Sequence

from fieldkit.agent.messaging import records
from fieldkit.agent.messaging.middleware import MiddlewareError
from fieldkit.agent.messaging.newest import NewestSample, logged_reads
from fieldkit.agent.messaging.records import Log
from fieldkit.agent.messaging.stream import SETTLING_S, WAIT_S, scheduled
from fieldkit.agent.video.frame_code import FrameCode

NAME = "video"
"""Name of the stream in its logs."""
FD = "{fd}"
"""Placeholder in a pipeline for the number of the file descriptor from or to which it passes frames."""

_PLAYING = "Setting pipeline to PLAYING"
_GREY = b"\x80"
_EXIT_TIMEOUT_S = 5.0


@dataclass(frozen=True)
class Video:
    """Parameters of one end of a video.

    Attributes:
        pipeline: Command of the pipeline, `gst-launch-1.0` with its arguments.
        width: Pixels per row.
        height: Rows.
        noise_rows: Rows of random pixels.
        rate_hz: Frames per second.
        duration_s: Duration.
        patience_s: Time within which the pipeline must be playing.
        reads_hz: Refresh rate of the receiver's display; 0 if it has none.
    """

    pipeline: Sequence[str]
    width: int
    height: int
    noise_rows: int
    rate_hz: float
    duration_s: float
    patience_s: float
    reads_hz: float

    @property
    def frame_bytes(self) -> int:
        """Size of a frame."""
        return self.width * self.height * 3 // 2

    def code(self) -> FrameCode:
        """Return the code that writes the number and the time into its frames, and reads them."""
        return FrameCode(self.width, self.height, self.noise_rows)


def send(video: Video, log: Log, stop_event: threading.Event) -> None:
    """Pass frames to a pipeline at their scheduled times, and log each of them.

    Raises:
        LogError: For the same reasons as `Log.note`.
        MiddlewareError: The pipeline does not start, or ended early.
    """
    read_end, write_end = os.pipe()
    code, chroma = video.code(), _GREY * (video.width * video.height // 2)
    with os.fdopen(write_end, "wb", buffering=0) as frames, _playing(video, read_end, log, stop_event) as process:
        stop_event.wait(SETTLING_S)
        for sequence in scheduled(video.rate_hz, video.duration_s, log, stop_event):
            sent_ns = time.time_ns()
            try:
                _write_all(frames, code.luma(sequence, sent_ns) + chroma)
            except BrokenPipeError:
                break
            log.note(records.SAMPLE, time.time_ns(), size=video.frame_bytes, sequence=sequence, sent_ns=sent_ns)
        else:  # all frames were sent
            frames.close()
            with suppress(subprocess.TimeoutExpired):
                process.wait(_EXIT_TIMEOUT_S)
            stop_event.wait(SETTLING_S)
            return
    if not stop_event.is_set():
        raise _early_end_error(process)


def receive(video: Video, log: Log, stop_event: threading.Event) -> None:
    """Log each frame from a pipeline, and each refresh of a display, until `stop_event` is set.

    Writes `up, RTP` to standard error when the pipeline is playing.

    Raises:
        LogError: For the same reasons as `Log.note`.
        MiddlewareError: The pipeline does not start, or ended early.
    """
    read_end, write_end = os.pipe()
    code, newest = video.code(), NewestSample()
    with os.fdopen(read_end, "rb", buffering=0) as frames, _playing(video, write_end, log, stop_event) as process:
        sys.stderr.write("up, RTP\n")
        sys.stderr.flush()
        with logged_reads(newest, video.reads_hz, log, stop_event):
            for data in _frames(frames, video.frame_bytes):
                at_ns = time.time_ns()
                content = code.read(data)
                if content is None:
                    log.note(records.UNREADABLE, at_ns, size=len(data))
                else:
                    newest.offer(*content)
                    log.note(records.SAMPLE, at_ns, size=len(data), sequence=content[0], sent_ns=content[1])
    if not stop_event.is_set():
        raise _early_end_error(process)


def _frames(file: IO[bytes], size: int) -> Iterator[bytes]:
    """Yield the complete frames in a pipe until its other end is closed."""
    parts: list[bytes] = []
    missing = size
    while data := file.read(missing):
        parts.append(data)
        missing -= len(data)
        if not missing:
            yield b"".join(parts)
            parts, missing = [], size


def _write_all(file: IO[bytes], data: bytes) -> None:
    """Write to a pipe, which may accept only a part of the data at a time."""
    remaining_data = memoryview(data)
    while remaining_data:
        remaining_data = remaining_data[file.write(remaining_data) :]


@contextmanager
def _playing(video: Video, fd: int, log: Log, stop_event: threading.Event) -> Iterator[subprocess.Popen[str]]:
    """Run the pipeline while the body runs; it is stopped when `stop_event` is set, so that no pipe blocks.

    Its messages are copied to standard error. `MATCHED` is logged when it is playing.

    Args:
        video: The video.
        fd: The file descriptor that replaces `FD`; it is closed in this process.
        log: The log.
        stop_event: Set to stop.

    Raises:
        MiddlewareError: The program cannot be started, or is not playing in time.
    """
    command = [word.replace(FD, str(fd)) for word in video.pipeline]
    try:
        process = subprocess.Popen(
            command,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            pass_fds=(fd,),
            env={**os.environ, "LC_ALL": "C"},
            universal_newlines=True,
        )
    except OSError as error:
        raise MiddlewareError(f"{command[0]} cannot be started: {error.strerror}") from error
    finally:
        os.close(fd)
    is_playing = threading.Event()
    copier = threading.Thread(target=_copy_messages, args=(process, is_playing))
    copier.start()
    threading.Thread(target=_stop_on_event, args=(process, stop_event), daemon=True).start()
    try:
        deadline_s = time.monotonic() + video.patience_s
        while not is_playing.wait(WAIT_S) and not stop_event.is_set():
            if process.poll() is not None:
                raise _early_end_error(process)
            if time.monotonic() > deadline_s:
                raise MiddlewareError(f"{command[0]} is not playing after {video.patience_s:g} s")
        log.note(records.MATCHED, time.time_ns())
        yield process
    finally:
        _stop(process)
        copier.join()


def _copy_messages(process: subprocess.Popen[str], is_playing: threading.Event) -> None:
    for line in process.stdout or ():
        sys.stderr.write(line)
        sys.stderr.flush()
        if line.startswith(_PLAYING):
            is_playing.set()


def _stop_on_event(process: subprocess.Popen[str], stop_event: threading.Event) -> None:
    stop_event.wait()
    _stop(process)


def _stop(process: subprocess.Popen[str]) -> None:
    """Stop a process, if it is running, by SIGINT, or by SIGKILL if it still runs after `_EXIT_TIMEOUT_S`."""
    if process.poll() is None:
        process.send_signal(signal.SIGINT)
    try:
        process.wait(_EXIT_TIMEOUT_S)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()


def _early_end_error(process: subprocess.Popen[str]) -> MiddlewareError:
    return MiddlewareError(f"the pipeline ended early with exit code {process.wait()}: see its messages above")
