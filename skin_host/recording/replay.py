"""Processes recordings with the whole pipeline, deterministically: the same bytes at every run.

The lines of `skin replay` are published messages, one JSON object per line with its type. Many
recordings do not depend on each other, so each is a task for a separate process: the processes of
this computer, or the workers of an existing Dask cluster (extra `cluster`). A task reads and writes
files; a cluster's workers must find them under the same absolute paths.
"""

import sys
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

import numpy as np

from skin_host.bus.logs import (
    MOST_CHANNELS,
    WINDOW_NS,
    channel_names,
    name_in,
    read_channels,
)
from skin_host.bus.wire import FrameBatch, in_slices
from skin_host.config.settings import Settings, skin_hash
from skin_host.errors import LogError, RequestError, SkinError, required, some_of
from skin_host.files import whole_file
from skin_host.health import HealthWatch
from skin_host.health.diagnosis import named_by_part
from skin_host.layout import Layout, PadKind, load_skin
from skin_host.mqtt.contact import PartContact, use_measurements
from skin_host.processing import calibration as calibrations
from skin_host.processing.calibration import Calibration, Verdict, by_part
from skin_host.processing.calibration.calibrator import (
    KNOWN_SAMPLES,
    NOISE_SAMPLES,
    PRESSED_UNITS,
)
from skin_host.processing.calibration.file import load_calibration
from skin_host.processing.core import Engine, Output, Step
from skin_host.processing.masks import Mask
from skin_host.processing.touch import levels
from skin_host.recording import is_mcap
from skin_host.recording.lines import LineWriter, health_line
from skin_host.recording.turns import fed

if TYPE_CHECKING:
    from concurrent.futures import Future

#: A recording without a calibration file begins with this time of untouched skin.
UNTOUCHED_S = 5.0
#: A file's zero is another than a recording's where this share of a part's taxels begins touched by
#: it, or as far below. Single ones may be touched.
OTHER_ZERO_SHARE = 0.25
#: A scheduler that does not answer within this time counts as absent.
SCHEDULER_S = 10.0
#: The frames of an only bus are in the recording's order, however long its batches are.
LONG_WINDOW_NS = 200_000_000


def read_buses(
    log: Path, settings: Settings, window_ns: int = WINDOW_NS
) -> Iterator[tuple[str, FrameBatch]]:
    """Yield batches of a recording with the name of the configured bus they belong to.

    Channels go by name, or by the number that the format has in its place; others are ignored: the
    boards of two buses have the same addresses. With one bus in the configuration, the only channel
    of a recording is that bus, whatever it is called.

    A batch spans `window_ns` at most, but for damaged time stamps.

    Raises:
        LogError: see `logs.read_channels`; or none of its channels is that of a bus.
    """
    only = _only_channel(log, settings) if len(settings.buses) == 1 else None
    if is_mcap(log):
        from skin_host.recording.mcap import read_can

        recorded = ((name, batch) for name, batch in read_can(log) if only in (None, name))
        channels = _in_windows(recorded, window_ns)
    else:
        channels = read_channels(log, window_ns, only)
    if only is not None:
        (bus,) = settings.buses
        yield from ((bus, batch) for _, batch in channels)
        return
    called = {name: name_in(log, bus.channel) for name, bus in settings.buses.items()}
    names = Counter(called.values())
    bus_of = {channel: name for name, channel in called.items() if names[channel] == 1}
    bus_of |= {bus.channel: name for name, bus in settings.buses.items()}
    seen: set[str] = set()
    for channel, batch in channels:
        seen.add(channel)
        name = bus_of.get(channel)
        if name is not None:
            yield name, batch
    if not seen & set(bus_of):
        raise _other_channels(log, seen, settings)


def _only_channel(log: Path, settings: Settings) -> str | None:
    """Return what a recording calls the channel of the only bus; None if it has no frames.

    Raises:
        LogError: it has several channels, and none of this name; see `logs.channel_names`.
    """
    (bus,) = settings.buses.values()
    wanted = {bus.channel, name_in(log, bus.channel)}
    seen: set[str] = set()
    for name in _names(log):
        if name in wanted:
            return name
        seen.add(name)
    if len(seen) >= MOST_CHANNELS:
        return None  # no recording has so many: reading it reports the damage
    if len(seen) > 1:
        raise _other_channels(log, seen, settings)
    return next(iter(seen), None)


