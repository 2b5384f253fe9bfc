"""Runs conformance scripts: what drivers do to an AD7147, and what they must see.

A script is a TOML file with `about`, `source`, `resting_ff` and `steps`. It runs on any smbus2
bus; `Bench` stands for the hand that touches pads and the meter at the INT pin. Steps by `op`:

    ping        address the chip and stop
    write       `words` from register `at` on, as one burst or `singly`; `read_back` compares
                each word; `refused` expects the last byte to go unacknowledged
    read        `count` words from `at` on, combined or `split` (STOP between address and
                data), as one burst or `singly`; checked by `expect` (under `mask`) or
                `between`; `store` keeps them under a name, appending
    response    |code - ambient| of the stored words: the stages of `order` lead, strongest
                first, all others stay below `others_below`
    rise        stored `now` minus `since`: at least `at_least` at `at_index`, else below
                `others_below`
    wait        let `ms` pass
    touch       raise input `cin` by `by_ff` above rest
    interrupt   whether INT is asserted

Run it on a chip: `python -m tests.support.conformance /dev/i2c-1 0x2c`. Without a bench a
script ends at the first step that needs one.
"""

import argparse
import sys
import time
from pathlib import Path
from typing import Protocol

import msgspec
from smbus2 import SMBus, i2c_msg

from emulator.chips.ad7147 import AD7147

SCRIPTS = sorted(Path(__file__).parent.parent.glob("emulator/chips/conformance/*.toml"))


class Ping(msgspec.Struct, tag_field="op", tag="ping", forbid_unknown_fields=True):
    """Address the chip."""


class Write(msgspec.Struct, tag_field="op", tag="write", forbid_unknown_fields=True):
    """Write registers."""

    at: int
    words: list[int]
    singly: bool = False
    read_back: bool = False
    refused: bool = False


class Read(msgspec.Struct, tag_field="op", tag="read", forbid_unknown_fields=True):
    """Read registers and check them."""

    at: int
    count: int = 0
    expect: list[int] = []
    mask: int = 0xFFFF
    between: tuple[int, int] = (0, 0xFFFF)
    singly: bool = False
    split: bool = False
    store: str = ""


class Response(msgspec.Struct, tag_field="op", tag="response", forbid_unknown_fields=True):
    """Compare stored codes and ambient values."""

    order: list[int]
    others_below: int


class Rise(msgspec.Struct, tag_field="op", tag="rise", forbid_unknown_fields=True):
    """Compare two stored readings."""

    since: str
    now: str
    at_index: int
    at_least: int
    others_below: int


class Wait(msgspec.Struct, tag_field="op", tag="wait", forbid_unknown_fields=True):
    """Let time pass."""

    ms: float


class Touch(msgspec.Struct, tag_field="op", tag="touch", forbid_unknown_fields=True):
    """Touch or release a pad."""

    cin: int
    by_ff: float


class Interrupt(msgspec.Struct, tag_field="op", tag="interrupt", forbid_unknown_fields=True):
    """Look at the INT pin."""

    expect: bool


Step = Ping | Write | Read | Response | Rise | Wait | Touch | Interrupt


class Script(msgspec.Struct, forbid_unknown_fields=True):
    """One driver's conversation with the chip."""

    about: str
    source: str
    resting_ff: float
    steps: list[Step]


class MismatchError(Exception):
    """The chip did not do what the script wants; the message names the step."""


class Bench(Protocol):
    """The world around the chip."""

    def wait(self, seconds: float) -> None:
        """Let time pass."""
        ...

    def touch(self, cin: int, capacitance_ff: float) -> None:
        """Give an input this capacitance."""
        ...

    def interrupt(self) -> bool:
        """Whether INT is asserted."""
        ...


class EmulatedBench:
    """The world around an emulated chip."""

    def __init__(self, chip: AD7147) -> None:
        self._chip = chip

    def wait(self, seconds: float) -> None:
        """Let the chip's time pass."""
        self._chip.advance(seconds)

    def touch(self, cin: int, capacitance_ff: float) -> None:
        """Set an input's capacitance."""
        self._chip.set_capacitance_ff(cin, capacitance_ff)

    def interrupt(self) -> bool:
        """Read the INT output."""
        return self._chip.interrupt


def load(path: Path) -> Script:
    """Read a script."""
    return msgspec.toml.decode(path.read_bytes(), type=Script)


