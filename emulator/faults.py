"""Faults by name: timed in a scene, or by command while the robot runs.

`begin` starts a fault on a robot and returns the function that ends it.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Literal, Protocol

import msgspec
import numpy as np
from numpy.typing import NDArray

from emulator.boards.chip_access import ADDRESSES, CHIPS_PER_LINE
from emulator.boards.fingertips import Fingertips
from emulator.boards.mtb import Mtb
from emulator.chips.converters import Converters
from emulator.chips.i2c_wire import FOR_EVER, DataLine
from emulator.probes.pads import UNIT_FF
from emulator.probes.scene import Fault
from emulator.probes.skin import Skin
from emulator.wire import Wire
from skin_host.config.explain import explain
from skin_host.errors import ConfigurationError, nearest
from skin_host.layout import TAXELS_PER_TRIANGLE

#: Ends a fault. Made of parts that a saved state can hold, see `emulator.state`.
Mend = Callable[[], object]


class FaultyRobot(Protocol):
    """The parts of a robot that can fail; `emulator.robot.Robot` has all of them."""

    t_ns: int
    boards: dict[str, Mtb]
    converters: Converters
    skin: Skin
    fingertips: Fingertips
    wires: dict[str, Wire]
    hung: set[int]
    late_ns: dict[int, int]
    jitter_ns: dict[int, float]

    def rewire(self, board: int, chip_of_slot: NDArray[np.intp]) -> None:
        """Plug other chips into the slots of a board, intp[20]."""

    def pass_on(self, taxels: slice) -> None:
        """Set what the chips of some taxels measure, at once."""

    def work_out_now(self) -> None:
        """Something changed that the mechanics must process at once."""


@dataclass(frozen=True, slots=True)
class Kind:
    """A kind of fault: what it does, its required keys, and the meaning of `value`.

    Attributes:
        value: if none is given.
        least, most: what `value` may be.
    """

    about: str
    needs: tuple[str, ...]
    begin: Callable[[FaultyRobot, Fault], Mend]
    value: float | None = None
    least: float = -np.inf
    most: float = np.inf


def parse(text: str) -> Fault:
    """A fault from a line such as `chip_gone board=hand triangle=3`.

    Raises:
        ConfigurationError: not such a line, or an unknown name or key.
    """
    name, *pairs = text.split() or [""]
    fields: dict[str, object] = {"name": name}
    for pair in pairs:
        key, equals, value = pair.partition("=")
        if not equals:
            raise ConfigurationError(f'"{pair}": wanted key=value')
        fields[key] = value
    try:
        fault = msgspec.convert(fields, Fault, strict=False)
    except msgspec.ValidationError as error:
        raise ConfigurationError(f'"{text}": {explain(fields, error, Fault, {})}') from None
    check(fault)
    return fault


def check(fault: Fault) -> None:
    """Check the name and that its required keys are present.

    Raises:
        ConfigurationError: names the key.
    """
    kind = KINDS.get(fault.name)
    if kind is None:
        near = nearest(fault.name, KINDS)
        meant = f"meant {near}?" if near else f"there are: {', '.join(KINDS)}"
        raise ConfigurationError(f'name: no fault "{fault.name}"; {meant}')
    for key in kind.needs:
        if getattr(fault, key) is None:
            raise ConfigurationError(f'{key}: missing; fault "{fault.name}" needs it')
    if fault.value is not None and not kind.least <= fault.value <= kind.most:
        wanted = (
            f"{kind.least:g} or more" if kind.most == np.inf else f"{kind.least:g} to {kind.most:g}"
        )
        raise ConfigurationError(f"value: {fault.value:g}; wanted {wanted}")
    if fault.until_s is not None and fault.until_s <= fault.at_s:
        raise ConfigurationError("until_s: wanted a time after at_s")


def check_targets(robot: FaultyRobot, fault: Fault) -> None:
    """Check that the robot has what the fault names.

    Raises:
        ConfigurationError: names the key.
    """
    check(fault)
    boards = list(robot.boards)
    if fault.name == "board_silent":
        boards += robot.fingertips.boards
    if fault.board is not None and fault.board not in boards:
        known = ", ".join(boards)
        raise ConfigurationError(f'board: no board "{fault.board}"; there are: {known}')
    if fault.bus is not None and fault.bus not in robot.wires:
        known = ", ".join(robot.wires)
        raise ConfigurationError(f'bus: no bus "{fault.bus}"; there are: {known}')
    if fault.triangle is not None:
        _chip(robot, fault)


def begin(robot: FaultyRobot, fault: Fault) -> Mend:
    """Start a fault now; the returned function ends it.

    Raises:
        ConfigurationError: the robot does not have what the fault names.
    """
    check_targets(robot, fault)
    kind = KINDS[fault.name]
    if fault.value is None:
        fault = msgspec.structs.replace(fault, value=kind.value)
    return kind.begin(robot, fault)


# ---------------------------------------------------------------------- chips and pads


def _board(robot: FaultyRobot, fault: Fault) -> int:
    return list(robot.boards).index(fault.board or "")


def _chip(robot: FaultyRobot, fault: Fault) -> int:
    """The chip that the fault names, as the layout numbers it."""
    number = _board(robot, fault)
    slot = robot.boards[fault.board or ""].slot(fault.triangle or 0)
    chip = int(robot.converters.chip_of_slot[number][slot])
    if chip < 0:
        raise ConfigurationError(f'triangle: {fault.triangle} is not fitted on "{fault.board}"')
    return chip


def _taxels(robot: FaultyRobot, fault: Fault) -> slice:
    first = TAXELS_PER_TRIANGLE * _chip(robot, fault)
    if fault.taxel is None:
        return slice(first, first + TAXELS_PER_TRIANGLE)
    return slice(first + fault.taxel, first + fault.taxel + 1)


def _chip_gone(robot: FaultyRobot, fault: Fault) -> Mend:
    chips = robot.converters
    chip = _chip(robot, fault)
    chips.force(chip, round(fault.value or 0))
    return partial(chips.force, chip, None)


def _chip_back(robot: FaultyRobot, fault: Fault) -> Mend:
    robot.converters.force(_chip(robot, fault), None)
    return _nothing


def _shorted_finger(robot: FaultyRobot, fault: Fault) -> Mend:
    """SDA is held low: all four chips of the line read 0, whatever they would send."""
    number = _board(robot, fault)
    chip_of_slot = robot.converters.chip_of_slot[number]
    line = robot.boards[fault.board or ""].slot(fault.triangle or 0) // CHIPS_PER_LINE
    slots = range(CHIPS_PER_LINE * line, CHIPS_PER_LINE * (line + 1))
    own = [int(chip) for chip in chip_of_slot[slots.start : slots.stop] if chip >= 0]
    _force(robot, own, 0)
    return partial(_force, robot, own, None)


def _force(robot: FaultyRobot, chips: list[int], word: int | None) -> None:
    for chip in chips:
        robot.converters.force(chip, word)


def _rewired(change: Callable[[FaultyRobot, Fault, int, np.ndarray], None]) -> Callable[..., Mend]:
    """A fault that changes which chip sits at which slot of a board."""

    def begin_rewired(robot: FaultyRobot, fault: Fault) -> Mend:
        number = _board(robot, fault)
        before = robot.converters.chip_of_slot[number].copy()
        after = before.copy()
        change(robot, fault, number, after)
        robot.rewire(number, after)
        return partial(robot.rewire, number, before)

    return begin_rewired


def _wrong_address(robot: FaultyRobot, fault: Fault, _: int, chip_of_slot: np.ndarray) -> None:
    slot = robot.boards[fault.board or ""].slot(fault.triangle or 0)
    other = _other_slot(slot, fault)
    chip_of_slot[other], chip_of_slot[slot] = chip_of_slot[slot], -1


def _other_slot(slot: int, fault: Fault) -> int:
    """The slot of another address of the same line."""
    other = slot - slot % CHIPS_PER_LINE + round(fault.value or 0) % CHIPS_PER_LINE
    if other == slot:
        raise ConfigurationError("value: is the chip's own address; wanted another one, 0 to 3")
    return other


def _swapped_lines(robot: FaultyRobot, fault: Fault, _: int, chip_of_slot: np.ndarray) -> None:
    one = robot.boards[fault.board or ""].slot(fault.triangle or 0) // CHIPS_PER_LINE
    other = round(fault.value or 0) % CHIPS_PER_LINE
    lines = chip_of_slot.reshape(-1, CHIPS_PER_LINE)
    lines[[one, other]] = lines[[other, one]]


def _stuck_taxel(robot: FaultyRobot, fault: Fault) -> Mend:
    taxels = _taxels(robot, fault)
    skin = robot.skin
    held_ff = skin.capacitance_ff[taxels].copy()
    if fault.value is not None:
        held_ff = skin.resting_ff[taxels] + fault.value
    chip = _chip(robot, fault)
    _hold(robot, chip, taxels, held_ff)
    return partial(_hold, robot, chip, taxels, np.nan)


def _hold(robot: FaultyRobot, chip: int, taxels: slice, held_ff: np.ndarray | float) -> None:
    """Let taxels of a chip measure always the same; NaN ends it."""
    robot.skin.held_ff[taxels] = held_ff
    own = slice(TAXELS_PER_TRIANGLE * chip, TAXELS_PER_TRIANGLE * (chip + 1))
    robot.converters.hold_results(chip, ~np.isnan(robot.skin.held_ff[own]))
    robot.pass_on(taxels)


def _noisy_taxel(robot: FaultyRobot, fault: Fault) -> Mend:
    return _noise(robot, fault, UNIT_FF * (fault.value or 0.0))


def _noise(robot: FaultyRobot, fault: Fault, noise_ff: float) -> Mend:
    taxels = _taxels(robot, fault)
    chip = _chip(robot, fault)
    before = robot.skin.noise_ff[taxels].copy()
    _set_noise(robot, chip, taxels, noise_ff)
    return partial(_set_noise, robot, chip, taxels, before)


def _set_noise(robot: FaultyRobot, chip: int, taxels: slice, noise_ff: np.ndarray | float) -> None:
    noise = robot.skin.noise_ff
    noise[taxels] = noise_ff
    own = slice(TAXELS_PER_TRIANGLE * chip, TAXELS_PER_TRIANGLE * (chip + 1))
    robot.converters.set_noise_ff(chip, noise[own])


def _temperature_step(robot: FaultyRobot, fault: Fault) -> Mend:
    step_c = fault.value or 0.0
    _warm(robot, step_c)
    return partial(_warm, robot, -step_c)


def _warm(robot: FaultyRobot, by_c: float) -> None:
    robot.skin.temperature_step_c += by_c
    robot.work_out_now()


# ---------------------------------------------------------------------- the wires to the chips


def _place(robot: FaultyRobot, fault: Fault) -> tuple[DataLine, int]:
    """The data line of the chip that the fault names, and its address."""
    slot = robot.boards[fault.board or ""].slot(fault.triangle or 0)
    line = robot.converters.i2c_wire(_board(robot, fault)).lines[slot // CHIPS_PER_LINE]
    return line, ADDRESSES[slot % CHIPS_PER_LINE]


def _no_acknowledge(robot: FaultyRobot, fault: Fault) -> Mend:
    line, address = _place(robot, fault)
    line.refuse(address, round(fault.value or 0))
    return partial(line.refuse, address, None)


def _clock_stretched(robot: FaultyRobot, fault: Fault) -> Mend:
    line, address = _place(robot, fault)
    line.stretch(address, round(1e3 * (fault.value or 0.0)))
    return partial(line.stretch, address, None)


def _data_held_low(robot: FaultyRobot, fault: Fault) -> Mend:
    line, _ = _place(robot, fault)
    line.hold(round(fault.value or 0) or FOR_EVER)
    return partial(line.hold, 0)


def _bit_flipped(robot: FaultyRobot, fault: Fault) -> Mend:
    line, _ = _place(robot, fault)
    line.flip(fault.value or 0.0)
    return partial(line.flip, 0.0)


def _slow_rise(robot: FaultyRobot, fault: Fault) -> Mend:
    line, _ = _place(robot, fault)
    line.rise_slowly(round(fault.value or 0))
    return partial(line.rise_slowly, 0)


def _brown_out(robot: FaultyRobot, fault: Fault) -> Mend:
    robot.converters.brown_out(_chip(robot, fault))
    return _nothing


def _shared_address(robot: FaultyRobot, fault: Fault) -> Mend:
    """The chip's own place is empty; at the other one a 0 of either chip wins."""
    number, chip = _board(robot, fault), _chip(robot, fault)
    slot = robot.boards[fault.board or ""].slot(fault.triangle or 0)
    other = _other_slot(slot, fault)
    before = robot.converters.chip_of_slot[number].copy()
    after = before.copy()
    after[slot] = -1
    robot.rewire(number, after)
    robot.converters.answer_second(number, other, chip)
    return partial(_separate, robot, number, other, before)


