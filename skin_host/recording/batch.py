"""Processes recordings again: one to a file, or many in parallel, each independently.

Recordings do not depend on each other, so each is a task for a separate process: the processes of
this computer, or the workers of an existing Dask cluster (extra `cluster`). A task reads and writes
files; a cluster's workers must find them under the same absolute paths.
"""

import contextlib
import os
import signal
import tempfile
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import Any, BinaryIO

from skin_host.config.settings import load
from skin_host.errors import ConfigurationError, RequestError, SkinError
from skin_host.extras import required
from skin_host.fingertip.health import FingertipHealth
from skin_host.health import Health
from skin_host.layout import build_layout
from skin_host.processing.core import Engine
from skin_host.recording.lines import EventLines, frame_line, health_line
from skin_host.recording.replay import calibration_for, replay

#: A scheduler that does not answer within this time counts as absent.
SCHEDULER_S = 10.0


@dataclass(frozen=True, slots=True)
class Task:
    """One recording to be processed.

    Attributes:
        log: the recording.
        config: of its skin.
        output: file of JSON lines to write, completely or not at all.
        calibration, calibrate_seconds: see `replay.calibration_for`.
    """

    log: Path
    config: Path
    output: Path
    calibration: Path | None = None
    calibrate_seconds: float | None = None


def write_lines(
    log: Path, engine: Engine, output: BinaryIO, progress: Callable[[int], None] = lambda _: None
) -> int:
    """Write the results of a recording as JSON lines; return the number of frames of pressure.

    Args:
        log: the recording.
        engine: calibrated, and not fed yet.
        output: where to write.
        progress: called with the number so far.

    Raises:
        LogError: the recording cannot be read, or ends with damage.
    """
    health = Health(engine)
    lines = EventLines()
    number = 0
    for result in replay(log, engine):
        health.note(result)
        for step in result.steps:
            output.write(frame_line(step.frame))
            output.writelines(map(lines.line, step.events))
        output.writelines(map(lines.line, result.grasps))
        number += len(result.steps)
        progress(number)
    for part in engine.parts:
        output.write(health_line(health.replayed(part)))
    if engine.fingertips is not None:
        for record in FingertipHealth(engine.fingertips).records(None).values():
            output.write(health_line(record))
    return number


def process(task: Task, progress: Callable[[int], None] = lambda _: None) -> int:
    """Do one task; return the number of frames of pressure.

    Raises:
        LogError, CalibrationError, ConfigurationError: a file is wrong.
    """
    settings = load(task.config)
    try:
        layout = build_layout(settings, task.config.parent)
    except ConfigurationError as error:
        raise ConfigurationError(f"{task.config}: {error}") from None
    found = calibration_for(task.log, settings, layout, task.calibration, task.calibrate_seconds)
    engine = Engine(settings, layout, list(range(len(layout.parts))), found)
    with whole_file(task.output) as output:
        return write_lines(task.log, engine, output, progress)


def process_all(
    tasks: Sequence[Task], scheduler: str | None = None
) -> Iterator[tuple[Task, int | SkinError]]:
    """Do many tasks in parallel; yield each with its result when it ends.

    Args:
        tasks: with different outputs.
        scheduler: address of a Dask scheduler; without it, processes on all cores of this computer.

    Raises:
        RequestError: the scheduler cannot be used.
    """
    # The longest first, so that no long one is left at the end.
    ordered = sorted(tasks, key=_size, reverse=True)
    if scheduler is not None:
        yield from _on_cluster(ordered, scheduler)
        return
    processes = min(len(ordered), len(os.sched_getaffinity(0)))
    with ProcessPoolExecutor(processes, get_context("spawn"), _leave_interrupts) as pool:
        futures = {pool.submit(process, task): task for task in ordered}
        try:
            for future in as_completed(futures):
                yield futures[future], _result(future)
        finally:
            pool.shutdown(wait=False, cancel_futures=True)


@contextlib.contextmanager
def whole_file(path: Path) -> Iterator[BinaryIO]:
    """Yield a file that appears complete or not at all."""
    descriptor, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
    try:
        with os.fdopen(descriptor, "wb") as file:
            yield file
        os.chmod(temporary, 0o644)
        os.replace(temporary, path)
    except BaseException:
        os.unlink(temporary)
        raise


def _size(task: Task) -> int:
    try:
        return task.log.stat().st_size
    except OSError:
        return 0


def _result(future: "Future[int] | Any") -> int | SkinError:
    """Return the result of a task; unexpected errors are raised."""
    try:
        number: int = future.result()
    except SkinError as error:
        return error
    return number


def _leave_interrupts() -> None:
    """Ignore Ctrl-C, which the parent process handles."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def _on_cluster(tasks: list[Task], scheduler: str) -> Iterator[tuple[Task, int | SkinError]]:
    distributed = required("distributed", "clusters", "cluster")
    try:
        client = distributed.Client(scheduler, timeout=SCHEDULER_S, set_as_default=False)
    except (OSError, TimeoutError, ValueError) as error:
        raise RequestError(f"--scheduler {scheduler}: no scheduler answers: {error}") from None
    with client:
        # Not pure: a task is done again, because its files may have changed.
        futures = dict(zip(client.map(process, tasks, pure=False), tasks, strict=True))
        for future in distributed.as_completed(futures, loop=client.loop):
            yield futures[future], _result(future)
