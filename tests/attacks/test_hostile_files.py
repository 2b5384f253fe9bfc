"""Hostile files and arguments end in one line and exit status 2 or 1, never in a traceback."""

import os
import threading
import time
from pathlib import Path

import pytest
from msgspec import convert

from skin_host import files
from skin_host.cli import main
from skin_host.config.settings import Mqtt
from skin_host.daemon import metrics
from skin_host.errors import RequestError, SkinError
from skin_host.files import read_whole
from skin_host.mqtt.address import Broker
from skin_host.recording.capture import MAX_RECORDINGS, FrameRecorder

CONFIG = Path(__file__).parents[2] / "config" / "demo.toml"


@pytest.mark.parametrize(
    "line",
    [
        "(99999999999999999999.000000) can0 4E0#00",
        "(-5.000000) can0 4E0#00",
        "(1.000000) can0 4E0#" + "AA" * 100_000,
    ],
)
def test_a_recording_with_impossible_frames_is_refused_in_a_line(
    tmp_path: Path, line: str, capsys: pytest.CaptureFixture[str]
) -> None:
    log = tmp_path / "x.log"
    log.write_text(line + "\n")
    assert main(["replay", str(log), "--config", str(CONFIG), "--output", "-"]) == 2
    (said,) = capsys.readouterr().err.splitlines()
    assert str(log) in said
    assert len(said) < 500


