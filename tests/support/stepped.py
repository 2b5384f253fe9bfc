"""Tests in stepped time: no second of a rule is waited for."""

from collections.abc import Callable, Coroutine
from functools import wraps
from inspect import signature
from typing import Any

from skin_host.clock import SteppedClock


def stepped(test: Callable[..., Coroutine[Any, Any, None]]) -> Callable[..., None]:
    """Run a test's coroutine by a stepped clock, which it takes as `clock`."""

    @wraps(test)
    def run(**arguments: Any) -> None:
        clock = SteppedClock()
        with clock.runner() as runner:
            runner.run(test(clock=clock, **arguments))

    shown = signature(test)
    others = [given for name, given in shown.parameters.items() if name != "clock"]
    run.__signature__ = shown.replace(parameters=others)  # type: ignore[attr-defined]
    return run
