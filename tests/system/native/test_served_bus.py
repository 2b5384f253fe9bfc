"""A server of buses on another computer, whose cable is cut: no packet comes back."""

import sys
from contextlib import ExitStack
from pathlib import Path

from tests.support.netns import HERE, THERE, THERE_ADDRESS, Process, cable, two_computers

PORT = 28600
#: It is reported after 5 s, and looked for every second; a busy computer takes longer.
PATIENCE_S = 60.0
SERVER = f"""
import socket, threading

def serve(client):
    for answer in (b"< hi >", b"< ok >", b"< ok >"):
        client.sendall(answer)
        client.recv(1000)
    while client.recv(1000):
        pass

server = socket.create_server(("{THERE_ADDRESS}", {PORT}))
print("listening", flush=True)
while True:
    threading.Thread(target=serve, args=server.accept()[:1], daemon=True).start()
"""
#: One bus only reads; to the other a command is sent each second, as to boards that are silent.
CLIENT = f"""
import asyncio, contextlib, itertools, logging, sys
from skin_host.bus.opening import open_port
from skin_host.config.settings import Bus, Receive
from skin_host.errors import BusError

async def live():
    logging.basicConfig(level=logging.INFO, stream=sys.stdout, format="%(message)s")
    options = {{"host": "{THERE_ADDRESS}", "port": {PORT}}}
    ports = [
        open_port(name, Bus(interface="socketcand", channel=name, options=options), Receive())
        for name in ("can0", "can1")
    ]
    print("open", flush=True)
    for turn in itertools.count():
        for port in ports:
            port.read()
        if turn % 50 == 0:
            with contextlib.suppress(BusError):
                await ports[1].send([(0x20E, bytes(2))])
        await asyncio.sleep(0.02)

asyncio.run(live())
"""


def test_a_server_of_buses_that_is_cut_off_is_reported_and_connected_to_again(
    tmp_path: Path,
) -> None:
    with two_computers(), ExitStack() as stack:
        server = Process(stack, THERE, tmp_path / "server", sys.executable, "-uc", SERVER)
        server.wait_for("listening", PATIENCE_S)
        client = Process(stack, HERE, tmp_path / "client", sys.executable, "-uc", CLIENT)
        client.wait_for("open", PATIENCE_S)
        cable(up=False)
        for bus in ("can0", "can1"):
            client.wait_for(f"{bus} is gone", PATIENCE_S)
        cable(up=True)
        for bus in ("can0", "can1"):
            client.wait_for(f"{bus} is up", PATIENCE_S)