def run(script: Script, bus: SMBus, address: int, bench: Bench | None) -> int:
    """Run a script against the chip at `address`; answers how many steps were made.

    Raises:
        MismatchError: a step saw something else than it wants.
    """
    player = _Player(bus, address, bench)
    if bench is not None:
        for cin in range(13):
            bench.touch(cin, script.resting_ff)
    for number, step in enumerate(script.steps):
        if bench is None and isinstance(step, Touch | Interrupt):
            return number
        try:
            player.play(step, script.resting_ff)
        except (MismatchError, OSError) as error:
            raise MismatchError(f"step {number}, {step}: {error}") from error
    return len(script.steps)


class _Player:
    def __init__(self, bus: SMBus, address: int, bench: Bench | None) -> None:
        self._bus = bus
        self._address = address
        self._bench = bench
        self._stored: dict[str, list[int]] = {}

    def play(self, step: Step, resting_ff: float) -> None:
        match step:
            case Ping():
                self._bus.i2c_rdwr(i2c_msg.write(self._address, []))
            case Write():
                self._write(step)
            case Read():
                self._read(step)
            case Response():
                pairs = zip(self._stored["code"], self._stored["ambient"], strict=True)
                change = [abs(code - ambient) for code, ambient in pairs]
                leading = sorted(range(len(change)), key=lambda i: -change[i])
                others = [change[i] for i in range(len(change)) if i not in step.order]
                _want(leading[: len(step.order)] == step.order, f"responses {change}")
                _want(all(value < step.others_below for value in others), f"responses {change}")
            case Rise():
                pairs = zip(self._stored[step.now], self._stored[step.since], strict=True)
                rise = [now - since for now, since in pairs]
                _want(rise.pop(step.at_index) >= step.at_least, f"rise {rise}")
                _want(all(abs(value) < step.others_below for value in rise), f"rise {rise}")
            case Wait():
                if self._bench is None:
                    time.sleep(step.ms * 1e-3)
                else:
                    self._bench.wait(step.ms * 1e-3)
            case Touch():
                assert self._bench is not None
                self._bench.touch(step.cin, resting_ff + step.by_ff)
            case Interrupt():
                assert self._bench is not None
                seen = self._bench.interrupt()
                _want(seen == step.expect, f"INT is {'asserted' if seen else 'idle'}")

    def _write(self, step: Write) -> None:
        if not step.singly:
            message = i2c_msg.write(self._address, _bytes(step.at, *step.words))
            try:
                self._bus.i2c_rdwr(message)
            except OSError:
                _want(step.refused, "not acknowledged")
            else:
                _want(not step.refused, "acknowledged")
        for i, word in enumerate(step.words):
            at = step.at + i
            if step.singly:
                self._bus.i2c_rdwr(i2c_msg.write(self._address, _bytes(at, word)))
            if step.read_back:
                seen = self._words(at, 1, split=False)
                _want(seen == [word], f"0x{at:03X} reads back {seen[0]:04X}, wanted {word:04X}")

    def _read(self, step: Read) -> None:
        count = step.count or len(step.expect)
        if step.singly:
            seen = [self._words(step.at + i, 1, step.split)[0] for i in range(count)]
        else:
            seen = self._words(step.at, count, step.split)
        low, high = step.between
        text = " ".join(f"{word:04X}" for word in seen)
        _want(all(low <= word <= high for word in seen), f"seen {text}")
        if step.expect:
            _want([word & step.mask for word in seen] == step.expect, f"seen {text}")
        if step.store:
            self._stored.setdefault(step.store, []).extend(seen)

    def _words(self, at: int, count: int, split: bool) -> list[int]:
        address = i2c_msg.write(self._address, _bytes(at))
        answer = i2c_msg.read(self._address, 2 * count)
        if split:
            self._bus.i2c_rdwr(address)
            self._bus.i2c_rdwr(answer)
        else:
            self._bus.i2c_rdwr(address, answer)
        data = bytes(answer)
        return [int.from_bytes(data[i : i + 2], "big") for i in range(0, len(data), 2)]


def _bytes(*words: int) -> bytes:
    return b"".join(word.to_bytes(2, "big") for word in words)


def _want(condition: bool, seen: str) -> None:
    if not condition:
        raise MismatchError(seen)


def main() -> None:
    """Run all scripts on a chip behind a kernel bus, as far as they go without a finger."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("device", help="/dev/i2c-N")
    parser.add_argument("address", type=lambda text: int(text, 0), help="0x2c..0x2f")
    arguments = parser.parse_args()
    with SMBus(arguments.device) as bus:
        for path in SCRIPTS:
            script = load(path)
            done = run(script, bus, arguments.address, None)
            sys.stdout.write(f"{path.stem}: {done} of {len(script.steps)} steps passed\n")


if __name__ == "__main__":
    main()
