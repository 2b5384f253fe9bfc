"""What cannot be done is one line on stderr: what, where, and what mends it."""

import json
from pathlib import Path

import pytest

from skin_host.cli import main, operate
from tests.support.broker import free_port


@pytest.fixture
def group(tmp_path: Path) -> list[str]:
    """A bus of this process with nobody on it."""
    return ["--interface", "virtual", "--channel", tmp_path.name]


@pytest.mark.parametrize("more", [[], ["--json"]])
def test_a_scan_that_nobody_answers_has_failed(
    group: list[str], more: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["scan", *group, *more]) == 1
    told = capsys.readouterr()
    (line,) = told.err.splitlines()
    assert line.startswith(f"skin scan: {group[-1]}: nobody answered")
    assert "powered" in line
    assert (json.loads(told.out) if more else told.out) == ({"boards": []} if more else "")


def test_a_scan_has_the_options_of_its_bus(capsys: pytest.CaptureFixture[str]) -> None:
    """A server of buses has a host and a port: without, it could not be scanned."""
    options = ["--option", "host=127.0.0.1", "--option", f"port={free_port()}"]
    assert main(["scan", "--interface", "socketcand", *options]) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith('skin scan: bus "scan": socketcand can0: cannot be opened: ')
    assert "refused" in line


@pytest.mark.parametrize(
    ("text", "read"),
    [
        ("host=10.0.0.5", "10.0.0.5"),
        ("port=29536", 29536),
        ("timeout=0.5", 0.5),
        ("rtscts=true", True),
        ("listen_only=false", False),
        ("serial=0x1F", "0x1F"),
        ("unique_hardware_id=nan", "nan"),
        ("app_name=", ""),
        ("url=a=b", "a=b"),
    ],
)
def test_an_option_of_a_bus_is_read_as_in_a_configuration(text: str, read: object) -> None:
    key, value = operate._option(text)
    assert (key, value) == (text.partition("=")[0], read)
    assert type(value) is type(read)


@pytest.mark.parametrize(
    ("options", "why"),
    [
        (["--option", "host"], "seen host, wanted KEY=VALUE such as host=10.0.0.5"),
        (["--option", "=1"], "seen =1, wanted KEY=VALUE"),
        (["--bitrate", "999"], "seen 999, wanted a whole number from 1000 to 10000000"),
    ],
)
def test_what_is_no_option_of_a_bus_is_refused(
    options: list[str], why: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as end:
        main(["scan", *options])
    assert end.value.code == 2
    assert why in capsys.readouterr().err


def test_a_channel_that_steers_a_terminal_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["scan", "--channel", "can0\x1b[2J"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "channel: seen 'can0\\x1b[2J', wanted" in line


@pytest.mark.parametrize(
    "command",
    [
        ["scan", "--channel"],
        ["scan", "--interface"],
        ["emulate", "a.toml", "--channel"],
        ["emulate", "a.toml", "--interface"],
        ["listen", "--part"],
        ["listen", "--robot"],
        ["status", "--robot"],
        ["view", "--host"],  # it would be every address of this machine
        ["view", "--foxglove", "--host"],
        ["view", "--name"],
        ["record", "a.mcap", "--robot"],
        ["replay", "a.mcap", "--onto", "broker", "--robot"],
        # Tables would be scattered over the working directory.
        ["export", "a.mcap", "OUTPUT"],
        ["check", "CONFIG"],
        ["report", "--output"],
        ["replay", "a.log", "--config"],
        ["replay", "LOG"],
        ["view", "--recordings"],
    ],
)
def test_an_empty_name_is_refused(command: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    """It is that of a variable of the shell that is not set."""
    with pytest.raises(SystemExit) as end:
        main([*command, ""] if command[-1].startswith("--") else [*command[:-1], ""])
    assert end.value.code == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert f"argument {command[-1]}: seen '', wanted a name" in line


def test_a_bus_without_a_channel_is_found_by_the_check(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    config = tmp_path / "a.toml"
    config.write_text('robot = "a"\n[buses.can0]\nchannel = ""\n')
    assert main(["check", str(config)]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "buses.can0.channel" in line


@pytest.mark.parametrize(
    ("kind", "why"),
    [
        ("skinspec", "a.xml:1: not valid XML from here: syntax error"),
        ("skingui", "contains no unit"),
        ("positions", "no rows x y z nx ny nz"),
    ],
)
def test_an_import_that_fails_names_its_reason_alone(
    kind: str, why: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "a.xml"
    file.write_text("this is no device file\n")
    output = tmp_path / "b.toml"
    assert main(["import", kind, str(file), "--output", str(output)]) == 2
    told = capsys.readouterr()
    assert told.out == ""
    (line,) = told.err.splitlines()
    assert line.startswith("skin import: ")
    assert why in line
    assert not output.exists()


@pytest.mark.parametrize("command", ["check", "demo", "run", "emulate"])
def test_who_names_a_delivered_configuration_where_it_is_not_learns_where_it_is(
    command: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A package has them beside its environment's other data, not in the working directory."""
    missing = tmp_path / "icub.toml"
    assert main([command, str(missing)]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    where = Path(__file__).parents[2] / "config" / "icub.toml"
    assert line == (
        f"skin {command}: {missing}: cannot be read: No such file or directory; the delivered "
        f"icub.toml is {where}"
    )
    for other in ("other.toml", "n" * 300):
        assert main([command, str(tmp_path / other)]) == 2
        (line,) = capsys.readouterr().err.splitlines()
        assert "; the delivered" not in line
