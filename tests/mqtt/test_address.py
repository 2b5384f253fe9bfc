"""How to reach a broker: settings and URLs, and what is wrong in them is named."""

import os
from pathlib import Path
from typing import Any

import pytest

from skin_host.config.settings import Mqtt
from skin_host.errors import ConfigurationError, RequestError
from skin_host.mqtt.address import Broker


def test_a_url_gives_everything() -> None:
    broker, base = Broker.from_url("mqtts://anna:p%40ss@robot.local/lab/skin")
    assert (broker.host, broker.port, broker.username) == ("robot.local", 8883, "anna")
    assert broker.password == "p@ss"
    assert broker.tls is not None
    assert base == "lab/skin"
    assert "p@ss" not in repr(broker) + str(broker)


def test_a_short_url_is_filled_up() -> None:
    broker, base = Broker.from_url("mqtt://robot", "3.1.1")
    assert (broker.port, broker.tls, broker.v5, base) == (1883, None, False, "")


@pytest.mark.parametrize(("query", "protocol"), [("", "5"), ("3.1.1", "3.1.1"), ("5", "5")])
def test_a_url_can_name_the_protocol(query: str, protocol: str) -> None:
    url = "mqtt://robot/lab" + (f"?protocol={query}" if query else "")
    broker, base = Broker.from_url(url)
    assert (broker.protocol, base) == (protocol, "lab")


@pytest.mark.parametrize(
    "url",
    [
        *("http://x", "x", "mqtt://", "mqtt://x:y", "mqtt://u:secret@"),
        *("mqtt://u:secret@x?protocol=4", "mqtt://u:secret@x?a=b"),
    ],
)
def test_what_is_no_such_url_is_refused_without_repeating_it(url: str) -> None:
    with pytest.raises(RequestError, match="wanted mqtt://") as raised:
        Broker.from_url(url)
    assert "secret" not in str(raised.value)


def test_the_password_is_read_from_its_file(tmp_path: Path) -> None:
    (tmp_path / "password").write_text("sesame\n")
    keys = Mqtt(username="anna", password_file="password")
    assert Broker.from_settings(keys, tmp_path).password == "sesame"


def test_the_password_is_read_from_the_credential(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("CREDENTIALS_DIRECTORY", os.fspath(tmp_path))
    assert Broker.from_settings(Mqtt(username="anna")).password is None
    (tmp_path / "mqtt-password").write_text("sesame")
    assert Broker.from_settings(Mqtt(username="anna")).password == "sesame"
    assert Broker.from_settings(Mqtt()).password is None


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ({"password_file": "p"}, "mqtt.password_file: needs mqtt.username"),
        ({"username": "u", "password_file": "none"}, "mqtt.password_file: .*none: No such file"),
        ({"username": "u", "password_file": "bytes"}, "mqtt.password_file: .*: not UTF-8"),
        ({"ca_file": "junk"}, "mqtt.ca_file: is given, but mqtt.tls is not true"),
        ({"tls": True, "ca_file": "none"}, "mqtt.ca_file: .*none: cannot be read"),
        ({"tls": True, "ca_file": "junk"}, "mqtt.ca_file: not usable for TLS"),
        ({"tls": True, "key_file": "junk"}, "mqtt.key_file: needs mqtt.certificate_file"),
        ({"tls": True, "certificate_file": "junk"}, "mqtt.certificate_file: not usable for TLS"),
    ],
)
def test_a_file_that_cannot_be_used_is_named(
    tmp_path: Path, keys: dict[str, Any], message: str
) -> None:
    (tmp_path / "junk").write_text("junk")
    (tmp_path / "bytes").write_bytes(b"\xff\xfe")
    with pytest.raises(ConfigurationError, match=message):
        Broker.from_settings(Mqtt(**keys), tmp_path)
