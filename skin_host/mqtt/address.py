"""Address of a broker, from settings or a URL, with our name at it, and TLS.

The password comes from a file or from systemd's credentials and is never shown.
"""

import os
import ssl
from dataclasses import dataclass, field, replace
from hashlib import sha256
from pathlib import Path
from typing import TYPE_CHECKING, Literal
from urllib.parse import SplitResult, unquote, urlsplit

from skin_host.config.fields import host_and_port
from skin_host.errors import BusyFileError, ConfigurationError, RequestError
from skin_host.files import read_whole

if TYPE_CHECKING:
    from skin_host.config.settings import Mqtt


#: Of a text in MQTT.
MAX_BYTES = 65_535


class CredentialError(ConfigurationError):
    """The file with the password cannot be read, which may change."""


@dataclass(frozen=True)
class Broker:
    """How to reach a broker. The password is never shown.

    Raises:
        RequestError: name or password cannot be sent.
    """

    host: str = "localhost"
    port: int = 1883
    protocol: Literal["5", "3.1.1"] = "5"
    username: str | None = None
    password: str | None = field(default=None, repr=False)
    tls: ssl.SSLContext | None = field(default=None, repr=False)
    keepalive_s: int = 10

    def __post_init__(self) -> None:
        for what, text in (("user name", self.username), ("password", self.password)):
            size = len((text or "").encode(errors="surrogatepass"))
            if size > MAX_BYTES:
                raise RequestError(
                    f"the {what} at the broker has {size} bytes; wanted at most {MAX_BYTES}"
                )
        if "\0" in (self.username or ""):
            raise RequestError("the user name at the broker has a zero byte; wanted none")

    def __str__(self) -> str:
        return f"{self.host}:{self.port}"

    @property
    def v5(self) -> bool:
        """Whether messages have properties."""
        return self.protocol == "5"

    @classmethod
    def from_settings(cls, settings: "Mqtt", folder: Path = Path()) -> "Broker":
        """Read the files that `settings` name; relative names start in `folder`.

        Raises:
            CredentialError: the password cannot be read.
            ConfigurationError: one of them cannot be used.
        """
        for key, what in settings.wrong_values():
            raise ConfigurationError(f"mqtt.{key}: {what}")
        return cls(
            settings.host,
            settings.port,
            settings.protocol,
            settings.username,
            _password(settings, folder),
            _tls(settings, folder),
            settings.keepalive_s,
        )

    @classmethod
    def all_from_settings(
        cls, settings: "Mqtt", folder: Path = Path(), name: str = ""
    ) -> list["Broker"]:
        """Return the brokers of `settings`, in the order in which a node of this name tries them.

        Each name has a different order, so that nodes spread over the brokers, and those of a lost
        broker over all others.

        Raises:
            see `from_settings`.
        """
        first = cls.from_settings(settings, folder)
        if not settings.brokers:
            return [first]
        ends = [host_and_port(address, settings.port) for address in settings.brokers]
        brokers = [replace(first, host=host, port=port) for host, port in ends]
        return sorted(brokers, key=lambda one: sha256(f"{name}|{one}".encode()).digest())

    @classmethod
    def from_url(cls, url: str, protocol: Literal["5", "3.1.1"] = "5") -> tuple["Broker", str]:
        """Read `mqtt://[user[:password]@]host[:port][/base][?protocol=3.1.1]`; `mqtts` is TLS.

        Args:
            url: the URL.
            protocol: of MQTT, unless the URL names one.

        Returns:
            the broker, and the base of the topics ("" if the URL has none).

        Raises:
            RequestError: it is not such a URL.
        """
        wanted = "wanted mqtt://[user@]host[:port][/base][?protocol=3.1.1] or mqtts://..."
        try:
            parts = urlsplit(url)
            port = parts.port
        except ValueError as error:
            raise RequestError(f"the URL of the broker: {error}; {wanted}") from None
        if parts.scheme not in ("mqtt", "mqtts") or not parts.hostname:
            # The URL may hold a password, so it is not repeated here.
            seen = f'begins with "{parts.scheme}:"' if "://" in url else 'has no "mqtt://"'
            if parts.scheme in ("mqtt", "mqtts") and "://" in url:
                seen = "names no host"
            raise RequestError(f"the URL of the broker {seen}; {wanted}")
        match parts.query:
            case "":
                pass
            case "protocol=3.1.1":
                protocol = "3.1.1"
            case "protocol=5":
                protocol = "5"
            case query:
                raise RequestError(f'the URL of the broker ends with "?{query}"; {wanted}')
        secure = parts.scheme == "mqtts"
        broker = cls(
            parts.hostname,
            port or (8883 if secure else 1883),
            protocol,
            username=unquote(parts.username) if parts.username else None,
            password=unquote(parts.password) if parts.password else _from_environment(parts),
            tls=_default_context() if secure else None,
        )
        return broker, unquote(parts.path).strip("/")