@pytest.mark.parametrize("text", ["a=" + "[" * 100_000, "a=" + "{b=" * 50_000])
def test_a_configuration_nested_without_end_is_refused_in_a_line(
    tmp_path: Path, text: str, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "x.toml"
    path.write_text(text)
    assert main(["check", str(path)]) == 2
    said = capsys.readouterr()
    assert "nested too deep" in said.err + said.out


def test_a_number_of_5000_digits_is_refused_in_a_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "x.toml"
    path.write_text("robot = " + "9" * 5000)
    assert main(["check", str(path)]) == 2
    (said,) = capsys.readouterr().err.splitlines()
    assert "x.toml: not TOML" in said


def test_what_a_file_says_does_not_steer_the_terminal(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Escape sequences are shown, not obeyed; of thousands of remarks the first are printed."""
    path = tmp_path / "x.ini"
    evil = ["evil\x1b]0;title\x07 \x9b31m " * 5] * 3000
    path.write_text("\n".join(["cardid 3", *evil, "[SENSORS]", "triangle 4 0 0 0 1"]))
    assert main(["import", "skingui", str(path), "--output", str(tmp_path / "out.toml")]) == 0
    said = capsys.readouterr().err
    assert not {one for one in said if one != "\n" and not one.isprintable()}
    assert len(said) < 100_000
    assert "evil\\x1b" in said
    configuration = tmp_path / "x.toml"
    configuration.write_text('"a\\u001B[2J\\u0007" = 1\n')
    assert main(["check", str(configuration)]) == 2
    said = "".join(capsys.readouterr())
    assert not {one for one in said if one != "\n" and not one.isprintable()}


def test_an_impossible_port_is_refused_in_a_line(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["view", "--port", "99999"])
    assert ended.value.code == 2
    (said,) = capsys.readouterr().err.splitlines()
    assert "99999" in said


def test_a_folder_takes_so_many_recordings_and_no_more(tmp_path: Path) -> None:
    for number in range(MAX_RECORDINGS):
        (tmp_path / f"{number}.log").touch()
    with pytest.raises(SkinError, match="holds 100 recordings already"):
        FrameRecorder(tmp_path / "one_more.log", 1.0, 1000)


def test_a_password_need_not_stand_in_the_url(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SKIN_MQTT_PASSWORD", "sesame")
    assert Broker.from_url("mqtt://anna@host")[0].password == "sesame"
    assert Broker.from_url("mqtt://anna:own@host")[0].password == "own"
    assert Broker.from_url("mqtt://host")[0].password is None
    (tmp_path / "password").write_text("open\n")
    monkeypatch.setenv("SKIN_MQTT_PASSWORD_FILE", str(tmp_path / "password"))
    assert Broker.from_url("mqtt://anna@host")[0].password == "open"
    monkeypatch.setenv("SKIN_MQTT_PASSWORD_FILE", str(tmp_path / "none"))
    with pytest.raises(RequestError, match="none: No such file"):
        Broker.from_url("mqtt://anna@host")


def test_metrics_are_in_seconds_not_negative_and_name_faults() -> None:
    record = {"age_ms": -3.0, "faults": [{"code": "board_silent", "where": "hand"}]}
    text = metrics.exposition({"palm": record})  # type: ignore[dict-item]
    assert 'skin_age_seconds{part="palm"} 0\n' in text
    assert 'skin_fault{part="palm",code="board_silent",where="hand"} 1\n' in text


#: How each command reads a file that somebody names.
READERS = {
    "x.toml": ["check", "{}"],
    "running.json": ["check", str(CONFIG), "--running", "{}"],
    "scene.toml": ["emulate", str(CONFIG), "--scene", "{}"],
    "state": ["emulate", str(CONFIG), "--state", "{}"],
    "x.log": ["replay", "{}", "--config", str(CONFIG)],
    "x.asc": ["replay", "{}", "--config", str(CONFIG)],
    "x.mcap": ["export", "{}", "x.npz"],
    "skin.xml": ["import", "skinspec", "{}", "--output", "x.toml"],
    "skin.ini": ["import", "skingui", "{}", "--output", "x.toml"],
    "places.txt": ["import", "positions", "{}", "--output", "x.toml"],
}


@pytest.mark.timeout(60)
@pytest.mark.parametrize("key", ["ca_file", "certificate_file", "password_file"])
def test_a_pipe_of_the_brokers_settings_is_not_waited_for(tmp_path: Path, key: str) -> None:
    os.mkfifo(tmp_path / "pipe")
    more: dict[str, object] = {"username": "a"} if key == "password_file" else {"tls": True}
    settings = convert({key: "pipe"} | more, Mqtt)
    with pytest.raises(SkinError, match=f"mqtt.{key}: .*pipe: .*a pipe that nobody writes to"):
        Broker.from_settings(settings, tmp_path)


@pytest.mark.timeout(60)
@pytest.mark.parametrize("name", READERS)
def test_a_pipe_that_nobody_writes_to_is_not_waited_for(
    tmp_path: Path, name: str, capsys: pytest.CaptureFixture[str]
) -> None:
    os.mkfifo(tmp_path / name)
    arguments = [one.replace("{}", str(tmp_path / name)) for one in READERS[name]]
    assert main(arguments) in (1, 2)
    assert len(capsys.readouterr().err.splitlines()) == 1


@pytest.mark.timeout(60)
@pytest.mark.parametrize("name", READERS)
def test_a_file_of_a_terabyte_is_refused_before_it_fills_the_memory(
    tmp_path: Path, name: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with (tmp_path / name).open("wb") as file:
        file.truncate(1 << 40)
    arguments = [one.replace("{}", str(tmp_path / name)) for one in READERS[name]]
    assert main(arguments) in (1, 2)
    assert len(capsys.readouterr().err.splitlines()) == 1


def test_a_device_without_end_is_not_read_to_its_end(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["check", "/dev/zero"]) == 2
    assert "/dev/zero: cannot be read: larger than" in capsys.readouterr().err


@pytest.mark.timeout(60)
def test_a_pipe_whose_writer_is_silent_is_not_waited_for_without_end(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Eight reloads of such a configuration blocked all commands of a daemon."""
    monkeypatch.setattr(files, "PATIENCE_S", 0.2)
    path = tmp_path / "x.toml"
    os.mkfifo(path)
    writer = os.open(path, os.O_RDWR)
    os.write(writer, b"robot = ")
    assert main(["check", str(path)]) == 2
    os.close(writer)
    (line,) = capsys.readouterr().err.splitlines()
    assert line == f"skin check: {path}: cannot be read: it did not end within 0.2 s"


@pytest.mark.timeout(60)
def test_a_pipe_that_drips_is_not_waited_for_without_end(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(files, "PATIENCE_S", 0.5)
    path = tmp_path / "pipe"
    os.mkfifo(path)
    writer = os.open(path, os.O_RDWR)
    ended = threading.Event()

    def drip() -> None:
        while not ended.wait(0.02):
            os.write(writer, b"#")

    dripping = threading.Thread(target=drip)
    dripping.start()
    try:
        with pytest.raises(OSError, match="did not end within"):
            read_whole(path)
    finally:
        ended.set()
        dripping.join()
        os.close(writer)


@pytest.mark.timeout(60)
def test_a_pipe_with_pauses_is_read_to_its_end(tmp_path: Path) -> None:
    path = tmp_path / "pipe"
    os.mkfifo(path)
    writer = os.open(path, os.O_RDWR)

    def write() -> None:
        for _ in range(3):
            os.write(writer, b"abc" * 10_000)
            time.sleep(0.1)
        os.close(writer)

    writing = threading.Thread(target=write)
    writing.start()
    assert read_whole(path) == b"abc" * 30_000
    writing.join()


@pytest.mark.timeout(60)
def test_the_systems_log_which_has_no_end_is_not_waited_for(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """It states that it is a regular file."""
    monkeypatch.setattr(files, "PATIENCE_S", 0.2)
    log = Path("/proc/kmsg")
    if not os.access(log, os.R_OK):
        pytest.skip("this user may not read it")
    with pytest.raises(OSError, match=r"did not end within|not permitted"):
        read_whole(log)


def test_a_name_with_a_zero_byte_is_a_file_that_cannot_be_read() -> None:
    with pytest.raises(OSError, match="null byte"):
        read_whole(Path("a\0b"))


@pytest.mark.parametrize("number", ["1e308", "-1e200", "1e7"])
def test_positions_beyond_all_bounds_are_refused_in_lines(
    tmp_path: Path, number: str, capsys: pytest.CaptureFixture[str]
) -> None:
    rows = tmp_path / "rows.txt"
    rows.write_text(f"{number} {number} 0 0 0 {number}\n" * 384)
    (tmp_path / "x.toml").write_text(
        """
        robot = "x"
        [buses.can0]
        [boards.b]
        bus = "can0"
        address = 1
        [[parts.p.patches]]
        board = "b"
        triangles = "0-15"
        positions = "rows.txt"
        """
    )
    rows_of_one = tmp_path / "places.txt"
    rows_of_one.write_text(rows.read_text())
    arguments = ["import", "positions", str(rows_of_one), "--output", str(tmp_path / "y.toml")]
    assert main(arguments) == 2
    assert "Traceback" not in capsys.readouterr().err
    rows.write_text(f"{number} {number} 0 0 0 {number}\n" * 192)
    assert main(["check", str(tmp_path / "x.toml")]) == 2
    (said,) = capsys.readouterr().err.splitlines()
    assert "rows.txt" in said
    assert "1e+06" in said


@pytest.mark.parametrize("number", ["fffffffffffffffffffff", "-5", "20000000"])
def test_an_identifier_that_can_has_not_is_refused_in_a_line(
    tmp_path: Path, number: str, capsys: pytest.CaptureFixture[str]
) -> None:
    log = tmp_path / "x.csv"
    head = "timestamp,arbitration_id,extended,remote,error,dlc,data\n"
    log.write_text(f"{head}1.0,{number},1,0,0,1,AA==\n")
    assert main(["replay", str(log), "--config", str(CONFIG), "--output", "-"]) == 2
    (said,) = capsys.readouterr().err.splitlines()
    assert f"{log}: " in said
    assert "an identifier of " in said


def test_a_recording_of_more_channels_than_any_robot_has_is_refused_in_a_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Each new name was compared with all before: 5 MB took minutes."""
    log = tmp_path / "x.log"
    log.write_text("".join(f"(1.{n:06d}) can{n} 4E0#00\n" for n in range(100_000)))
    assert main(["replay", str(log), "--config", str(CONFIG), "--output", "-"]) == 2
    (said,) = capsys.readouterr().err.splitlines()
    assert "more than 1000 channels" in said


LONG = "x" * 70_000


@pytest.mark.parametrize(
    ("line", "wanted"),
    [
        (f'base = "{LONG}"', "mqtt.base: seen 70000 bytes in 1 levels, wanted at most 256"),
        (f'base = "{"a/" * 100}a"', "mqtt.base: seen 201 bytes in 101 levels"),
        (f'discovery_prefix = "{LONG}"', "mqtt.discovery_prefix: "),
        (f'username = "{LONG}"', "mqtt.username: "),
        ('username = "a\\u0000b"', "mqtt.username: "),
    ],
)
def test_a_name_that_no_broker_takes_is_refused_in_a_line(
    line: str, wanted: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The daemon started, and published nothing for ever."""
    path = tmp_path / "x.toml"
    path.write_text(CONFIG.read_text() + f"\n[mqtt]\n{line}\n")
    assert main(["check", str(path)]) == 2
    (said,) = capsys.readouterr().err.splitlines()
    assert wanted in said
    assert len(said) < 1500


@pytest.mark.parametrize(
    "url", [f"mqtt://{LONG}@x", f"mqtt://u:{LONG}@x", "mqtt://a%00b@x", f"mqtt://x/{LONG}"]
)
def test_a_broker_with_names_that_cannot_be_sent_is_refused_in_a_line(
    url: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["status", "--broker", url, "--robot", "x"]) == 2
    (said,) = capsys.readouterr().err.splitlines()
    assert "wanted" in said
    assert LONG[:1000] not in said