def _separate(robot: FaultyRobot, number: int, slot: int, before: NDArray[np.intp]) -> None:
    """Each chip answers at its own address again."""
    robot.converters.answer_second(number, slot, None)
    robot.rewire(number, before)


# ---------------------------------------------------------------------- boards and buses


def _board_reset(robot: FaultyRobot, fault: Fault) -> Mend:
    robot.boards[fault.board or ""].reset(robot.t_ns)
    return _nothing


def _board_silent(robot: FaultyRobot, fault: Fault) -> Mend:
    name = fault.board or ""
    if name in robot.fingertips.boards:
        robot.fingertips.hung.add(name)
        return partial(robot.fingertips.hung.discard, name)
    number = _board(robot, fault)
    robot.hung.add(number)
    return partial(robot.hung.discard, number)


def _late_period(robot: FaultyRobot, fault: Fault) -> Mend:
    number = _board(robot, fault)
    robot.late_ns[number] = round((fault.value or 0.0) * 1e6)
    return partial(robot.late_ns.pop, number, None)


def _jittered_period(robot: FaultyRobot, fault: Fault) -> Mend:
    number = _board(robot, fault)
    robot.jitter_ns[number] = (fault.value or 0.0) * 1e6
    return partial(robot.jitter_ns.pop, number, None)


