"""Ctrl-C and SIGTERM: that they are not lost, and that a training ends where it can be resumed."""

from __future__ import annotations

import contextlib
import signal
import sys
import threading
from collections.abc import Iterator
from typing import Any


@contextlib.contextmanager
def interrupts_that_last() -> Iterator[None]:
    """A Ctrl-C that falls into a callback of the interpreter, of which JAX has one for garbage collection, is forgotten there: it is sent again."""
    hook, timers, main_thread = sys.unraisablehook, [], threading.main_thread().ident

    def send() -> None:
        if main_thread is not None and hasattr(signal, "pthread_kill"):
            signal.pthread_kill(main_thread, signal.SIGINT)  # unlike raise_signal, it wakes what waits
        else:
            signal.raise_signal(signal.SIGINT)

    def send_again(unraisable: Any) -> None:
        if not issubclass(unraisable.exc_type, KeyboardInterrupt):
            return hook(unraisable)
        timers.append(threading.Timer(0.1, send))
        timers[-1].daemon = True
        timers[-1].start()

    sys.unraisablehook = send_again
    try:
        yield
    finally:
        if sys.unraisablehook is send_again:  # else somebody who needs it longer has put another before it
            sys.unraisablehook = hook
        for timer in timers:
            timer.cancel()


class StopSignals:
    """Notes the first SIGINT (Ctrl-C) or SIGTERM, so that the run can end at a place where it can be resumed; the second one ends it at once."""

    def __init__(self) -> None:
        self.received: int | None = None
        self._before: dict[int, Any] = {}

    def note(self) -> None:
        """From now on; until then, signals do what they always do."""
        self._before = {number: signal.signal(number, self._receive) for number in (signal.SIGINT, signal.SIGTERM)}

    def _receive(self, number: int, frame: Any) -> None:
        self.received = number
        self._put_back()

    def _put_back(self) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def __enter__(self) -> StopSignals:
        return self

    def __exit__(self, *exception: Any) -> None:
        self._put_back()
