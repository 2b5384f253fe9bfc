"""No room, no right to write, another time of day, no turn for seconds: told, and survived."""

import asyncio
import contextlib
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from emulator.probes.scene import Scene
from skin_host.bus.logs import read_channels
from skin_host.clock import Clock
from skin_host.config.settings import skin_hash
from skin_host.daemon.daemon import Daemon
from skin_host.daemon.state import NodeState, load_kept
from skin_host.errors import SkinError
from skin_host.processing.calibration import Calibration
from skin_host.processing.calibration.file import load_calibration
from skin_host.recording.capture import RESERVE_BYTES
from tests.support import scheduled_bus
from tests.support.broker import Mosquitto
from tests.support.programs import require
from tests.support.stack import wait_for
from tests.support.steady import MOST, believed, daemon_of, four_parts, until
from tests.support.subscriber import Subscriber

ROOT = Path(__file__).parents[3]
STOPPED_S = 3.0
#: What recordings leave to the daemon, and a little more.
SMALL_KIB = RESERVE_BYTES // 1024 + 256
QUIET = Scene(spread=False, quiet=True)
#: Faults of single pads that the emulated skin is born with.
OWN = {"taxel_noisy", "taxel_refused"}


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A file system of its own for the state directory."""
    folder = tmp_path / "state"
    folder.mkdir()
    mount = [require("mount"), "-t", "tmpfs", "-o", f"size={SMALL_KIB}k", "skin-test", str(folder)]
    done = subprocess.run(mount, check=False, capture_output=True, text=True)
    if done.returncode:
        pytest.skip(f"no mount here: {done.stderr.strip()}")
    yield folder
    subprocess.run([require("umount"), str(folder)], check=True)


def fill(folder: Path) -> Path:
    """Take all the room there is."""
    path = folder / "filler"
    with contextlib.suppress(OSError), path.open("wb", buffering=0) as file:
        while True:
            file.write(bytes(4096))
    return path


def remount(folder: Path, how: str) -> None:
    subprocess.run([require("mount"), "-o", f"remount,{how}", str(folder)], check=True)


async def sweeps_go_on(daemon: Daemon) -> None:
    def total() -> int:
        return sum(one.counters.sweeps for one in daemon.engine.assemblers.values())

    before = total()
    await until(lambda: total() > before + 20)


async def calibrated(daemon: Daemon) -> Calibration:
    """Another calibration; the first one may still be being kept."""
    while True:
        with contextlib.suppress(SkinError):
            return await daemon.calibrate(0.5)
        await asyncio.sleep(0.1)


def contents(state: Path) -> dict[Path, bytes]:
    """All files but those that the test, or a recording, has put there."""
    files = [path for path in state.iterdir() if path.is_file() and path.name != "filler"]
    return {path: path.read_bytes() for path in files}


async def refused_by_the_disk(
    daemon: Daemon, state: Path, caplog: pytest.LogCaptureFixture, why: str
) -> None:
    """Everything that is kept is changed once; what was kept before is as it was."""
    await until((state / "load-main.calibration.json").exists)
    await daemon.control.handle("thresholds", b'{"set":{"margin_units":3}}')
    kept = contents(state)
    assert len(kept) == 2
    if why == "Read-only file system":
        remount(state, "ro")
        filler = None
    else:
        filler = fill(state)
    answer = await daemon.control.handle("thresholds", b'{"set":{"margin_units":4}}')
    assert answer["kept"] is False
    assert answer["touch"]["margin_units"] == 4.0
    found = await calibrated(daemon)
    assert daemon.engine.calibration is found
    assert f"calibration not kept: {state}/load-main.calibration.json: {why}" in caplog.text
    assert f"state not kept: {state}/load-main.state.json: {why}" in caplog.text
    await sweeps_go_on(daemon)
    # Nothing is damaged, nothing half written lies about.
    assert contents(state) == kept
    load_calibration(
        state / "load-main.calibration.json", daemon.layout, skin_hash(daemon.settings)
    )
    assert load_kept(state / "load-main.state.json", NodeState).thresholds.margin_units == 3.0
    if filler is None:
        remount(state, "rw")
    else:
        filler.unlink()
    answer = await daemon.control.handle("thresholds", b'{"set":{"margin_units":5}}')
    assert answer["kept"] is True


async def test_a_full_disk_is_told_and_costs_nothing_but_what_it_cannot_hold(
    small_disk: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    async with daemon_of(four_parts(tmp_path), QUIET, state=small_disk) as daemon:
        await refused_by_the_disk(daemon, small_disk, caplog, "No space left on device")
        # A recording takes the room that it may, and what it holds can be replayed.
        await daemon.control.handle("record", b'{"file":"run.log","seconds":60}')
        recorder = daemon.control.recorder
        assert recorder is not None
        await until(lambda: recorder.ended)
        assert recorder.ended is not None
        assert recorder.ended.startswith("cannot write: less than 16 MiB of its disk are left")
        answer = await daemon.control.handle("stop_recording", b"{}")
        path = small_disk / "recordings" / "run.log"
        assert path.read_bytes().endswith(b"\n")
        assert sum(len(batch) for _, batch in read_channels(path)) == answer["frames"] > 100
        with pytest.raises(Exception, match="move recordings away"):
            await daemon.control.handle("record", b'{"file":"more.log"}')
        answer = await daemon.control.handle("thresholds", b'{"set":{"margin_units":6}}')
        assert answer["kept"] is True
        await sweeps_go_on(daemon)


async def test_a_read_only_state_directory_is_told_and_costs_nothing_else(
    small_disk: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    async with daemon_of(four_parts(tmp_path), QUIET, state=small_disk) as daemon:
        await refused_by_the_disk(daemon, small_disk, caplog, "Read-only file system")
        remount(small_disk, "ro")
        with pytest.raises(Exception, match="cannot be written: Read-only file system"):
            await daemon.control.handle("record", b"{}")
    # And from the start: it takes a calibration anew and goes on with it.
    (tmp_path / "again").mkdir()
    async with daemon_of(four_parts(tmp_path / "again"), QUIET, state=small_disk) as daemon:
        await until(lambda: all(map(believed, daemon.records().values())))
        await sweeps_go_on(daemon)


@pytest.mark.parametrize("step_s", [-3600.0, 3600.0])
async def test_a_clock_that_is_set_by_an_hour_costs_a_sweep_at_most_and_accuses_no_board(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, step_s: float
) -> None:
    """Injected: all clocks of the day in this process jump; the boards go on."""
    real = {"time": time.time, "time_ns": time.time_ns}
    step = 0.0
    monkeypatch.setattr(time, "time", lambda: real["time"]() + step)
    monkeypatch.setattr(time, "time_ns", lambda: real["time_ns"]() + int(step * 1e9))
    monkeypatch.setattr(Clock, "now_ns", staticmethod(time.time_ns))
    async with daemon_of(four_parts(tmp_path), QUIET) as daemon:
        await until(lambda: all(map(believed, daemon.records().values())))
        step = step_s
        seen: set[str] = set()
        shares: list[float] = []
        for _ in range(30):
            await asyncio.sleep(0.1)
            for record in daemon.records().values():
                seen |= {fault["code"] for fault in record["faults"]}
                shares.append(record["valid_taxels"] / record["taxels"])
        # A burst that was on its way when the clock was set is the only loss.
        # A computer that others share may stall by itself meanwhile.
        assert seen <= OWN | {"broker_away", "bus_loses_frames", "host_stalls"}
        assert min(shares) > MOST
        for one in daemon.engine.assemblers.values():
            assert one.counters.incomplete <= 2
        # A board that dies after it is told of all the same.
        channel = daemon.settings.buses["can3"].channel
        scheduled_bus.ScheduledBus.open_now[channel].unplugged = True
        await until(lambda: daemon.records()["part3"]["state"] == "silent")
        await until(
            lambda: (
                {"bus_silent"} <= {fault["code"] for fault in daemon.records()["part3"]["faults"]}
            )
        )


def test_a_daemon_that_is_stopped_for_seconds_accuses_nobody(
    mosquitto: Mosquitto, tmp_path: Path
) -> None:
    config = scheduled_bus.on_scheduled_buses(four_parts(tmp_path), QUIET, tmp_path)
    with config.open("a") as file:
        file.write(f"[mqtt]\nport = {mosquitto.port}\n")
        file.write(f'[service]\nstate_directory = "{tmp_path}"\n')
    subscriber = Subscriber(mosquitto.host, mosquitto.port, "skin/load/#")
    run = [sys.executable, "-m", "tests.support.scheduled_bus", "run", str(config)]
    daemon = subprocess.Popen(run, cwd=ROOT, env=os.environ | {"PYTHONPATH": str(ROOT)})
    try:

        def well() -> bool:
            last = {record["part"]: record for record in subscriber.documents("/health")}
            return len(last) == 4 and all(map(believed, last.values()))

        wait_for(well, "a robot that is well", lambda: subscriber.documents("/health")[-4:])
        known = len(subscriber.documents("/health"))
        frames = len(subscriber.payloads("part0/frame"))
        daemon.send_signal(signal.SIGSTOP)
        time.sleep(STOPPED_S)
        daemon.send_signal(signal.SIGCONT)
        wait_for(lambda: len(subscriber.documents("/health")) > known + 16, "four more seconds")
        records = subscriber.documents("/health")[known:]
        codes = {fault["code"] for record in records for fault in record["faults"]}
        # It reports its own stall, and holds that against nobody.
        assert "host_stalls" in codes
        assert codes <= OWN | {"host_stalls"}
        assert all(map(believed, records))
        assert {record["output"]["connections"] for record in records} == {1}
        for board in records[-1]["boards"]:
            assert (board["configurations"], board["silences"]) == (1, 0)
        # What waited in the kernel meanwhile was read: only its frames of pressure were skipped.
        assert records[-1]["buses"][0]["missed"] == 0
        assert len(subscriber.payloads("part0/frame")) > frames
    finally:
        daemon.terminate()
        daemon.wait()
        subscriber.close()
    assert daemon.returncode == 0