def _from_environment(parts: SplitResult) -> str | None:
    """Return the password of a URL with a user but without one, because process lists show URLs.

    Raises:
        RequestError: the file that the environment names cannot be read.
    """
    file = os.environ.get("SKIN_MQTT_PASSWORD_FILE")
    if not parts.username:
        return None
    if file is None:
        return os.environ.get("SKIN_MQTT_PASSWORD")
    try:
        return read_whole(Path(file)).decode().rstrip("\r\n")
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "not UTF-8"
        raise RequestError(f"SKIN_MQTT_PASSWORD_FILE: {file}: {reason}") from None


def _password(settings: "Mqtt", folder: Path) -> str | None:
    if settings.password_file is not None:
        path = folder / settings.password_file
    else:
        credentials = os.environ.get("CREDENTIALS_DIRECTORY")
        if credentials is None or settings.username is None:
            return None
        path = Path(credentials) / "mqtt-password"
        if not path.exists():
            return None
    try:
        password = read_whole(path).decode().rstrip("\r\n")
    except BusyFileError as error:
        raise CredentialError(f"mqtt.password_file: {error}") from None
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "not UTF-8"
        raise CredentialError(f"mqtt.password_file: {path}: {reason}") from None
    return password or None


class _TlsSocket(ssl.SSLSocket):
    """A socket that closes itself, because paho leaves it open when the handshake fails."""

    def do_handshake(self, block: bool = False) -> None:
        try:
            super().do_handshake(block)
        except OSError:
            self.close()
            raise


def _default_context(ca_file: Path | None = None) -> ssl.SSLContext:
    context = ssl.create_default_context(cafile=ca_file)
    context.sslsocket_class = _TlsSocket
    return context


def _tls(settings: "Mqtt", folder: Path) -> ssl.SSLContext | None:
    files = {
        "ca_file": settings.ca_file,
        "certificate_file": settings.certificate_file,
        "key_file": settings.key_file,
    }
    if not settings.tls:
        return None
    for key, name in files.items():
        if name is None:
            continue
        try:
            read_whole(folder / name)  # OpenSSL would wait for ever for a pipe that nobody writes
        except OSError as error:
            raise ConfigurationError(
                f"mqtt.{key}: {folder / name}: cannot be read: {error.strerror}"
            ) from None
    where = "ca_file"
    try:
        context = _default_context(folder / settings.ca_file if settings.ca_file else None)
        if settings.certificate_file is not None:
            where = "certificate_file"
            key_file = None if settings.key_file is None else folder / settings.key_file
            # If no password is given, OpenSSL would ask for one on the terminal.
            context.load_cert_chain(folder / settings.certificate_file, key_file, password="")
    except (OSError, ValueError) as error:
        raise ConfigurationError(f"mqtt.{where}: not usable for TLS: {error}") from None
    return context
