"""Linux timerfd with absolute deadlines on the monotonic clock; Python itself has timerfd only since 3.13."""

import ctypes
import os
import time
from typing import Final

_TFD_NONBLOCK: Final = 0o4000
_TFD_CLOEXEC: Final = 0o2000000
_TFD_TIMER_ABSTIME: Final = 1

_libc: Final = ctypes.CDLL(None, use_errno=True)


class _Itimerspec(ctypes.Structure):
    """struct itimerspec on 64-bit Linux: interval, then first expiry, each in seconds and nanoseconds."""

    _fields_ = (
        ("interval_s", ctypes.c_long),
        ("interval_ns", ctypes.c_long),
        ("value_s", ctypes.c_long),
        ("value_ns", ctypes.c_long),
    )


class Timer:
    """A one-shot timer on the clock of `time.monotonic_ns`, whose descriptor becomes readable when it fires.

    The timeout of epoll has a resolution of 1 ms, which is too coarse for the delay of a link. Setting the timer
    makes the descriptor unreadable again, so with EPOLLET the descriptor need not be read.

    Attributes:
        fd: The descriptor.

    Raises:
        OSError: The kernel cannot create a timer.
    """

    def __init__(self) -> None:
        self.fd: Final[int] = _libc.timerfd_create(time.CLOCK_MONOTONIC, _TFD_NONBLOCK | _TFD_CLOEXEC)
        if self.fd < 0:
            raise OSError(ctypes.get_errno(), os.strerror(ctypes.get_errno()))
        self._spec = _Itimerspec()
        self._spec_address = ctypes.byref(self._spec)

    def set(self, at_ns: int) -> None:
        """Fire at `at_ns`, or immediately if that has passed; replaces the time set before.

        Raises:
            OSError: The descriptor is closed.
        """
        # A value of 0 would disarm the timer. The clock counts from boot, so 1 ns is in the past.
        self._spec.value_s, self._spec.value_ns = divmod(max(at_ns, 1), 1_000_000_000)
        if _libc.timerfd_settime(self.fd, _TFD_TIMER_ABSTIME, self._spec_address, None):
            raise OSError(ctypes.get_errno(), os.strerror(ctypes.get_errno()))

    def close(self) -> None:
        """Close the descriptor."""
        os.close(self.fd)
