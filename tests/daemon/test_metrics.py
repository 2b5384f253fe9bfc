"""The metrics are for programs of this computer, and for no page of another site."""

import asyncio
import errno
import os
import resource
import socket

import pytest

from skin_host import acceptor
from skin_host.daemon import metrics
from skin_host.daemon.metrics import _response
from tests.support.broker import free_port
from tests.support.waiting import until

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


async def test_a_scraper_that_comes_while_no_more_files_may_be_open_costs_one_line(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """asyncio's own server tries as often as its queue is long, each second, and writes a traceback
    for each of these, ever more.
    """
    monkeypatch.setattr(acceptor, "RETRY_S", 0.05)
    port = free_port()
    serving = asyncio.create_task(metrics.serve(port, dict))
    scrapers = [socket.socket() for _ in range(3)]
    for one in scrapers:
        one.setblocking(False)
    loop = asyncio.get_running_loop()

    async def scrape(scraper: socket.socket) -> bytes:
        """Return the answer, up to the end of the connection."""
        await until(lambda: scraper.connect_ex(("127.0.0.1", port)) in {0, errno.EISCONN})
        await loop.sock_sendall(scraper, PATH + b"\r\n")
        found = b""
        while piece := await loop.sock_recv(scraper, 10_000):
            found += piece
        return found

    assert (await scrape(scrapers[0])).startswith(b"HTTP/1.0 200")
    lowest = os.dup(0)
    os.close(lowest)
    before = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (lowest, before[1]))
    try:
        scrapers[1].connect_ex(("127.0.0.1", port))
        await until(lambda: caplog.records)
        for _ in range(50):
            await asyncio.sleep(0.01)
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, before)
    assert len(caplog.records) == 1
    assert "metrics on 127" in caplog.text and "Too many open files" in caplog.text
    assert (await scrape(scrapers[2])).startswith(b"HTTP/1.0 200")
    serving.cancel()
    await asyncio.gather(serving, return_exceptions=True)
    for one in scrapers:
        one.close()
