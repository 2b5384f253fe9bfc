"""A service as systemd runs it: SIGHUP reads its configuration again, and its secret stays one."""

import json
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from skin_host.config.settings import Bus
from tests.support import programs
from tests.support.broker import Mosquitto
from tests.support.stack import ROOT, Stack, wait_for
from tests.support.subscriber import Subscriber

PASSWORD = "open-sesame-5fd1"


@pytest.fixture
def broker(tmp_path: Path) -> Iterator[Mosquitto]:
    """Anybody may listen; who gives a name must know its password."""
    passwords = tmp_path / "passwords"
    subprocess.run(
        [programs.require("mosquitto_passwd"), "-b", "-c", passwords, "skin", PASSWORD], check=True
    )
    # As root it would become another user, who cannot read pytest's folders.
    settings = f"user root\npassword_file {passwords}\n"
    with Mosquitto(programs.require("mosquitto"), tmp_path, settings) as broker:
        yield broker


@pytest.fixture
def stack(tmp_path: Path, broker: Mosquitto) -> Iterator[Stack]:
    made = Stack(
        tmp_path, Bus(interface="virtual", channel=tmp_path.name), "virtual", broker, "demo"
    )
    text = made.config.read_text()
    (tmp_path / "secret").write_text(PASSWORD)
    made.config.write_text(
        text.replace("[mqtt]\n", "[mqtt]\nusername = 'skin'\npassword_file = 'secret'\n")
        + "\n[processing.calibration]\nseconds = 1.0\n"
    )
    yield made
    made.kill()


@pytest.fixture
def subscriber(broker: Mosquitto) -> Iterator[Subscriber]:
    listening = Subscriber(broker.host, broker.port, "skin/#")
    yield listening
    listening.close()


def calibrated(subscriber: Subscriber) -> dict[str, Any] | None:
    """The last record of the hand, if it is well."""
    records = [
        one for one in subscriber.documents("left_hand/health") if one["state"] in ("ok", "warning")
    ]
    return records[-1] if records else None


def test_sighup_reads_the_configuration_and_leaves_boards_and_calibration(
    stack: Stack, subscriber: Subscriber
) -> None:
    daemon = stack.start("run", str(stack.config))
    before = wait_for(lambda: calibrated(subscriber), "a hand that is well")
    stack.config.write_text(stack.config.read_text() + "\n[processing.touch]\nmargin_units = 7\n")
    daemon.send_signal(signal.SIGHUP)
    said = stack.directory / "0.log"
    wait_for(lambda: " read again" in said.read_text(), "a reload", said.read_text)

    reports = len(subscriber.payloads("left_hand/health"))
    wait_for(lambda: len(subscriber.payloads("left_hand/health")) > reports + 2, "more health")
    after = wait_for(lambda: calibrated(subscriber), "health after the reload")
    assert after["calibration"] == before["calibration"]
    # A set-up would have taken what touches the skin for its zero.
    (board,) = after["boards"]
    for name in ("configurations", "rezeros", "silences", "resets", "lost_set_ups"):
        assert board[name] == before["boards"][0][name], name
    assert board["configurations"] == 1
    stack.config.write_text("nonsense")
    daemon.send_signal(signal.SIGHUP)
    wait_for(lambda: "not reloaded: " in said.read_text(), "a refusal", said.read_text)
    frames = len(subscriber.payloads("left_hand/frame"))
    wait_for(lambda: len(subscriber.payloads("left_hand/frame")) > frames + 10, "more frames")
    assert stack.stop() == [0]


def test_the_password_is_neither_said_nor_shown(stack: Stack, subscriber: Subscriber) -> None:
    daemon = stack.start("run", str(stack.config))
    wait_for(lambda: calibrated(subscriber), "a hand that is well")
    url = f"mqtt://{stack.broker.host}:{stack.broker.port}"
    shown = [
        subprocess.run(
            [sys.executable, "-m", "skin_host", *words],
            cwd=ROOT,
            check=False,
            capture_output=True,
            text=True,
        ).stdout
        for words in (
            ["check", str(stack.config), "--json"],
            ["status", "--broker", url, "--json"],
            ["command", "status", "--broker", url, "--json"],
        )
    ]
    assert all(map(json.loads, shown))
    proc = Path("/proc", str(daemon.pid))
    shown += [(proc / "cmdline").read_text(), (proc / "environ").read_text()]
    assert stack.stop() == [0]
    subscriber.catch_up()
    shown += [said.read_text() for said in stack.directory.glob("*.log")]
    shown += [file.read_text() for file in stack.state.rglob("*") if file.is_file()]
    published = b"\n".join(subscriber.payloads(""))
    assert b"skin.info" in published
    assert b"skin.result" in published
    assert PASSWORD not in "\n".join(shown)
    assert PASSWORD.encode() not in published
