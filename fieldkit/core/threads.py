"""Concurrent calls, each in a separate thread, and a signal that ends their waits."""

from collections.abc import Callable, Collection
from threading import Event, Thread
from typing import TYPE_CHECKING, Final, TypeVar

from fieldkit.core.errors import FieldkitError

if TYPE_CHECKING:
    from concurrent.futures import Future

Item = TypeVar("Item")
T = TypeVar("T")

_INTERRUPT_WAIT_S: Final = 10.0  # time in which the threads can return after Ctrl-C
_POLL_INTERVAL_S: Final = 0.5  # longest time until Python handles Ctrl-C


class StopSignal:
    """Signal that ends the waits of concurrent work; it can have child signals."""

    def __init__(self) -> None:
        self._event = Event()
        self._children: list[StopSignal] = []

    @property
    def is_set(self) -> bool:
        """Whether the signal is set."""
        return self._event.is_set()

    def set(self) -> None:
        """Set the signal and its children, which ends all waits."""
        self._event.set()
        for child in self._children:
            child.set()

    def child(self) -> "StopSignal":
        """Return a child signal, which is set together with this one and can also be set alone."""
        child = StopSignal()
        self._children.append(child)
        if self.is_set:
            child.set()
        return child

    def wait(self, duration_s: float) -> bool:
        """Wait for a duration or until the signal is set; return True if it is set."""
        return self._event.wait(duration_s)


def run_parallel(
    call: Callable[[Item], T],
    items: Collection[Item],
    *,
    on_interrupt: Callable[[], None] | None = None,
    end_others: Callable[[], None] | None = None,
) -> list[T]:
    """Call `call` with each of `items` in a separate thread; return the results, or raise the first error.

    Args:
        call: The function.
        items: Its arguments, one per thread.
        on_interrupt: Ends the waits of the calls after Ctrl-C, for example by closing connections. The threads then
            have 10 s to return, so that they no longer write to files. Without this function, Ctrl-C does not wait
            for the threads.
        end_others: Ends the waits of all calls after one has failed. It is called repeatedly until all threads have
            returned. A `FieldkitError` of a call that is ended in this way is ignored. Any other exception is a bug
            in the code of a call, and is raised instead of the first error. Without this function, all calls run to
            their end.
    """
    from concurrent.futures import ALL_COMPLETED, FIRST_EXCEPTION, Future, wait  # noqa: PLC0415 (it imports logging, which takes 5 ms)

    # All futures exist before the first thread starts, so that Ctrl-C while a thread starts does not lose its future.
    futures: list[Future[T]] = [Future() for _ in items]
    failed_future: Future[T] | None = None
    try:
        for future, item in zip(futures, items, strict=True):
            Thread(target=_run_call, args=(future, call, item), daemon=True).start()
        # Python handles a Ctrl-C that arrived just before a blocking wait only when the wait returns.
        while wait(
            futures, _POLL_INTERVAL_S, ALL_COMPLETED if end_others is None or failed_future else FIRST_EXCEPTION
        ).not_done:
            if end_others is not None:
                failed_future = failed_future or next(
                    (future for future in futures if future.done() and future.exception()), None
                )
                if failed_future is not None:
                    end_others()
    except BaseException:
        if on_interrupt is not None:
            running = [future for future in futures if not future.cancel()]
            on_interrupt()
            wait(running, _INTERRUPT_WAIT_S)
        raise
    if failed_future is not None:
        failed_future = next((future for future in futures if is_bug(future.exception())), failed_future)
    return [future.result() for future in ([failed_future] if failed_future else futures)]


def is_bug(error: BaseException | None) -> bool:
    """Return True if an exception shows a bug in the code. Another error must not hide it."""
    return isinstance(error, Exception) and not isinstance(error, FieldkitError)


def _run_call(future: "Future[T]", call: Callable[[Item], T], item: Item) -> None:
    if not future.set_running_or_notify_cancel():
        return
    try:
        future.set_result(call(item))
    except BaseException as error:  # noqa: BLE001 (raised again by `Future.result`)
        future.set_exception(error)
