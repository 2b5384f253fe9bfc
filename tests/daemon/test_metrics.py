"""The metrics are for programs of this computer, and for no page of another site."""

import pytest

from skin_host.daemon.metrics import _response

PATH = b"GET /metrics HTTP/1.1\r\n"


def status(*headers: bytes) -> bytes:
    """The first line of the answer to a request with these headers."""
    request = PATH + b"".join(header + b"\r\n" for header in headers) + b"\r\n"
    return _response(request, dict).partition(b"\r\n")[0]


@pytest.mark.parametrize(
    "host",
    [b"localhost:9464", b"LOCALHOST", b"127.0.0.1:9464", b"[::1]:9464", b"192.168.1.7"],
)
def test_a_program_that_names_an_address_or_this_computer_is_answered(host: bytes) -> None:
    assert status(b"Host: " + host, b"Accept: */*") == b"HTTP/1.0 200 OK"
    assert status(b"HOST:" + host) == b"HTTP/1.0 200 OK"


def test_a_program_of_http_1_0_names_no_host() -> None:
    assert status() == b"HTTP/1.0 200 OK"


@pytest.mark.parametrize(
    "headers",
    [
        [b"Host: evil.example:9464"],
        [b"Host: localhost.evil.example"],
        [b"Host: 127.0.0.1.evil.example"],
        [b"host: evil.example"],
        [b"Host: localhost", b"Host: evil.example"],
        [b"Host: "],
        [b"Host: [::1"],
        [b"Host: \xff"],
    ],
)
def test_a_page_whose_name_was_made_to_point_here_is_refused(headers: list[bytes]) -> None:
    """A browser asks under the name of the page's site, whatever address that has by now."""
    assert status(*headers) == b"HTTP/1.0 403 Forbidden"
