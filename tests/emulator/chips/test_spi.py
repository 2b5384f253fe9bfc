"""The AD7147 on SPI, as Linux's ad714x-spi.c and spidev's users drive it."""

from emulator.chips.ad7147 import AD7147
from emulator.chips.spi import EmulatedSpi

PREFIX, READ = 0xE000, 1 << 10


def write(spi: EmulatedSpi, address: int, *words: int) -> list[int]:
    return spi.xfer2(b"".join(word.to_bytes(2) for word in (PREFIX | address, *words)))


def read(spi: EmulatedSpi, address: int, n: int = 1) -> list[int]:
    data = bytes(spi.xfer2([*(PREFIX | READ | address).to_bytes(2), *bytes(2 * n)]))
    return [int.from_bytes(data[at : at + 2]) for at in range(2, len(data), 2)]


def test_a_probe_finds_the_part() -> None:
    assert read(EmulatedSpi(AD7147()), 0x017) == [0x1471]


def test_words_are_written_and_read_one_after_the_other() -> None:
    spi = EmulatedSpi(AD7147())
    assert write(spi, 0x080, 0xFFFE, 0x1FFF, 0x2200) == [0xFF] * 8
    assert read(spi, 0x080, 3) == [0xFFFE, 0x1FFF, 0x2200]


def test_nothing_is_driven_while_the_command_is_sent() -> None:
    spi = EmulatedSpi(AD7147())
    assert spi.xfer2([0xE4, 0x17, 0, 0]) == [0xFF, 0xFF, 0x14, 0x71]


def test_frames_that_are_no_command_change_nothing() -> None:
    spi = EmulatedSpi(AD7147())
    write(spi, 0x080, 0x1234)
    for frame in ([], [0xE0], [0x60, 0x80, 0xAB, 0xCD], [0xE0, 0x80, 0xAB]):
        assert spi.xfer2(frame) == [0xFF] * len(frame)
    assert read(spi, 0x080) == [0x1234]


def test_what_is_written_behind_the_map_is_lost() -> None:
    spi = EmulatedSpi(AD7147())
    spi.writebytes([0xE2, 0x90, 0xAB, 0xCD, 0xEF, 0x01])
    assert read(spi, 0x290, 2) == [0, 0]
    assert read(spi, 0x000) == [0]
