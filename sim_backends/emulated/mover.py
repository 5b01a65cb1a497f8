"""Does something again and again while robots move, in a thread of its own, until it is left."""

import threading
from collections.abc import Callable
from types import TracebackType
from typing import Self


class Mover:
    """Tells of a motion, step by step; use as a context manager, whose end is the end of the thread.

    Args:
        step: Tells where robots are now; returns after how many seconds to call it again, None when they stand.

    Raises:
        FieldkitError: `step` did; raised when the context is left, unless its body raised.
    """

    def __init__(self, step: Callable[[], float | None]) -> None:
        self._step = step
        self._left = threading.Event()
        self._error: BaseException | None = None
        self._thread = threading.Thread(target=self._run, name="mover", daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._left.set()
        self._thread.join()
        if self._error is not None and error is None:
            raise self._error

    def _run(self) -> None:
        try:
            while (wait_s := self._step()) is not None and not self._left.wait(wait_s):
                continue
        except BaseException as error:  # noqa: BLE001 (whoever leaves the context gets it)
            self._error = error