def _frame_loss(robot: FaultyRobot, fault: Fault) -> Mend:
    wire = robot.wires[fault.bus or ""]
    wire.loss_share = fault.value or 0.0
    return partial(_clear, wire, "loss_share")


def _bit_errors(robot: FaultyRobot, fault: Fault) -> Mend:
    wire = robot.wires[fault.bus or ""]
    wire.error_share = fault.value or 0.0
    return partial(_clear, wire, "error_share")


def _bus_off(robot: FaultyRobot, fault: Fault) -> Mend:
    wire = robot.wires[fault.bus or ""]
    wire.off = True
    return partial(_clear, wire, "off")


def _babbling_node(robot: FaultyRobot, fault: Fault) -> Mend:
    wire = robot.wires[fault.bus or ""]
    wire.babble(fault.value or 0.0, robot.t_ns)
    return partial(_hush, robot, fault.bus or "")


def _hush(robot: FaultyRobot, bus: str) -> None:
    robot.wires[bus].babble(0.0, robot.t_ns)


def _clear(wire: Wire, fault: Literal["loss_share", "error_share", "off"]) -> None:
    """Restore a bus."""
    if fault == "off":
        wire.off = False
    elif fault == "loss_share":
        wire.loss_share = 0.0
    else:
        wire.error_share = 0.0