def _names(log: Path) -> Iterator[str]:
    """Yield the channels of a recording when their frames come, until it ends or is damaged."""
    if not is_mcap(log):
        yield from channel_names(log)
        return
    from skin_host.recording.mcap import read_can

    with suppress(LogError):
        yield from (name for name, _ in read_can(log))


def _other_channels(log: Path, seen: set[str], settings: Settings) -> LogError:
    """Return the error of a recording without the channel of any bus."""
    return LogError(
        f"{log}: its channels are {some_of(sorted(seen)) or 'unnamed'}; "
        f"the configuration's are {', '.join(bus.channel for bus in settings.buses.values())}"
    )


def _in_windows(
    channels: Iterator[tuple[str, FrameBatch]], window_ns: int
) -> Iterator[tuple[str, FrameBatch]]:
    """Cut batches that are longer than a window, as a recorder has them that was held up; those of
    other channels that follow cover the same time.

    Raises:
        LogError: the recording ends with damage; everything before it has then been yielded.
    """
    group: dict[str, FrameBatch] = {}
    begin_ns = end_ns = 0
    damage: LogError | None = None
    try:
        for channel, batch in channels:
            if not len(batch):
                continue
            first_ns, last_ns = int(batch.t_ns.min()), int(batch.t_ns.max())
            is_apart = first_ns > end_ns + window_ns or last_ns < begin_ns - window_ns
            if group and (channel in group or is_apart):
                yield from in_slices(list(group.items()), window_ns, alone=True)
                group.clear()
            begin_ns = min(begin_ns, first_ns) if group else first_ns
            end_ns = max(end_ns, last_ns) if group else last_ns
            group[channel] = batch
    except LogError as error:
        damage = error
    yield from in_slices(list(group.items()), window_ns, alone=True)
    if damage is not None:
        raise damage


def calibration_for(
    log: Path,
    settings: Settings,
    layout: Layout,
    file: Path | None,
    seconds: float | None,
    warn: Callable[[str], None] = lambda _: None,
) -> Calibration:
    """Return the calibration with which a recording is processed.

    The recording's first `seconds` are untouched and give the zero; if None, the file's zero is
    used, or without a file `UNTOUCHED_S`. With both, curves, gains and the foam's memory come from
    the file, as at the start of a daemon that calibrates.

    `warn` is called with a sentence where zeros of file and recording show that one of them is not
    that of this untouched skin.

    Raises:
        LogError: see `calibrate_from_log`.
        CalibrationError: the file is damaged, or of another skin.
    """
    known = None
    if file is not None:
        known = load_calibration(file, layout, skin_hash(settings))
        if seconds is None:
            # A recording without a sweep in its first seconds shows nothing of its zero.
            with suppress(LogError):
                seen = calibrate_from_log(log, settings, layout, UNTOUCHED_S)
                for doubt in _other_zero(known, seen, settings, layout, file):
                    warn(doubt)
            return known
    zero = calibrate_from_log(log, settings, layout, seconds or UNTOUCHED_S)
    if known is None or file is None:
        return zero
    for doubt in _pressed_zero(known, zero, layout, file):
        warn(doubt)
    return calibrations.with_pressures_of(zero, known)


def _other_zero(
    known: Calibration, seen: Calibration, settings: Settings, layout: Layout, file: Path
) -> list[str]:
    """Return of which parts a file's zero is hardly that of a recording, a sentence each."""
    above = known.percentile - known.baseline
    enter = levels(above, known.spread, settings.processing.touch).enter
    found = []
    for name, both in _used_in_both(known, seen, layout):
        off = both & (np.abs(seen.baseline - known.baseline) > enter)
        number, of = np.count_nonzero(off), np.count_nonzero(both)
        if number >= OTHER_ZERO_SHARE * of:
            found.append(
                f"by the zero of {file}, {number} of {of} taxels of {name} begin touched, or as "
                "far below their zero: something presses them, or their boards were zeroed after "
                f"it was taken; --calibrate-seconds {UNTOUCHED_S:g} takes the recording's own"
            )
    return found


