"""A shell completes the command line: real shells, on a real terminal."""

import os
import pty
import select
import subprocess
import sys
import time
from pathlib import Path

import pytest
from paho.mqtt import publish

from skin_host.bus import interfaces
from skin_host.cli import main
from skin_host.config.settings import load
from skin_host.layout import build_layout
from skin_host.mqtt.info import encode_info, node_info
from tests.support import programs
from tests.support.broker import Mosquitto
from tests.support.waiting import PATIENCE_S

ROOT = Path(__file__).parents[2]
#: As a shell that has just been started without anybody's files.
START = {"bash": ["--norc", "--noprofile", "-i"], "zsh": ["-f", "-i"]}
PREPARE = {"bash": "", "zsh": "autoload -U compinit && compinit -u -D; "}


def environment(**more: str) -> dict[str, str]:
    path = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])
    return os.environ | {"PATH": path, "TERM": "dumb", "PS1": "> "} | more


class Terminal:
    """A shell on a terminal of its own: type, and read what it shows."""

    def __init__(self, shell: str, folder: Path) -> None:
        program = programs.find(shell)
        if program is None:
            pytest.skip(f"{shell} is not installed")
        self._process, self._terminal = pty.fork()
        if self._process == 0:
            os.chdir(folder)
            os.execve(program, [shell, *START[shell]], environment(HOME=str(folder)))
        self.type(f'{PREPARE[shell]}eval "$(skin completion {shell})"; echo is\\ ready\n')
        self.until("\nis ready")

    def type(self, keys: str) -> None:
        os.write(self._terminal, keys.encode())

    def until(self, wanted: str) -> str:
        """Read until something is shown; return all that was."""
        shown = ""
        deadline_s = time.monotonic() + PATIENCE_S
        while wanted not in shown:
            assert time.monotonic() < deadline_s, f"waited for {wanted!r}; seen: {shown!r}"
            if select.select([self._terminal], [], [], 0.1)[0]:
                shown += os.read(self._terminal, 4096).decode().replace("\r", "")
        return shown

    def close(self) -> None:
        os.close(self._terminal)
        os.waitpid(self._process, 0)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "robot.toml").write_text((ROOT / "config/demo.toml").read_text())
    (tmp_path / "notes.txt").touch()
    return tmp_path


@pytest.mark.parametrize("shell", ["bash", "zsh"])
def test_tab_completes_a_command_an_option_a_file_and_a_name(shell: str, folder: Path) -> None:
    terminal = Terminal(shell, folder)
    terminal.type("skin emu\t")
    terminal.until("skin emulate ")
    terminal.type("--fid\t")  # another one than `--fidelity` does not begin so
    terminal.until("elity ")
    terminal.type("ch\t")
    terminal.until("ip ")
    terminal.type("ro\t")  # notes.txt is no configuration
    terminal.until("bot.toml ")
    terminal.type("--board forearm_i\t")
    terminal.until("nner ")
    terminal.close()


def test_fish_completes_too(folder: Path) -> None:
    fish = programs.find("fish")
    if fish is None:
        pytest.skip("fish is not installed")
    script = "skin completion fish | source; complete -C 'skin emulate robot.toml --board '"
    done = subprocess.run(
        [fish, "--no-config", "-c", script],
        cwd=folder,
        env=environment(HOME=str(folder)),
        capture_output=True,
        text=True,
        check=True,
    )
    assert set(done.stdout.split()) == {"hand", "forearm_outer", "forearm_inner"}


def completions(line: str, folder: Path, **more: str) -> list[str]:
    """What a shell would be told, asked as argcomplete's shells ask."""
    answer = folder / "answer"
    answer.unlink(missing_ok=True)
    asked = {
        "_ARGCOMPLETE": "1",
        "_ARGCOMPLETE_STDOUT_FILENAME": str(answer),
        "_ARGCOMPLETE_IFS": "\n",
        "_ARGCOMPLETE_SHELL": "bash",
        "COMP_LINE": line,
        "COMP_POINT": str(len(line)),
    }
    subprocess.run(["skin"], cwd=folder, env=environment(**asked, **more), check=True)
    return answer.read_text().split()


@pytest.mark.parametrize(
    ("line", "wanted"),
    [
        ("skin import skin", {"skinspec", "skingui", "skinmanager"}),
        ("skin calibrate robot.toml --node ", {"main"}),
        ("skin plot map a.mcap a.png --config robot.toml --part ", {"left_hand", "left_forearm"}),
        ("skin check ", {"robot.toml"}),
        ("skin listen --broker mqtt://127.0.0.1:1 --part ", set()),
        ("skin export a.log a.npz --config notes.txt --part ", set()),
    ],
)
def test_what_may_stand_there_is_told(line: str, wanted: set[str], folder: Path) -> None:
    assert set(completions(line, folder)) == wanted


def test_parts_and_boards_are_asked_of_the_robot(mosquitto: Mosquitto, folder: Path) -> None:
    layout = build_layout(load(folder / "robot.toml"), folder)
    info = encode_info(node_info(layout, "main", version="1", configuration="x"))
    url = f"mqtt://{mosquitto.host}:{mosquitto.port}"
    topic = "skin/demo/nodes/main/info"
    publish.single(topic, info, 1, retain=True, hostname=mosquitto.host, port=mosquitto.port)
    line = f"skin command --broker {url} --robot demo calibrate"
    assert set(completions(f"{line} --part left_", folder)) == {"left_hand", "left_forearm"}
    assert completions(f"{line} --board ha", folder) == ["hand"]


def test_channels_are_the_can_interfaces_of_the_machine(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name, kind in {"can0": "280", "eth0": "1", "vcan0": "280"}.items():
        (tmp_path / name).mkdir()
        (tmp_path / name / "type").write_text(kind + "\n")
    monkeypatch.setattr(interfaces, "NETWORKS", tmp_path)
    assert set(interfaces.can_interfaces()) == {"can0", "vcan0"}


def test_who_asks_for_no_completion_does_not_pay_for_it() -> None:
    script = "import sys; from skin_host.cli import build_parser; build_parser(); "
    script += "print(*{'argcomplete', 'asyncio', 'numpy', 'can', 'aiomqtt'} & set(sys.modules))"
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=True, cwd=ROOT
    )
    assert done.stdout.split() == []


def test_an_unknown_shell_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as refused:
        main(["completion", "csh"])
    assert refused.value.code == 2
    assert "bash, zsh, fish" in capsys.readouterr().err.replace("'", "")
