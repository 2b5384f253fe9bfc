"""What can go wrong, by name: timed in a scene, or by command while the robot runs.

`begin` makes a fault happen to a robot and gives back how to mend it.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import msgspec
import numpy as np

from emulator.firmware.chips import CHIPS_PER_LINE
from emulator.pads import UNIT_FF
from emulator.scene import Fault
from skin_host.errors import ConfigurationError
from skin_host.layout import TAXELS_PER_TRIANGLE

if TYPE_CHECKING:
    from emulator.robot import Robot

Mend = Callable[[], None]


@dataclass(frozen=True, slots=True)
class Kind:
    """A kind of fault: what it does, what it must be told, and what `value` means."""

    about: str
    needs: tuple[str, ...]
    begin: Callable[["Robot", Fault], Mend]
    value: float | None = None


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
        raise ConfigurationError(f'"{text}": {error}') from None
    check(fault)
    return fault


def check(fault: Fault) -> None:
    """Check the name and that what it must be told is there.

    Raises:
        ConfigurationError: names the key.
    """
    kind = KINDS.get(fault.name)
    if kind is None:
        raise ConfigurationError(f'name: no fault "{fault.name}"; there are: {", ".join(KINDS)}')
    for key in kind.needs:
        if getattr(fault, key) is None:
            raise ConfigurationError(f'{key}: missing; fault "{fault.name}" needs it')
    if fault.until_s is not None and fault.until_s <= fault.at_s:
        raise ConfigurationError("until_s: wanted a time after at_s")


def check_targets(robot: "Robot", fault: Fault) -> None:
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


def begin(robot: "Robot", fault: Fault) -> Mend:
    """Make a fault happen now; the answer mends it.

    Raises:
        ConfigurationError: the robot does not have what the fault names.
    """
    check_targets(robot, fault)
    kind = KINDS[fault.name]
    if fault.value is None:
        fault = msgspec.structs.replace(fault, value=kind.value)
    return kind.begin(robot, fault)


# ---------------------------------------------------------------------- chips and pads


def _board(robot: "Robot", fault: Fault) -> int:
    return list(robot.boards).index(fault.board or "")


def _chip(robot: "Robot", fault: Fault) -> int:
    """The chip that the fault names, as the layout numbers it."""
    number = _board(robot, fault)
    slot = robot.boards[fault.board or ""].slot(fault.triangle or 0)
    chip = int(robot.converters.chip_of_slot[number][slot])
    if chip < 0:
        raise ConfigurationError(f'triangle: {fault.triangle} is not fitted on "{fault.board}"')
    return chip


def _taxels(robot: "Robot", fault: Fault) -> slice:
    first = TAXELS_PER_TRIANGLE * _chip(robot, fault)
    if fault.taxel is None:
        return slice(first, first + TAXELS_PER_TRIANGLE)
    return slice(first + fault.taxel, first + fault.taxel + 1)


def _chip_gone(robot: "Robot", fault: Fault) -> Mend:
    chips = robot.converters
    chip = _chip(robot, fault)
    chips.force(chip, round(fault.value or 0))
    return lambda: chips.force(chip, None)


def _chip_back(robot: "Robot", fault: Fault) -> Mend:
    robot.converters.force(_chip(robot, fault), None)
    return _nothing


def _shorted_finger(robot: "Robot", fault: Fault) -> Mend:
    """SDA is held low: all four chips of the line read 0, whatever they would say."""
    chips = robot.converters
    number = _board(robot, fault)
    line = robot.boards[fault.board or ""].slot(fault.triangle or 0) // CHIPS_PER_LINE
    slots = range(CHIPS_PER_LINE * line, CHIPS_PER_LINE * (line + 1))
    own = [int(chip) for chip in chips.chip_of_slot[number][slots.start : slots.stop] if chip >= 0]
    for chip in own:
        chips.force(chip, 0)

    def mend() -> None:
        for chip in own:
            chips.force(chip, None)

    return mend


def _rewired(change: Callable[["Robot", Fault, int, np.ndarray], None]) -> Callable[..., Mend]:
    """A fault that changes which chip sits at which slot of a board."""

    def begin_rewired(robot: "Robot", fault: Fault) -> Mend:
        number = _board(robot, fault)
        before = robot.converters.chip_of_slot[number].copy()
        after = before.copy()
        change(robot, fault, number, after)
        robot.rewire(number, after)
        return lambda: robot.rewire(number, before)

    return begin_rewired


def _wrong_address(robot: "Robot", fault: Fault, _: int, chip_of_slot: np.ndarray) -> None:
    slot = robot.boards[fault.board or ""].slot(fault.triangle or 0)
    base = slot - slot % CHIPS_PER_LINE
    other = base + round(fault.value or 0) % CHIPS_PER_LINE
    if other == slot:
        raise ConfigurationError("value: is the chip's own address; wanted another one, 0 to 3")
    chip_of_slot[other], chip_of_slot[slot] = chip_of_slot[slot], -1


def _swapped_lines(robot: "Robot", fault: Fault, _: int, chip_of_slot: np.ndarray) -> None:
    one = robot.boards[fault.board or ""].slot(fault.triangle or 0) // CHIPS_PER_LINE
    other = round(fault.value or 0) % CHIPS_PER_LINE
    lines = chip_of_slot.reshape(-1, CHIPS_PER_LINE)
    lines[[one, other]] = lines[[other, one]]


def _stuck_taxel(robot: "Robot", fault: Fault) -> Mend:
    taxels = _taxels(robot, fault)
    skin = robot.skin
    held_ff = skin.capacitance_ff[taxels].copy()
    if fault.value is not None:
        held_ff = skin.resting_ff[taxels] + fault.value
    skin.held_ff[taxels] = held_ff
    chip = _chip(robot, fault)

    def show() -> None:
        own = slice(TAXELS_PER_TRIANGLE * chip, TAXELS_PER_TRIANGLE * (chip + 1))
        robot.converters.hold_results(chip, ~np.isnan(skin.held_ff[own]))
        robot.pass_on(taxels)

    def mend() -> None:
        skin.held_ff[taxels] = np.nan
        show()

    show()
    return mend


def _noisy_taxel(robot: "Robot", fault: Fault) -> Mend:
    return _noise(robot, fault, UNIT_FF * (fault.value or 0.0))


def _noise(robot: "Robot", fault: Fault, noise_ff: float) -> Mend:
    taxels = _taxels(robot, fault)
    chip = _chip(robot, fault)
    own = slice(TAXELS_PER_TRIANGLE * chip, TAXELS_PER_TRIANGLE * (chip + 1))
    noise = robot.skin.noise_ff
    before = noise[taxels].copy()

    def set_noise(values: np.ndarray | float) -> None:
        noise[taxels] = values
        robot.converters.set_noise_ff(chip, noise[own])

    set_noise(noise_ff)
    return lambda: set_noise(before)


def _temperature_step(robot: "Robot", fault: Fault) -> Mend:
    robot.skin.temperature_step_c += fault.value or 0.0
    robot.work_out_now()

    def mend() -> None:
        robot.skin.temperature_step_c -= fault.value or 0.0
        robot.work_out_now()

    return mend


# ---------------------------------------------------------------------- boards and buses


def _board_reset(robot: "Robot", fault: Fault) -> Mend:
    robot.boards[fault.board or ""].reset(robot.t_ns)
    return _nothing


def _board_silent(robot: "Robot", fault: Fault) -> Mend:
    name = fault.board or ""
    if name in robot.fingertips.boards:
        robot.fingertips.hung.add(name)
        return lambda: robot.fingertips.hung.discard(name)
    number = _board(robot, fault)
    robot.hung.add(number)
    return lambda: robot.hung.discard(number)


def _late_period(robot: "Robot", fault: Fault) -> Mend:
    number = _board(robot, fault)
    robot.late_ns[number] = round((fault.value or 0.0) * 1e6)

    def mend() -> None:
        robot.late_ns.pop(number, None)

    return mend


def _jittered_period(robot: "Robot", fault: Fault) -> Mend:
    number = _board(robot, fault)
    robot.jitter_ns[number] = (fault.value or 0.0) * 1e6

    def mend() -> None:
        robot.jitter_ns.pop(number, None)

    return mend


def _frame_loss(robot: "Robot", fault: Fault) -> Mend:
    wire = robot.wires[fault.bus or ""]
    wire.loss_share = fault.value or 0.0

    def mend() -> None:
        wire.loss_share = 0.0

    return mend


def _bit_errors(robot: "Robot", fault: Fault) -> Mend:
    wire = robot.wires[fault.bus or ""]
    wire.error_share = fault.value or 0.0

    def mend() -> None:
        wire.error_share = 0.0

    return mend


def _bus_off(robot: "Robot", fault: Fault) -> Mend:
    wire = robot.wires[fault.bus or ""]
    wire.off = True

    def mend() -> None:
        wire.off = False

    return mend


def _babbling_node(robot: "Robot", fault: Fault) -> Mend:
    wire = robot.wires[fault.bus or ""]
    wire.babble(fault.value or 0.0, robot.t_ns)
    return lambda: wire.babble(0.0, robot.t_ns)


def _nothing() -> None:
    """Nothing to mend: it has happened."""


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
    "board_reset": Kind("a board starts anew and forgets its set-up", ("board",), _board_reset),
    "board_silent": Kind("a board neither hears nor sends", ("board",), _board_silent),
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
        "somebody fills the bus with identifier 0; value: share of the bus",
        ("bus",),
        _babbling_node,
        0.9,
    ),
    "temperature_step": Kind(
        "the skin is suddenly warmer; value: degrees C", (), _temperature_step, 5.0
    ),
}