def _pressed_zero(known: Calibration, zero: Calibration, layout: Layout, file: Path) -> list[str]:
    """Return which parts are pressed by the zero of a file while one is taken, a sentence each."""
    found = []
    for name, both in _used_in_both(known, zero, layout):
        nearer = float(np.median((zero.baseline - known.baseline)[both]))
        if nearer > PRESSED_UNITS:
            found.append(
                f"its first seconds, of which the zero is taken, are {nearer:.0f} units nearer to "
                f"pressure on {name} than the zero of {file}: pressures will read too little if "
                "something pressed it then; without --calibrate-seconds the file's zero is used"
            )
    return found


def _used_in_both(
    one: Calibration, other: Calibration, layout: Layout
) -> Iterator[tuple[str, Mask]]:
    """Yield the parts with their taxels [n] that are usable by two calibrations, if any are."""
    usable = one.usable & other.usable & (layout.pad_kind == PadKind.PRESSURE)
    for part in layout.parts:
        both = np.zeros_like(usable)
        both[part.start : part.stop] = usable[part.start : part.stop]
        if both.any():
            yield part.name, both


def calibrate_from_log(
    log: Path, settings: Settings, layout: Layout, seconds: float
) -> Calibration:
    """Calibrate on the first `seconds` of a recording, longer only if too little is known from
    these.

    Raises:
        LogError: unreadable, without a single sweep of this skin, or of boards that send at so
            different a period than configured that nothing of them counts.
    """
    found = _calibrated(log, settings, layout, seconds, NOISE_SAMPLES)
    if np.any(found.verdict == Verdict.TOO_FEW):
        # Frames of slow boards were lost, or the recording begins in the middle of a sweep.
        found = _calibrated(log, settings, layout, seconds, KNOWN_SAMPLES)
    return found


def _calibrated(
    log: Path, settings: Settings, layout: Layout, seconds: float, fewest: int
) -> Calibration:
    """Calibrate on the first `seconds` of a recording, and `fewest` sweeps of each board.

    Raises:
        LogError: see `calibrate_from_log`.
    """
    engine = Engine(settings, layout, list(range(len(layout.parts))))
    engine.begin_calibration(seconds, fewest)
    last_ns = 0
    for output in replay(log, engine):
        last_ns = output.sweeps[-1].t_ns if output.sweeps else last_ns
        if engine.calibration_progress() >= 1.0:
            break
    counters = [assembler.counters for assembler in engine.assemblers.values()]
    if not sum(one.sweeps for one in counters):
        raise LogError(
            f"{log}: no sweep of this skin among its {sum(one.frames for one in counters)} frames "
            f"({sum(one.unknown_board for one in counters)} of other boards); wanted a recording "
            "made with this CONFIG, see `skin check CONFIG`"
        )
    if not engine.calibration_progress() and (mistimed := mistimed_boards(engine)):
        raise LogError(f"{log}: {mistimed}")
    # A recording's calibration carries the recording's time, so that replays stay equal.
    time = datetime.fromtimestamp(last_ns / 1e9, UTC).isoformat(timespec="seconds")
    return engine.end_calibration(time)


def mistimed_boards(engine: Engine) -> str:
    """Return in words of which boards of a recording little counts because they send at another
    period than configured: regularly so slowly that each sweep ends a silence, or so fast that
    their frames seem to be those of two boards at one address. Empty: of none.

    The engine has processed it: until then nothing is known of its boards.
    """
    slow, fast = [], []
    for board in engine.boards:
        row = engine.ledger.row[board]
        seen_ns = engine.ledger.regular_period_ns(row) or 0.0
        own = engine.layout.boards[board]
        configured = f"configured: {own.settings.period_ms:g} ms"
        if seen_ns > engine.ledger.silent_after_ns[row]:
            slow.append(f"{own.name} sends every {seen_ns / 1e6:.0f} ms ({configured})")
        elif row in engine.ledger.twice:
            fast.append(f"{own.name} ({configured})")
    found = []
    if slow:
        found.append(
            f"{', '.join(slow)}: so slow that each sweep comes after a silence, and little or "
            "nothing of it counts"
        )
    if fast:
        found.append(
            f"{', '.join(fast)}: at the end frames came as often as of two boards at one address, "
            "and nothing of such frames counts"
        )
    if not found:
        return ""
    return "; ".join([*found, "wanted boards.NAME.period_ms as in the recording"])


