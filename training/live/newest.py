"""One worker that draws the newest state: events that come while it draws are one event when it has drawn."""

from __future__ import annotations

import threading
from collections.abc import Callable


class Newest:
    """Calls `work` in a thread of its own, once for any number of `wake` since it last began.

    Dragging can then never queue up: what is drawn is at most one drawing late.

    Args:
        work: what is called, always in the same thread.
        every: also called so often [s] where nothing woke it; None: never.

    Attributes:
        fault: what `work` raised, which ended the worker; None: nothing yet.

    Example:
        >>> seen, drawn = [], threading.Event()
        >>> newest = Newest(lambda: (seen.append(1), drawn.set()))
        >>> newest.wake()
        >>> drawn.wait(5)
        True
        >>> newest.close()
    """

    def __init__(self, work: Callable[[], object], every: float | None = None) -> None:
        self._work, self._every = work, every
        self._asked, self._open = False, True
        self._change = threading.Condition()
        self.fault: BaseException | None = None
        self._thread = threading.Thread(target=self._run, name="grasp-live", daemon=True)
        self._thread.start()

    def wake(self) -> None:
        """Something changed."""
        with self._change:
            self._asked = True
            self._change.notify_all()

    def close(self) -> None:
        """Ends the thread after the drawing that it is at."""
        with self._change:
            self._open = False
            self._change.notify_all()
        self._thread.join(timeout=10.0)

    def wait(self, seconds: float | None) -> bool:
        """Waits until the worker ends by a fault, or for so long; whether it goes on."""
        self._thread.join(timeout=seconds)
        return self._thread.is_alive()

    def _run(self) -> None:
        try:
            while True:
                with self._change:
                    self._change.wait_for(lambda: self._asked or not self._open, timeout=self._every)
                    if not self._open:
                        return
                    self._asked = False
                self._work()
        except BaseException as error:  # told by whoever waits
            self.fault = error
