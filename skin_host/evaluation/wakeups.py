"""What wakes a program's event loop, and how often."""

import asyncio
import selectors
from collections import Counter
from typing import Any

#: Causes by the beginning of the module whose function is called; the first that fits counts.
_CAUSES = {
    "skin_host.bus": "plan",
    "skin_host.clock": "plan",
    "skin_host.mqtt": "mqtt",
    "aiomqtt": "mqtt",
    "asyncio": "thread",
}
#: A timer of the loop itself.
TIMER = "timer"


class Wakeups(selectors.DefaultSelector):
    """A selector that counts how often its loop slept, by what ended the sleep.

    Attributes:
        counts: sleeps by cause. Turns of the loop between which it did not sleep are not counted.
    """

    def __init__(self) -> None:
        super().__init__()
        self.counts: Counter[str] = Counter()

    def select(self, timeout: float | None = None) -> list[tuple[selectors.SelectorKey, int]]:
        found = super().select(timeout)
        if timeout != 0:
            self.counts[_cause(found[0][0].data) if found else TIMER] += 1
        return found

    def runner(self) -> asyncio.Runner:
        """Runs coroutines in a loop with this selector."""
        return asyncio.Runner(loop_factory=lambda: asyncio.SelectorEventLoop(self))


def _cause(handles: Any) -> str:
    callback = next(handle for handle in handles if handle is not None)._callback
    module = getattr(callback, "__module__", None) or type(callback).__module__
    return next((cause for start, cause in _CAUSES.items() if module.startswith(start)), module)