def doubts(calibration: Calibration, settings: Settings, layout: Layout) -> list[str]:
    """Return what is in doubt of the zeros with which a recording is processed, a sentence each."""
    found = []
    for name, fingertip in settings.fingertips.items():
        zero = calibration.zeros.get(name)
        if fingertip.full_scale is None and (zero is None or zero.full_scale is None):
            found.append(
                f"the full scales of {name} are unknown, so its samples are left out until the "
                "recording has its board's answers to a query, and a zero; wanted "
                f"fingertips.{name}.full_scale, or the calibration file of its daemon"
            )
    if touched := by_part(calibration.verdict == Verdict.TOUCHED, layout):
        state = (
            "was touched while its zero was taken, and reads"
            if _is_one(touched)
            else "were touched while their zero was taken, and read"
        )
        found.append(
            f"{named_by_part(touched)} {state} too little; wanted some seconds of untouched skin, "
            "or a calibration file that has them"
        )
    refused = ~calibration.usable
    if without := by_part(refused, layout):
        reasons = {
            Verdict(number).name.lower().replace("_", " ")
            if number >= Verdict.STUCK
            else "no usable curve"
            for number in np.unique(calibration.verdict[refused])
        }
        have, are = ("has", "is") if _is_one(without) else ("have", "are")
        found.append(
            f"{named_by_part(without)} {have} no zero ({', '.join(sorted(reasons))}) and {are} not "
            "valid"
        )
    found += _foreign_curves(calibration, layout)
    return found


def _foreign_curves(calibration: Calibration, layout: Layout) -> list[str]:
    """Return of which parts most pads were not in the recording of their curves, a sentence each.

    So it is with curves of another skin of this configuration, in which other pads work.
    """
    if calibration.curves is None:
        return []
    own = calibration.curves.own
    found = []
    for name, used in _used_in_both(calibration, calibration, layout):
        without, of = np.count_nonzero(used & ~own & ~calibration.gained), np.count_nonzero(used)
        if (used & own).any() and 2 * without > of:
            found.append(
                f"{without} of {of} usable taxels of {name} have no curve of their own, as their "
                "readings were not in the recording under known pressure: is the calibration that "
                "of this skin? wanted a recording under known pressure with these taxels"
            )
    return found


def _is_one(taxels: Mapping[str, Sequence[int]]) -> bool:
    """Whether a single taxel is named, by part."""
    return sum(map(len, taxels.values())) == 1


def contacts_of(engine: Engine) -> dict[int, PartContact]:
    """Return the contact states of the parts of a calibrated engine, by index, as a daemon starts.

    They wait only for taxels that can be valid.
    """
    contacts = {part: PartContact(engine.layout, part) for part in engine.parts}
    use_measurements(contacts, engine)
    return contacts


def replay(log: Path, engine: Engine) -> Iterator[Output]:
    """Yield the results of a recording, sweep by sweep or batch by batch.

    Raises:
        LogError: the recording cannot be read, or ends with damage.
    """
    for _, output in timed(log, engine, LONG_WINDOW_NS):
        yield output


def timed(log: Path, engine: Engine, window_ns: int = WINDOW_NS) -> Iterator[tuple[int, Output]]:
    """Yield the results of a recording as a daemon's, each with the time at which it has it.

    Args:
        log: the recording.
        engine: processes it, and has been fed nothing yet.
        window_ns: read so much of a skin on one bus, without fingertips, at a time.

    Raises:
        LogError: the recording cannot be read, or ends with damage.
    """
    is_alone = len(engine.settings.buses) == 1
    if not is_alone or engine.fingertips is not None:
        window_ns = WINDOW_NS
    if engine.fingertips is not None:
        engine.fingertips.assume_scales()
    batches = read_buses(log, engine.settings, window_ns)
    # The frames of one bus come in their order, those of several bus by bus in each window.
    yield from fed(batches, engine, 0 if is_alone else WINDOW_NS)


def steps(log: Path, engine: Engine) -> Iterator[Step]:
    """Yield the samples of parts in a recording, in their order, without the reports of silence.

    Raises:
        LogError: see `replay`.
    """
    for output in replay(log, engine):
        for step in output.steps:
            if step.frame.raw.any():
                yield step


