"""Work shared among processes ends whole, with an error, or at once."""

import asyncio
import multiprocessing
import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from skin_host.errors import SkinError
from skin_host.processes import Processes, beside, kept_from_children
from tests.support.moments import at_import
from tests.support.waiting import PATIENCE_S, until

#: It works until it is ended, in a folder that it removes then, and names itself in there.
WORKS = """
import os, signal, sys
from pathlib import Path
from skin_host.processes import Processes
from tests.test_processes import works_on

if __name__ == "__main__":
    # What starts the tests may have Ctrl-C ignored, as background jobs of a shell have.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with Processes(2) as processes:
            for future in [processes.submit(works_on, Path(sys.argv[1])) for _ in range(8)]:
                future.result()
    except KeyboardInterrupt:
        sys.exit(128 + signal.SIGINT)
"""


def square(number: int) -> int:
    return number * number


def works_on(folder: Path) -> None:
    with tempfile.TemporaryDirectory(dir=folder, prefix=f"{os.getpid()}-") as own:
        # Before, nobody would remove the folder.
        (Path(own) / "works").touch()
        while True:
            time.sleep(0.01)


def cleans_up_slowly(folder: Path) -> None:
    try:
        (folder / "working").touch()
        while True:
            time.sleep(0.01)
    finally:
        (folder / "cleaning").touch()
        time.sleep(0.3)
        (folder / "clean").touch()


def wait_for(condition: Callable[[], object]) -> None:
    asyncio.run(until(condition))


def is_gone(process: int) -> bool:
    return not Path(f"/proc/{process}").exists()


def workers(folder: Path) -> list[int]:
    return [int(path.name.partition("-")[0]) for path in folder.iterdir()]


def two_work(folder: Path) -> bool:
    return len(list(folder.glob("*/works"))) == 2


def test_each_piece_of_work_has_its_result():
    with Processes() as processes:
        futures = [processes.submit(square, number) for number in range(5)]
    assert [future.result() for future in futures] == [0, 1, 4, 9, 16]


def test_a_process_that_is_killed_is_an_error_in_one_line():
    with pytest.raises(SkinError, match="was killed"), Processes(1) as processes:
        processes.submit(os.kill, 0, 0).result()
        (child,) = multiprocessing.active_children()
        future = processes.submit(time.sleep, 600.0)
        os.kill(child.pid, signal.SIGKILL)
        future.result()


def test_an_exception_ends_the_others_at_once_and_they_clean_up(tmp_path):
    with pytest.raises(KeyboardInterrupt), Processes(2) as processes:
        for _ in range(8):
            processes.submit(works_on, tmp_path)
        wait_for(lambda: two_work(tmp_path))
        running = workers(tmp_path)
        raise KeyboardInterrupt
    assert all(map(is_gone, running))
    assert not workers(tmp_path)


def test_one_that_is_told_twice_to_end_finishes_cleaning_up(tmp_path):
    """When one of several has ended, the pool ends the others once more."""
    with pytest.raises(KeyboardInterrupt), Processes(1) as processes:
        processes.submit(cleans_up_slowly, tmp_path)
        wait_for((tmp_path / "working").exists)
        (child,) = multiprocessing.active_children()
        child.terminate()
        wait_for((tmp_path / "cleaning").exists)
        raise KeyboardInterrupt
    assert (tmp_path / "clean").exists()


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT, signal.SIGKILL])
def test_they_end_with_their_parent_however_it_ends(tmp_path, number):
    folder = tmp_path / "work"
    folder.mkdir()
    program = tmp_path / "program.py"
    program.write_text(WORKS)
    parent = subprocess.Popen(
        [sys.executable, str(program), str(folder)],
        env=os.environ | {"PYTHONPATH": str(Path(__file__).parents[1])},
        stderr=subprocess.PIPE,
        text=True,
    )
    wait_for(lambda: two_work(folder))
    running = workers(folder)
    parent.send_signal(number)
    # Its pipe ends when the last of them has.
    said = parent.communicate()[1]
    wait_for(lambda: all(map(is_gone, running)))
    assert not workers(folder)
    if number == signal.SIGTERM:
        assert parent.returncode == 128 + number
        assert not said


