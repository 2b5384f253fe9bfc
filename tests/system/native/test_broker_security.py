"""A broker with TLS, passwords and access rules: nobody gets in, and what is wrong is said."""

import asyncio
import logging
import os
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from skin_host.client import Broker, SkinClient
from skin_host.config.settings import Mqtt
from skin_host.errors import BrokerError
from skin_host.mqtt.publisher import Publisher
from skin_host.processing.events import Touch
from tests.support import programs
from tests.support.broker import Mosquitto
from tests.support.certificates import authority, certificate
from tests.support.said import touch_event

PATIENCE_S = 30.0
PASSWORD = "open-sesame"


async def until(condition: Callable[[], object]) -> None:
    async with asyncio.timeout(PATIENCE_S):
        while not condition():  # noqa: ASYNC110
            await asyncio.sleep(0.02)


def touch(number: int) -> Touch:
    return touch_event("begin", number, number, number, "palm", [1], None, None, 1, 1.0, 1.0, 0.1)


@pytest.fixture(scope="module")
def certificates(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An authority, another one, and certificates of the broker: good, expired, of another name."""
    folder = tmp_path_factory.mktemp("certificates")
    for name in ("ca", "other"):
        authority(folder, name)
    certificate(folder, "good", "IP:127.0.0.1")
    certificate(folder, "expired", "IP:127.0.0.1", days=-1)
    certificate(folder, "stranger", "DNS:example.org")
    return folder


@pytest.fixture
def start(tmp_path: Path) -> Iterator[Callable[[str], Mosquitto]]:
    """Start a broker with further settings."""
    brokers: list[Mosquitto] = []

    def start(settings: str) -> Mosquitto:
        # As root it would become another user, who cannot read pytest's folders.
        broker = Mosquitto(programs.require("mosquitto"), tmp_path, f"user root\n{settings}")
        brokers.append(broker)
        broker.start()
        return broker

    yield start
    for broker in brokers:
        broker.kill()


def tls(certificates: Path, name: str) -> str:
    return (
        f"cafile {certificates}/ca.crt\ncertfile {certificates}/{name}.crt\n"
        f"keyfile {certificates}/{name}.key\n"
    )


def secured(tmp_path: Path, rules: str) -> str:
    """Settings of a broker that knows the user `skin`, and his rules."""
    passwords, access = tmp_path / "passwords", tmp_path / "access"
    subprocess.run(
        [programs.require("mosquitto_passwd"), "-b", "-c", passwords, "skin", PASSWORD], check=True
    )
    access.write_text(f"user skin\n{rules}\n")
    return f"allow_anonymous false\npassword_file {passwords}\nacl_file {access}\n"


def settings(broker: Mosquitto, **keys: Any) -> Mqtt:
    return Mqtt(host=broker.host, port=broker.port, **keys)


async def test_everything_goes_over_tls(
    certificates: Path, start: Callable[[str], Mosquitto]
) -> None:
    keys = settings(start(tls(certificates, "good")), tls=True, ca_file="ca.crt")
    async with Publisher(keys, "robot", folder=certificates) as publisher:
        async with SkinClient(Broker.from_settings(keys, certificates), robot="robot") as skin:
            touches = skin.touches()
            await skin.ready()
            publisher.put_touch(touch(1))
            assert (await asyncio.wait_for(anext(touches), PATIENCE_S)).count == 1


@pytest.mark.parametrize(
    ("certificate", "authority", "why"),
    [
        ("good", "other.crt", "certificate"),
        ("expired", "ca.crt", "expired"),
        ("stranger", "ca.crt", "127.0.0.1"),
    ],
)
async def test_a_broker_that_cannot_prove_itself_gets_nothing(
    certificates: Path,
    start: Callable[[str], Mosquitto],
    caplog: pytest.LogCaptureFixture,
    certificate: str,
    authority: str,
    why: str,
) -> None:
    keys = settings(start(tls(certificates, certificate)), tls=True, ca_file=authority)
    async with Publisher(keys, "robot", folder=certificates, drain_s=0.0) as publisher:
        publisher.put_touch(touch(1))
        await until(lambda: publisher.counters.last_error)
        await asyncio.sleep(1.0)  # several attempts
        assert why in publisher.counters.last_error
        assert publisher.counters.connections == 0
    warnings = [r for r in caplog.records if r.levelno >= logging.WARNING and why in r.getMessage()]
    assert len(warnings) == 1


async def test_a_plain_client_of_a_tls_broker_goes_on_trying(
    certificates: Path, start: Callable[[str], Mosquitto]
) -> None:
    keys = settings(start(tls(certificates, "good")))
    async with Publisher(keys, "robot", drain_s=0.0) as publisher:
        await until(lambda: publisher.counters.last_error)
        assert not publisher.counters.connected


async def test_a_tls_broker_that_freezes_is_survived(
    certificates: Path, start: Callable[[str], Mosquitto]
) -> None:
    broker = start(tls(certificates, "good"))
    keys = settings(broker, tls=True, ca_file="ca.crt")
    async with Publisher(keys, "robot", folder=certificates) as publisher:
        await until(lambda: publisher.counters.connected)
        broker.freeze()
        publisher.put_touch(touch(1))
        await until(lambda: not publisher.counters.connected)
        await asyncio.sleep(4.0)  # a handshake that nobody answers
        broker.resume()
        await until(lambda: publisher.counters.touches_sent == 1)


async def test_the_password_comes_from_a_file_and_is_never_shown(
    tmp_path: Path,
    start: Callable[[str], Mosquitto],
    caplog: pytest.LogCaptureFixture,
) -> None:
    broker = start(secured(tmp_path, "topic readwrite skin/#"))
    (tmp_path / "password").write_text(f"{PASSWORD}\n")
    keys = settings(broker, username="skin", password_file="password")
    async with Publisher(keys, "robot", folder=tmp_path) as publisher:
        await until(lambda: publisher.counters.connected)
    assert PASSWORD not in repr(Broker.from_settings(keys, tmp_path))
    assert PASSWORD not in caplog.text


async def test_the_password_comes_from_a_credential_of_systemd(
    tmp_path: Path, start: Callable[[str], Mosquitto], monkeypatch: pytest.MonkeyPatch
) -> None:
    broker = start(secured(tmp_path, "topic readwrite skin/#"))
    (tmp_path / "mqtt-password").write_text(PASSWORD)
    monkeypatch.setenv("CREDENTIALS_DIRECTORY", os.fspath(tmp_path))
    async with Publisher(settings(broker, username="skin"), "robot") as publisher:
        await until(lambda: publisher.counters.connected)


async def test_a_wrong_password_is_named_as_such(
    tmp_path: Path, start: Callable[[str], Mosquitto]
) -> None:
    broker = start(secured(tmp_path, "topic readwrite skin/#"))
    (tmp_path / "password").write_text("guess")
    keys = settings(broker, username="skin", password_file="password")
    async with Publisher(keys, "robot", folder=tmp_path) as publisher:
        await until(lambda: publisher.counters.last_error)
        assert "check mqtt.username and its password" in publisher.counters.last_error
    with pytest.raises(BrokerError, match="refuses us"):
        async with SkinClient(Broker.from_settings(keys, tmp_path), robot="robot"):
            pass


async def test_publications_that_the_rules_forbid_are_counted_and_told(
    tmp_path: Path, start: Callable[[str], Mosquitto], caplog: pytest.LogCaptureFixture
) -> None:
    broker = start(secured(tmp_path, "topic readwrite skin/robot/nodes/#"))
    (tmp_path / "password").write_text(PASSWORD)
    keys = settings(broker, username="skin", password_file="password")
    async with Publisher(keys, "robot", folder=tmp_path) as publisher:
        await until(lambda: publisher.counters.connected)
        for number in range(3):
            publisher.put_contact("palm", "ON" if number % 2 else "OFF")
            publisher.put_touch(touch(number))
            await asyncio.sleep(0.1)
        await until(lambda: publisher.counters.refused == 6)
        assert publisher.counters.connected
    told = [record for record in caplog.records if "check its access rules" in record.getMessage()]
    assert len(told) == 1
