"""Calls side by side, one thread each."""

from collections.abc import Callable, Collection
from threading import Event, Thread
from typing import TYPE_CHECKING, Final, TypeVar

if TYPE_CHECKING:
    from concurrent.futures import Future

Item = TypeVar("Item")
T = TypeVar("T")

_HUNG_UP_S: Final = 10.0
_WAKE_S: Final = 0.5


class Halt:
    """Ends the waits of what runs at the same time, where it is not to go on."""

    def __init__(self) -> None:
        self._event = Event()
        self._inner: list[Halt] = []

    @property
    def called(self) -> bool:
        """Whether nothing is to wait any more."""
        return self._event.is_set()

    def call(self) -> None:
        """End all waits, those of what runs inside too; there may be none."""
        self._event.set()
        for halt in self._inner:
            halt.call()

    def inside(self) -> "Halt":
        """Return one of what runs inside, which is called with this one, and may be called by itself."""
        inner = Halt()
        self._inner.append(inner)
        if self.called:
            inner.call()
        return inner

    def wait(self, duration_s: float) -> bool:
        """Wait for so long; return whether it was called, which ends the wait at once."""
        return self._event.wait(duration_s)


def together(
    call: Callable[[Item], T],
    items: Collection[Item],
    *,
    hang_up: Callable[[], None] | None = None,
    end_others: Callable[[], None] | None = None,
) -> list[T]:
    """Call `call` with each of `items` at once, one thread each; return the results, or raise the first error.

    Ctrl-C does not wait for the threads: who catches it ends what they wait for. With `hang_up`, which ends that, it
    does for a while, so that what they write is not touched before.

    With `end_others`, which ends what calls wait for, the first that fails ends all: it is called again until they
    have ended, and what they raise is its work. Without it each is waited for.
    """
    from concurrent.futures import ALL_COMPLETED, FIRST_EXCEPTION, Future, wait  # noqa: PLC0415 (logging, 5 ms)

    # Made before any thread is: Ctrl-C in the midst of starting one must not lose sight of it.
    futures: list[Future[T]] = [Future() for _ in items]
    failed: Future[T] | None = None
    try:
        for future, item in zip(futures, items, strict=True):
            Thread(target=_answer, args=(future, call, item), daemon=True).start()
        # Python sees a Ctrl-C that came just before it blocked only when it wakes.
        while wait(futures, _WAKE_S, ALL_COMPLETED if end_others is None or failed else FIRST_EXCEPTION).not_done:
            if end_others is not None:
                failed = failed or next((one for one in futures if one.done() and one.exception()), None)
                if failed is not None:
                    end_others()
    except BaseException:
        if hang_up is not None:
            running = [future for future in futures if not future.cancel()]
            hang_up()
            wait(running, _HUNG_UP_S)
        raise
    return [future.result() for future in ([failed] if failed else futures)]


def _answer(future: "Future[T]", call: Callable[[Item], T], item: Item) -> None:
    if not future.set_running_or_notify_cancel():
        return
    try:
        future.set_result(call(item))
    except BaseException as error:  # noqa: BLE001 (whoever asks for the result gets it)
        future.set_exception(error)
