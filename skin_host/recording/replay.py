"""Processes a recording with the whole pipeline: deterministic, with the same bytes at every
run.
"""

from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path

from skin_host.bus.logs import read_channels
from skin_host.bus.wire import FrameBatch
from skin_host.config.settings import Settings, skin_hash
from skin_host.errors import LogError
from skin_host.layout import Layout
from skin_host.processing import calibration as calibrations
from skin_host.processing.calibration import Calibration
from skin_host.processing.core import Engine, Output, Step
from skin_host.recording.mcap import SUFFIX, read_can

#: A recording without a calibration file begins with this time of untouched skin.
UNTOUCHED_S = 5.0


def read_buses(log: Path, settings: Settings) -> Iterator[tuple[str, FrameBatch]]:
    """Yield batches of a recording with the name of the configured bus they belong to.

    With one bus in the configuration all frames belong to it, whatever the recording calls its
    channel. With several, channels go by name; others are ignored.

    Raises:
        LogError: see `logs.read_channels`; or several buses, and none of their channels in it.
    """
    channels = read_can(log) if log.suffix == SUFFIX else read_channels(log)
    if len(settings.buses) == 1:
        (only,) = settings.buses
        for _, batch in channels:
            yield only, batch
        return
    bus_of = {bus.channel: name for name, bus in settings.buses.items()}
    seen: set[str] = set()
    for channel, batch in channels:
        seen.add(channel)
        name = bus_of.get(channel)
        if name is not None:
            yield name, batch
    if not seen & set(bus_of):
        raise LogError(
            f"{log}: its channels are {', '.join(sorted(seen)) or 'unnamed'}; "
            f"the configuration's are {', '.join(bus_of)}"
        )


def calibration_for(
    log: Path, settings: Settings, layout: Layout, file: Path | None, seconds: float | None
) -> Calibration:
    """Return the calibration with which a recording is processed.

    Args:
        log: the recording.
        settings, layout: of its skin.
        file: a calibration file, or None.
        seconds: how much of the recording's beginning is untouched and gives the zero; if None, the
            file's zero is used, or without a file `UNTOUCHED_S`. With both, curves, gains and the
            foam's memory come from the file, as at the start of a daemon that calibrates.

    Raises:
        LogError: see `calibrate_from_log`.
        CalibrationError: the file is damaged, or of another skin.
    """
    known = None
    if file is not None:
        known = calibrations.load(file, layout, skin_hash(settings))
        if seconds is None:
            return known
    zero = calibrate_from_log(log, settings, layout, seconds or UNTOUCHED_S)
    return zero if known is None else calibrations.with_pressures_of(zero, known)


def calibrate_from_log(
    log: Path, settings: Settings, layout: Layout, seconds: float
) -> Calibration:
    """Calibrate on the first `seconds` of a recording.

    Raises:
        LogError: unreadable, or without a single sweep of this skin.
    """
    engine = Engine(settings, layout, list(range(len(layout.parts))))
    engine.begin_calibration(seconds)
    last_ns = 0
    for bus, batch in read_buses(log, settings):
        engine.feed(bus, batch)
        last_ns = int(batch.t_ns[-1])
        if engine.calibration_progress() >= 1.0:
            break
    else:
        engine.flush()
    counters = [assembler.counters for assembler in engine.assemblers.values()]
    if not sum(one.sweeps for one in counters):
        raise LogError(
            f"{log}: no sweep of this skin among its {sum(one.frames for one in counters)} frames "
            f"({sum(one.unknown_board for one in counters)} of other boards); wanted a recording "
            "made with this CONFIG, see `skin check CONFIG`"
        )
    # A recording's calibration carries the recording's time, so that replays stay equal.
    time = datetime.fromtimestamp(last_ns / 1e9, UTC).isoformat(timespec="seconds")
    return engine.end_calibration(time)


def replay(log: Path, engine: Engine) -> Iterator[Output]:
    """Yield the results of a recording, batch by batch.

    Raises:
        LogError: the recording cannot be read, or ends with damage.
    """
    for bus, batch in read_buses(log, engine.settings):
        yield engine.feed(bus, batch)
    yield engine.flush()


def steps(log: Path, engine: Engine) -> Iterator[Step]:
    """Yield the samples of parts in a recording, in their order.

    Raises:
        LogError: see `replay`.
    """
    for output in replay(log, engine):
        yield from output.steps
