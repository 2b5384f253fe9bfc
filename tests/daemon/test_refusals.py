"""What a daemon refuses: the request is wrong, or the moment is, or it failed."""

from pathlib import Path

from skin_host.clock import SteppedClock
from skin_host.config.settings import Bus
from skin_host.mqtt.commands import CommandHandler, Result, decode_result
from tests.support.live import Live, living
from tests.support.stepped import stepped


class Asking:
    """Asks a daemon as a subscriber does."""

    def __init__(self, live: Live, clock: SteppedClock) -> None:
        self._handler = CommandHandler(live.daemon.control.handle)
        self._clock = clock
        self.answers: list[Result] = []

    def ask(self, name: str, payload: bytes = b"{}") -> None:
        self._handler.take(name, payload, lambda one: self.answers.append(decode_result(one)))

    async def answer(self, name: str, payload: bytes = b"{}") -> Result:
        n = len(self.answers)
        self.ask(name, payload)
        while len(self.answers) == n:
            await self._clock.sleep(0.02)
        return self.answers[-1]


@stepped
async def test_a_request_that_no_daemon_of_this_skin_takes_is_wrong(
    clock: SteppedClock, can_bus_settings: Bus, tmp_path: Path
) -> None:
    async with living(can_bus_settings, tmp_path, clock=clock) as live:
        asking = Asking(live, clock)
        for name, payload, named in (
            ("calibrate", b'{"seconds":1e6}', "seconds"),
            ("calibrate", b'{"second":1}', "second"),
            ("calibrate", b'{"part":"left_hand","board":"hand"}', "wanted one of them"),
            ("calibrate", b'{"board":"foot"}', 'no board "foot"'),
            ("disable", b'{"part":"tail"}', 'no part "tail"'),
            ("disable", b"{}", "part"),
            ("enable", b"", "an empty request"),
            ("dance", b"{}", 'no command "dance"'),
            ("record", b'{"file":"../x"}', "wanted a plain name"),
            ("thresholds", b'{"set":{"margin_units":255}}', "no press would be felt"),
        ):
            answer = await asking.answer(name, payload)
            assert (answer.ok, answer.cause) == (False, "request"), (name, payload)
            assert named in str(answer.error)
            await clock.sleep(0.2)


@stepped
async def test_a_request_that_comes_at_a_wrong_moment_is_not_a_wrong_one(
    clock: SteppedClock, can_bus_settings: Bus, tmp_path: Path
) -> None:
    async with living(can_bus_settings, tmp_path, clock=clock) as live:
        asking = Asking(live, clock)
        answer = await asking.answer("stop_recording")
        assert (answer.cause, answer.error) == ("state", "nothing is being recorded")
        assert (await asking.answer("record", b'{"file":"run.log"}')).ok
        answer = await asking.answer("record", b'{"file":"other.log"}')
        assert answer.cause == "state"
        assert "run.log is being recorded already" in str(answer.error)
        assert (await asking.answer("stop_recording")).ok
        asking.ask("calibrate")
        await clock.sleep(0.1)
        answer = await asking.answer("calibrate")
        assert answer.cause == "state"
        assert "a calibration is being taken already" in str(answer.error)
        while asking.answers[-1] is answer:
            await clock.sleep(0.1)
        assert asking.answers[-1].ok
        folder = tmp_path / "recordings"
        for number in range(100):
            (folder / f"{number}.log").touch()
        answer = await asking.answer("record")
        assert answer.cause == "state"
        assert "holds 100 recordings already; move some away" in str(answer.error)


@stepped
async def test_a_recording_of_a_name_that_there_is_is_a_wrong_request(
    clock: SteppedClock, can_bus_settings: Bus, tmp_path: Path
) -> None:
    path = tmp_path / "recordings" / "run.log"
    path.parent.mkdir()
    path.write_text("kept")
    async with living(can_bus_settings, tmp_path, clock=clock) as live:
        answer = await Asking(live, clock).answer("record", b'{"file":"run.log"}')
    assert answer.cause == "request"
    assert answer.error == f"{path}: is there already; wanted another name"
    assert path.read_text() == "kept"


@stepped
async def test_an_ending_daemon_sets_up_no_board_and_blames_no_request(
    clock: SteppedClock, can_bus_settings: Bus, tmp_path: Path
) -> None:
    async with living(can_bus_settings, tmp_path, clock=clock) as live:
        asking = Asking(live, clock)
        live.daemon._is_ending = True
        answer = await asking.answer("configure")
        live.daemon._is_ending = False
        assert (answer.cause, answer.error) == ("state", "the daemon is ending")


@stepped
async def test_what_cannot_be_done_has_failed(
    clock: SteppedClock, can_bus_settings: Bus, tmp_path: Path
) -> None:
    blocked = tmp_path / "file"
    blocked.write_text("a file where a folder is wanted")
    async with living(can_bus_settings, blocked / "state", clock=clock) as live:
        answer = await Asking(live, clock).answer("record")
        assert answer.cause == "failure"
        assert "cannot be written" in str(answer.error)


@stepped
async def test_a_configuration_that_is_wrong_has_to_be_mended_as_a_request_has(
    clock: SteppedClock, can_bus_settings: Bus, tmp_path: Path
) -> None:
    path = tmp_path / "demo.toml"
    path.write_text("damaged")
    async with living(can_bus_settings, tmp_path / "state", clock=clock) as live:
        live.daemon._configuration = path
        answer = await Asking(live, clock).answer("reload")
        assert answer.cause == "request"
        assert str(answer.error).startswith(f"{path}: ")