def _nothing() -> None:
    """Do nothing: the fault cannot be undone."""


_CHIP = ("board", "triangle")
KINDS: dict[str, Kind] = {
    "chip_gone": Kind(
        "a chip does not answer; value: the word that is read", _CHIP, _chip_gone, 0xFFFF
    ),
    "chip_back": Kind("a chip that was gone answers again", _CHIP, _chip_back),
    "stuck_taxel": Kind(
        "a taxel's result stays as it is; value: so many fF above rest",
        (*_CHIP, "taxel"),
        _stuck_taxel,
    ),
    "noisy_taxel": Kind(
        "a badly soldered taxel; value: rms in units of 2.88 fF",
        (*_CHIP, "taxel"),
        _noisy_taxel,
        3.0,
    ),
    "shorted_finger": Kind(
        "the data line of a triangle is held low: its four chips read 0", _CHIP, _shorted_finger
    ),
    "wrong_address": Kind(
        "a chip answers at another address of its line; value: 0 to 3",
        _CHIP,
        _rewired(_wrong_address),
        3.0,
    ),
    "swapped_lines": Kind(
        "the line of a triangle is plugged into another one's place; value: that line",
        _CHIP,
        _rewired(_swapped_lines),
        1.0,
    ),
    "shared_address": Kind(
        "a chip answers at another address of its line, where one is already; value: 0 to 3",
        _CHIP,
        _shared_address,
        3.0,
        least=0,
        most=3,
    ),
    "no_acknowledge": Kind(
        "a chip does not acknowledge a byte, and misses the rest of the message; value: which, "
        "0 is the address",
        _CHIP,
        _no_acknowledge,
        1.0,
        least=0,
    ),
    "data_held_low": Kind(
        "a chip holds its data line low; value: until so many clocks have passed, 0 for ever",
        _CHIP,
        _data_held_low,
        9.0,
        least=0,
    ),
    "clock_stretched": Kind(
        "a chip holds the clock, which all lines share, low after each of its bytes; value: us",
        _CHIP,
        _clock_stretched,
        20.0,
        least=0,
    ),
    "bit_flipped": Kind(
        "bits on the data line of a triangle are read wrong; value: share",
        _CHIP,
        _bit_flipped,
        0.001,
        least=0,
        most=1,
    ),
    "slow_rise": Kind(
        "the data line of a triangle rises slowly: every n-th 1 after a 0 is read as 0; value: n",
        _CHIP,
        _slow_rise,
        50.0,
        least=1,
    ),
    "brown_out": Kind(
        "the supply of a chip fails for a moment: registers at reset, RAM random",
        _CHIP,
        _brown_out,
    ),
    "board_reset": Kind("a board restarts and forgets its set-up", ("board",), _board_reset),
    "board_silent": Kind("a board neither receives nor sends", ("board",), _board_silent),
    "late_period": Kind("each period lasts longer; value: ms", ("board",), _late_period, 5.0),
    "jittered_period": Kind(
        "bursts come late by chance; value: rms ms", ("board",), _jittered_period, 5.0
    ),
    "frame_loss": Kind("frames are lost; value: share", ("bus",), _frame_loss, 0.0066),
    "bit_errors": Kind(
        "frames arrive with one bit wrong; value: share", ("bus",), _bit_errors, 0.001
    ),
    "bus_off": Kind("nothing passes in either direction", ("bus",), _bus_off),
    "babbling_node": Kind(
        "a node fills the bus with identifier 0; value: share of the bus",
        ("bus",),
        _babbling_node,
        0.9,
    ),
    "temperature_step": Kind(
        "the skin is suddenly warmer; value: degrees C", (), _temperature_step, 5.0
    ),
}
