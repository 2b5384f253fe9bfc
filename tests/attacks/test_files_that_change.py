"""Files that change under their reader, and folders that vanish under their writer: nothing is half
used, nothing is lost silently, and each ends in one line.
"""

import asyncio
import errno
import json
import os
import shutil
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from skin_host import files
from skin_host.bus.wire import FrameBatch
from skin_host.cli import main
from skin_host.clock import SteppedClock
from skin_host.config.settings import Bus, changed, load
from skin_host.daemon.calibrate import calibration_path, stored_calibration
from skin_host.daemon.state import NodeState, load_kept
from skin_host.demo import configuration
from skin_host.errors import BusyFileError, NewerFileError, SkinError
from skin_host.files import read_whole, write_atomic
from skin_host.layout import build_layout
from skin_host.mqtt.address import Broker
from skin_host.mqtt.commands import MAX_RUNNING, CommandHandler, Result, decode_result
from skin_host.processing import calibration as calibrations
from skin_host.processing.calibration.file import (
    find_calibration,
    load_calibration,
    save_calibration,
)
from skin_host.recording.capture import CanLog, FrameRecorder, PageRecording
from skin_host.recording.mcap import Recorder
from tests.support.fault_bench import FaultBench
from tests.support.live import CONFIG, living
from tests.support.stepped import stepped
from tests.support.waiting import until

#: Up to here the demo's configuration is TOML.
HALF = "[[parts.left_forearm.patches]]"
FRAMES = FrameBatch.of([(0x4E0, bytes(8), 1_700_000_000_000_000_000)])
DEMO = configuration("demo.toml")


def test_a_configuration_that_is_being_written_is_refused_in_a_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Half of it may be a whole one of a smaller robot. The status lets systemd try again."""
    path = tmp_path / "robot.toml"
    whole = DEMO.read_text()
    with path.open("w") as copy:
        copy.write(whole[: whole.index(HALF)])
        copy.flush()
        assert main(["check", str(path)]) == 1
        (line,) = capsys.readouterr().err.splitlines()
        assert line == (
            f"skin check: {path}: another program is writing it; repeat this when it has ended"
        )
        copy.write(whole[whole.index(HALF) :])
    assert main(["check", str(path)]) == 0


def test_what_changes_while_it_is_read_is_refused_even_where_its_writer_is_not_known(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The system names writers only to a file's owner."""
    path = tmp_path / "robot.toml"
    path.write_text("robot = 'a'\n")
    seen = os.fstat

    def fstat(descriptor: int) -> os.stat_result:
        monkeypatch.setattr(os, "fstat", seen)
        status = os.fstat(descriptor)
        time.sleep(0.02)  # the stamp of a change has the resolution of the system's timer
        path.write_text("robot = 'b'\n")
        return status

    monkeypatch.setattr(files, "_refuse_busy", lambda *_: None)
    monkeypatch.setattr(os, "fstat", fstat)
    with pytest.raises(BusyFileError, match="another program is writing it"):
        read_whole(path)
    assert read_whole(path) == b"robot = 'b'\n"


def test_a_file_that_is_replaced_while_it_is_read_is_the_old_one_or_the_new_one(
    tmp_path: Path,
) -> None:
    path = tmp_path / "x.json"
    write_atomic(path, b"old" * 1000)
    with path.open("rb"):
        write_atomic(path, b"new" * 1000)
        assert read_whole(path) == b"new" * 1000


