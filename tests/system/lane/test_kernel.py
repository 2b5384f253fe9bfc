"""The lane's kernel has what the other tests here stand on."""

import os
import socket
import subprocess

import pytest

from tests.support.vcan import Vcan


def test_a_process_may_offer_a_character_device() -> None:
    os.close(os.open("/dev/cuse", os.O_RDWR))


def test_a_raw_socket_opens_on_an_interface(vcan: Vcan) -> None:
    with socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW) as raw:
        raw.bind((vcan.name,))
        assert raw.send(bytes(16)) == 16


def test_an_interface_that_is_down_refuses_frames(vcan: Vcan) -> None:
    with socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW) as raw:
        raw.bind((vcan.name,))
        vcan.down()
        with pytest.raises(OSError, match="Network is down"):
            raw.send(bytes(16))
        vcan.up()


def test_a_removed_interface_is_gone_and_comes_back_under_its_name(vcan: Vcan) -> None:
    vcan.remove()
    assert vcan.name not in [name for _, name in socket.if_nameindex()]
    vcan.add()
    assert vcan.name in [name for _, name in socket.if_nameindex()]


def test_a_root_may_take_a_receive_buffer_of_any_size(vcan: Vcan) -> None:
    so_rcvbufforce = 33
    with socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW) as raw:
        raw.setsockopt(socket.SOL_SOCKET, so_rcvbufforce, 8 << 20)
        assert raw.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF) == 16 << 20


def test_the_file_system_can_be_written(tmp_path: os.PathLike[str]) -> None:
    written = subprocess.run(
        ["sh", "-c", f"echo here >{tmp_path}/a; cat {tmp_path}/a"], check=True, capture_output=True
    )
    assert written.stdout == b"here\n"