@pytest.mark.parametrize("module", ["multiprocessing.spawn", "skin_host.errors", "pytest"])
def test_ctrl_c_while_they_are_being_started_ends_them_without_a_word(tmp_path, module):
    """A terminal sends it to all of them, and the parent ends the others."""
    folder = tmp_path / "work"
    folder.mkdir()
    program = tmp_path / "program.py"
    program.write_text(WORKS)
    act = "signal.raise_signal(signal.SIGINT); os.kill(os.getppid(), signal.SIGINT)"
    environment = at_import(tmp_path, module, "--multiprocessing-fork", act)
    environment["PYTHONPATH"] += f":{Path(__file__).parents[1]}"
    ended = subprocess.run(
        [sys.executable, str(program), str(folder)],
        check=False,
        env=environment,
        capture_output=True,
        text=True,
        timeout=PATIENCE_S,
    )
    assert (ended.returncode, ended.stderr) == (130, "")


class HangupError(Exception):
    """SIGHUP came."""


@pytest.fixture
def hangups_are_ignored() -> Iterator[None]:
    """What ran before in this process may have left them blocked, as a service that starts does,
    and one may wait since then.
    """
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    mask = signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGHUP})
    yield
    signal.pthread_sigmask(signal.SIG_SETMASK, mask)
    signal.signal(signal.SIGHUP, before)


@pytest.fixture
def hangups_raise(hangups_are_ignored: None) -> Iterator[None]:
    """A thread takes them that does not block them, as those of numpy do not."""

    def hang_up(number: int, _: object) -> None:
        raise HangupError

    over = threading.Event()
    thread = threading.Thread(target=over.wait)
    thread.start()
    signal.signal(signal.SIGHUP, hang_up)
    yield
    signal.signal(signal.SIGHUP, signal.SIG_IGN)
    over.set()
    thread.join()


class StartsAsAsked(multiprocessing.get_context("spawn").Process):
    """The terminal is closed just before it starts."""

    def start(self) -> None:
        os.kill(os.getpid(), signal.SIGHUP)
        time.sleep(0.05)
        super().start()


@pytest.mark.usefixtures("hangups_raise")
def test_a_signal_that_another_thread_takes_waits_until_a_program_has_started() -> None:
    is_started = False
    with pytest.raises(HangupError), kept_from_children(signal.SIGHUP):
        os.kill(os.getpid(), signal.SIGHUP)
        time.sleep(0.05)
        is_started = True
    assert is_started


@pytest.mark.usefixtures("hangups_raise")
def test_processes_that_are_being_started_as_a_terminal_is_closed_end_without_a_word(
    capfd: pytest.CaptureFixture[str],
) -> None:
    """Of a start that is left half way the child would print a traceback."""
    process = StartsAsAsked(target=time.sleep, args=(PATIENCE_S,), daemon=True)
    with pytest.raises(HangupError), beside([process]):
        pass
    assert process.pid is not None
    assert process.exitcode == -signal.SIGTERM
    assert capfd.readouterr().err == ""


@pytest.mark.usefixtures("hangups_are_ignored")
def test_a_signal_that_is_ignored_is_still_ignored_after_a_start() -> None:
    with kept_from_children(signal.SIGHUP):
        os.kill(os.getpid(), signal.SIGHUP)
    assert signal.getsignal(signal.SIGHUP) is signal.SIG_IGN


async def test_what_an_event_loop_handles_comes_to_it_once_however_many_threads_there_are() -> None:
    """A second request to end is one to end at once."""
    came: list[int] = []
    loop, ended = asyncio.get_running_loop(), threading.Event()
    other = threading.Thread(target=ended.wait)  # it does not block the signal, and takes it
    other.start()
    loop.add_signal_handler(signal.SIGHUP, came.append, signal.SIGHUP)
    try:
        with kept_from_children(signal.SIGHUP):
            os.kill(os.getpid(), signal.SIGHUP)
            await asyncio.sleep(0.1)
        await asyncio.sleep(0.1)
    finally:
        loop.remove_signal_handler(signal.SIGHUP)
        ended.set()
        other.join()
    assert came == [signal.SIGHUP]