def test_a_calibration_that_another_program_is_writing_is_neither_used_nor_set_aside(
    calibrated: FaultBench, tmp_path: Path
) -> None:
    settings = changed(load(CONFIG), {"service.state_directory": str(tmp_path)})
    layout = build_layout(settings, CONFIG.parent)
    path = calibration_path(settings, "main")
    assert calibrated.engine.calibration is not None
    save_calibration(path, calibrated.engine.calibration, layout)
    whole = path.read_bytes()
    with path.open("wb") as copy:
        copy.write(whole[: len(whole) // 2])
        copy.flush()
        with pytest.raises(BusyFileError, match=r"calibration\.json: another program is writing"):
            stored_calibration(settings, layout, "main")
        with pytest.raises(BusyFileError):
            find_calibration(path, layout, calibrated.engine.calibration.configuration)
        copy.write(whole[len(whole) // 2 :])
    assert [one.name for one in tmp_path.iterdir()] == [path.name]
    assert stored_calibration(settings, layout, "main") is not None


def test_a_state_that_another_program_is_writing_is_not_set_aside(tmp_path: Path) -> None:
    path = tmp_path / "demo-main.state.json"
    with path.open("w") as copy:
        copy.write('{"schema": "skin.state/1", "disabled": ["left_')
        copy.flush()
        with pytest.raises(BusyFileError):
            load_kept(path, NodeState)
        copy.write('hand"]}')
    assert load_kept(path, NodeState).disabled == ["left_hand"]


@stepped
async def test_a_reload_of_half_a_configuration_changes_nothing(
    clock: SteppedClock, can_bus_settings: Bus, tmp_path: Path
) -> None:
    path = tmp_path / "demo.toml"
    whole = DEMO.read_text() + "\n[processing.touch]\nmargin_units = 3.0\n"
    async with living(can_bus_settings, tmp_path, clock=clock) as live:
        daemon = live.daemon
        daemon._configuration = path
        before = daemon.settings
        with path.open("w") as copy:
            copy.write(DEMO.read_text())
            copy.flush()
            with pytest.raises(BusyFileError, match=r"demo\.toml: another program is writing it"):
                await daemon.control.handle("reload", b"{}")
        for half in ("", whole[: len(whole) // 2], whole[: whole.index(HALF)]):
            path.write_text(half)
            with pytest.raises(SkinError) as refused:
                await daemon.control.handle("reload", b"{}")
            assert str(refused.value).startswith(f"{path}: ")
            assert "\n" not in str(refused.value)
        path.unlink()
        with pytest.raises(SkinError, match=r"demo\.toml: cannot be read: No such file"):
            await daemon.control.handle("reload", b"{}")
        assert daemon.settings is before


@pytest.mark.timeout(60)
@stepped
async def test_a_reload_of_a_configuration_that_became_a_silent_pipe_ends(
    clock: SteppedClock, can_bus_settings: Bus, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It never ended, and eight of them blocked all commands."""
    monkeypatch.setattr(files, "PATIENCE_S", 0.2)
    path = tmp_path / "demo.toml"
    os.mkfifo(path)
    writer = os.open(path, os.O_RDWR)
    async with living(can_bus_settings, tmp_path / "state", clock=clock) as live:
        daemon = live.daemon
        daemon._configuration = path
        before = daemon.settings
        with pytest.raises(SkinError, match=r"demo\.toml: cannot be read: it did not end within"):
            await daemon.control.handle("reload", b"{}")
        assert daemon.settings is before
    os.close(writer)


@stepped
async def test_reloads_of_a_file_that_is_slow_to_read_leave_room_for_other_commands(
    clock: SteppedClock, can_bus_settings: Bus, tmp_path: Path
) -> None:
    """As a pipe may be: as many as may run waited for one another."""
    path = tmp_path / "demo.toml"
    path.write_text("damaged")
    async with living(can_bus_settings, tmp_path / "state", clock=clock) as live:
        daemon = live.daemon
        daemon._configuration = path
        handler = CommandHandler(daemon.control.handle)
        answers: list[Result] = []

        def ask(name: str) -> None:
            handler.take(name, b"{}", lambda answer: answers.append(decode_result(answer)))

        clock.threads_take_s = 10.0
        for _ in range(MAX_RUNNING):
            ask("reload")
        await clock.sleep(1.0)
        ask("status")
        await clock.sleep(1.0)
        *refused, status = answers
        assert status.ok
        assert len(refused) == MAX_RUNNING - 1
        for answer in refused:
            assert "being read again already" in str(answer.error)
        await clock.sleep(10.0)
        assert "demo.toml" in str(answers[-1].error)
        # Another one may begin now; a SIGHUP is never refused, as it comes with a newer file.
        ask("reload")
        waiting = [asyncio.create_task(daemon.reload()) for _ in range(2)]
        await clock.sleep(25.0)
        assert "demo.toml" in str(answers[-1].error)
        for task in waiting:
            assert "demo.toml" in str(task.exception())


@stepped
async def test_gains_that_another_program_fits_while_the_daemon_runs_are_not_lost(
    clock: SteppedClock, can_bus_settings: Bus, tmp_path: Path
) -> None:
    """The next calibration wrote its older ones over them."""
    path = tmp_path / "demo-main.calibration.json"
    async with living(can_bus_settings, tmp_path, clock=clock) as live:
        daemon = live.daemon
        configuration = daemon.engine.configuration
        stored = load_calibration(path, daemon.layout, configuration)
        fitted = calibrations.with_gains(stored, 1.25 * stored.gain, stored.bend)
        save_calibration(path, fitted, daemon.layout)
        for request in (b'{"seconds":0.5,"board":"hand"}', b'{"seconds":0.5}'):
            await daemon.control.handle("calibrate", request)
            for found in (
                daemon.engine.calibration,
                load_calibration(path, daemon.layout, configuration),
            ):
                assert found is not None
                assert found.gain == pytest.approx(1.25 * stored.gain)
        newer = path.read_text().replace("skin.calibration/1", "skin.calibration/2")
        path.write_text(newer)
        with pytest.raises(NewerFileError, match="of a newer version"):
            await daemon.control.handle("calibrate", b'{"seconds":0.5}')
        assert path.read_text() == newer
        with path.open("a"), pytest.raises(BusyFileError):
            await daemon.control.handle("calibrate", b'{"seconds":0.5}')


@stepped
async def test_what_was_removed_with_its_folder_is_written_again(
    clock: SteppedClock, can_bus_settings: Bus, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """A start would have neither gains nor zeros, and parts that were disabled would be enabled."""
    state = tmp_path / "state"
    async with living(can_bus_settings, state, clock=clock) as live:
        handle = live.daemon.control.handle
        await handle("disable", b'{"part":"left_hand"}')
        await live.daemon.configure()
        await clock.sleep(5.0)
        kept = {path.name: json.loads(path.read_bytes()) for path in state.iterdir()}
        assert len(kept) == 3
        shutil.rmtree(state)
        state.write_text("in the way")
        await clock.sleep(12.0)
        assert {where for code, where in live.faults() if code == "state_not_kept"} >= {
            "calibration",
            "state",
        }
        state.unlink()
        await clock.sleep(12.0)
        assert "state_not_kept" not in {code for code, _ in live.faults()}
        again = {path.name: json.loads(path.read_bytes()) for path in state.iterdir()}
        assert again.keys() == kept.keys()
        for what in ("calibration", "state"):
            name = f"demo-main.{what}.json"
            assert again[name] == kept[name]
            said = [r.getMessage() for r in caplog.records if f"{what}.json" in r.getMessage()]
            assert sum("was removed; it is written again" in line for line in said) == 1
            assert sum("not kept" in line for line in said) == 1
        # Nothing is written again without need.
        written = {path: path.stat().st_ino for path in state.iterdir()}
        await clock.sleep(30.0)
        assert {path: path.stat().st_ino for path in state.iterdir()} == written


def test_a_recording_whose_folder_vanishes_ends_in_a_line(tmp_path: Path) -> None:
    """What is written to a file without a name is lost, and no write fails."""
    for suffix, kind in (("log", CanLog), ("blf", CanLog), ("mcap", Recorder)):
        folder = tmp_path / suffix
        recording = kind(folder / f"x.{suffix}")
        put = recording.can if isinstance(recording, Recorder) else recording.put
        put("can0", FRAMES)
        shutil.rmtree(folder)
        with pytest.raises(SkinError, match=rf"x\.{suffix}: cannot be written: "):
            put("can0", FRAMES)
        with pytest.raises(SkinError, match=rf"x\.{suffix}: cannot be written: No such file"):
            recording.close()


async def test_a_recording_of_the_daemon_does_not_count_frames_that_are_in_no_file(
    tmp_path: Path,
) -> None:
    path = tmp_path / "recordings" / "x.log"
    recorder = FrameRecorder(path, 60.0, 10_000)
    recorder.put("can0", FRAMES)
    await until(lambda: recorder.frames == 1)
    shutil.rmtree(path.parent)
    recorder.put("can0", FRAMES)
    await until(lambda: recorder.ended is not None)
    assert recorder.ended == "cannot write: it was removed while it was being written"
    assert recorder.frames == 1


async def test_a_page_that_recorded_into_a_folder_that_vanished_gets_the_reason(
    tmp_path: Path,
) -> None:
    recording = PageRecording(tmp_path / "recordings")
    recording.start(Broker("localhost", 1), "skin", "demo")
    shutil.rmtree(tmp_path / "recordings")
    with pytest.raises(SkinError, match=r"\.mcap: cannot be written: No such file"):
        await recording.stop()


@pytest.fixture
def quota(tmp_path: Path) -> Iterator[Path]:
    """A folder with a quota of 256 kB, on a disk with room for more."""
    image, place = tmp_path / "disk", tmp_path / "mounted"
    with image.open("wb") as file:
        file.truncate(128 << 20)
    place.mkdir()
    limited = place / "limited"
    try:
        for command in (
            ["mkfs.btrfs", "-q", str(image)],
            ["mount", "-o", "loop", str(image), str(place)],
            ["btrfs", "quota", "enable", str(place)],
            ["btrfs", "subvolume", "create", str(limited)],
            ["btrfs", "qgroup", "limit", "256K", str(limited)],
        ):
            subprocess.run(command, check=True, capture_output=True)
        yield limited
    except (OSError, subprocess.CalledProcessError):
        pytest.skip("needs btrfs-progs, and a user who may mount")
    finally:
        subprocess.run(["umount", str(place)], check=False, capture_output=True)


def test_a_quota_that_is_used_up_leaves_the_old_file(quota: Path) -> None:
    path = quota / "kept.json"
    write_atomic(path, b"old" * 1000)
    with pytest.raises(OSError, match="Disk quota exceeded") as full:
        write_atomic(path, os.urandom(1 << 20))
    assert full.value.errno == errno.EDQUOT
    assert path.read_bytes() == b"old" * 1000
    assert [file.name for file in quota.iterdir()] == ["kept.json"]
    write_atomic(path, b"new" * 1000)
    assert path.read_bytes() == b"new" * 1000