@dataclass(frozen=True, slots=True)
class Task:
    """One recording to be processed.

    Attributes:
        log: the recording.
        config: of its skin.
        output: file of JSON lines to write, completely or not at all; None is standard output.
        calibration, calibrate_seconds: see `replay.calibration_for`.
    """

    log: Path
    config: Path
    output: Path | None
    calibration: Path | None = None
    calibrate_seconds: float | None = None


def write_lines(
    log: Path, engine: Engine, output: BinaryIO, progress: Callable[[int], None] = lambda _: None
) -> int:
    """Write the results of a recording as JSON lines; return the number of frames of pressure.

    The engine is calibrated, and not fed yet; `progress` is called with the number so far.

    Raises:
        LogError: the recording cannot be read, or ends with damage.
    """
    health = HealthWatch(engine)
    lines = LineWriter(output)
    number = 0
    try:
        for result in replay(log, engine):
            health.note(result)
            lines.write(result)
            number += len(result.steps)
            progress(number)
    finally:
        lines.flush()
    for part in engine.parts:
        output.write(health_line(health.replayed(part)))
    if engine.fingertips is not None:
        from skin_host.fingertip.health import FingertipHealth

        for record in FingertipHealth(engine.fingertips).records(None).values():
            output.write(health_line(record))
    return number


def process(
    task: Task,
    progress: Callable[[int], None] = lambda _: None,
    warn: Callable[[str], None] = lambda _: None,
) -> int:
    """Do one task; return the number of frames of pressure.

    `warn` is called with each of the `doubts` before anything is written, and afterwards with the
    boards of which little or nothing counted because they send much more slowly than configured.

    Raises:
        LogError, CalibrationError, ConfigurationError: a file is wrong.
    """
    settings, layout = load_skin(task.config)
    found = calibration_for(
        task.log, settings, layout, task.calibration, task.calibrate_seconds, warn
    )
    for doubt in doubts(found, settings, layout):
        warn(doubt)
    engine = Engine(settings, layout, list(range(len(layout.parts))), found)
    if task.output is None:
        number = write_lines(task.log, engine, sys.stdout.buffer, progress)
    else:
        with whole_file(task.output) as growing, growing.open("wb") as output:
            number = write_lines(task.log, engine, output, progress)
    if mistimed := mistimed_boards(engine):
        warn(mistimed)
    return number


def process_all(
    tasks: Sequence[Task], scheduler: str | None = None
) -> Iterator[tuple[Task, list[str] | SkinError]]:
    """Do many tasks in parallel; yield each when it ends, with its `doubts` or what was wrong.

    The tasks have different outputs. Without the address of a Dask scheduler they are done by
    processes on all cores of this computer.

    Raises:
        RequestError: the scheduler cannot be used.
    """
    # The longest first, so that no long one is left at the end.
    ordered = sorted(tasks, key=_size, reverse=True)
    if scheduler is not None:
        yield from _on_cluster(ordered, scheduler)
        return
    from concurrent.futures import as_completed

    from skin_host.processes import Processes

    with Processes(len(ordered)) as processes:
        futures = {processes.submit(_process, task): task for task in ordered}
        for future in as_completed(futures):
            yield futures[future], _result(future)


def _process(task: Task) -> list[str]:
    doubted: list[str] = []
    process(task, warn=doubted.append)
    return doubted


def _size(task: Task) -> int:
    try:
        return task.log.stat().st_size
    except OSError:
        return 0


def _result(future: "Future[list[str]] | Any") -> list[str] | SkinError:
    """Return the result of a task; unexpected errors are raised."""
    try:
        doubted: list[str] = future.result()
    except SkinError as error:
        return error
    return doubted


def _on_cluster(tasks: list[Task], scheduler: str) -> Iterator[tuple[Task, list[str] | SkinError]]:
    distributed = required("distributed", "clusters", "cluster")
    try:
        client = distributed.Client(scheduler, timeout=SCHEDULER_S, set_as_default=False)
    except (OSError, TimeoutError, ValueError) as error:
        raise RequestError(f"--scheduler {scheduler}: no scheduler answers: {error}") from None
    with client:
        # Not pure: a task is done again, because its files may have changed.
        futures = dict(zip(client.map(_process, tasks, pure=False), tasks, strict=True))
        for future in distributed.as_completed(futures, loop=client.loop):
            yield futures[future], _result(future)
