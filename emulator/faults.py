"""Faults by name: timed in a scene, or by command while the robot runs.

`begin` starts a fault on a robot and returns the function that ends it.
"""

from collections.abc import Callable, Hashable, Iterable
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal, Protocol

import msgspec
import numpy as np
from numpy.typing import NDArray

from emulator.boards.chip_access import ADDRESSES, CHIPS_PER_LINE
from emulator.boards.fingertips import FORCE, TORQUE, Fingertips
from emulator.boards.mtb import Mtb
from emulator.chips.converters import Converters
from emulator.chips.i2c_wire import FOR_EVER, DataLine
from emulator.probes.pads import UNIT_FF
from emulator.probes.scene import Fault
from emulator.probes.skin import Skin
from emulator.wire import Wire
from skin_host.config.explain import explain, out_of_bounds
from skin_host.errors import ConfigurationError, nearest
from skin_host.layout import TAXELS_PER_TRIANGLE

#: What a fault does something to.
Thing = tuple[Hashable, ...]
#: Takes the own value of a thing, and what faults put in its place, the newest last.
Put = Callable[[Any, tuple[Any, ...]], object]


class Active:
    """What faults do now, by the thing that each does it to.

    Several may do something to one thing, and end in any order: then the others go on, and when all
    have ended the thing is as it was before the first.
    """

    def __init__(self) -> None:
        self._of: dict[Thing, tuple[Any, dict[int, Any]]] = {}
        self._begun = 0

    def begin(self, thing: Thing, own: Any, value: Any, put: Put) -> "Mend":
        """Do something to a thing that has the value `own` without faults."""
        self._begun += 1
        own, values = self._of.setdefault(thing, (own, {}))
        values[self._begun] = value
        put(own, tuple(values.values()))
        return Mend(self, ((thing, self._begun, put),))

    def has(self, thing: Thing, number: int) -> bool:
        """Whether what was begun with this number is still done to a thing."""
        return number in self._of.get(thing, (None, ()))[1]

    def end_all(self, thing: Thing, put: Put) -> None:
        """End all that is done to a thing."""
        own, values = self._of.pop(thing, (None, {}))
        if values:
            put(own, ())

    def end(self, thing: Thing, number: int, put: Put) -> None:
        """End what was begun with this number."""
        own, values = self._of.get(thing, (None, {}))
        if number not in values:
            return  # it has ended
        del values[number]
        if not values:
            del self._of[thing]
        put(own, tuple(values.values()))


@dataclass(frozen=True, slots=True)
class Mend:
    """Ends a fault. Made of parts that a saved state can hold, see `emulator.state`.

    Attributes:
        active: where it is kept what faults do.
        begun: what the fault does, each with its number and with what puts it back; nothing if it
            cannot be undone.
    """

    active: Active
    begun: tuple[tuple[Thing, int, Put], ...] = ()

    @property
    def is_on(self) -> bool:
        """Whether the fault still does something that can be ended."""
        return any(self.active.has(thing, number) for thing, number, _ in self.begun)

    def __call__(self) -> None:
        for thing, number, put in self.begun:
            self.active.end(thing, number, put)


def _together(mends: Iterable[Mend], robot: "FaultyRobot") -> Mend:
    """One that ends all of them."""
    return Mend(robot.active, tuple(begun for mend in mends for begun in mend.begun))


class FaultyRobot(Protocol):
    """The parts of a robot that can fail; `emulator.robot.Robot` has all of them."""

    t_ns: int
    active: Active
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


#: Starts a fault.
Begin = Callable[[FaultyRobot, Fault], Mend]


@dataclass(frozen=True, slots=True)
class Kind:
    """A kind of fault: what it does, its keys, and the meaning of `value`.

    Attributes:
        value: if none is given.
        bounds: what `value` may be; None if there is none.
        whole: whether it counts or numbers something.
        on: what `board` may name.
        aim: raises a ConfigurationError if the fault cannot be at the place that its value names.
    """

    about: str
    needs: tuple[str, ...]
    begin: Begin
    value: float | None = None
    bounds: tuple[float, float] | None = None
    whole: bool = False
    aim: Callable[[FaultyRobot, Fault], object] | None = None
    on: Literal["skin", "skin or fingertip", "fingertip"] = "skin"


def parse(text: str) -> Fault:
    """A fault that begins now, from a line such as `chip_gone board=hand triangle=3`.

    `until_s` in it is how long it lasts.

    Raises:
        ConfigurationError: not such a line, an unknown name or key, or a time to begin.
    """
    name, *pairs = text.split() or [""]
    fields: dict[str, object] = {"name": name}
    for pair in pairs:
        key, equals, value = pair.partition("=")
        if not equals:
            raise ConfigurationError(f'"{pair}": wanted key=value')
        if key in fields:
            raise ConfigurationError(f'"{text}": {key} is given twice; wanted it once')
        fields[key] = value
    try:
        fault = msgspec.convert(fields, Fault, strict=False)
    except msgspec.ValidationError as error:
        raise ConfigurationError(f'"{text}": {explain(fields, error, Fault, {})}') from None
    for where, what in out_of_bounds(msgspec.to_builtins(fault)):
        raise ConfigurationError(f'"{text}": {where}: {what}')
    if "at_s" in fields:
        raise ConfigurationError(
            f"at_s: {fault.at_s:g}; a fault given by a line begins at once; wanted no at_s"
        )
    check(fault)
    return fault


def check(fault: Fault) -> None:
    """Check the name, its keys and its value.

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
    has = {*kind.needs, *(() if kind.bounds is None else ("value",))}
    for key in ("board", "bus", "triangle", "taxel", "value"):
        seen = getattr(fault, key)
        if seen is not None and key not in has:
            shown = f"{seen:g}" if key == "value" else seen
            raise ConfigurationError(f'{key}: {shown}; fault "{fault.name}" has no {key}')
    if fault.value is not None and kind.bounds is not None:
        least, most = kind.bounds
        if not least <= fault.value <= most or (kind.whole and fault.value % 1):
            wanted = f"{'a whole number, ' if kind.whole else ''}{least:g} to {most:g}"
            raise ConfigurationError(f"value: {fault.value:g}; wanted {wanted}")
    if fault.until_s is not None and fault.until_s <= fault.at_s:
        raise ConfigurationError("until_s: wanted a time after at_s")


def check_targets(robot: FaultyRobot, fault: Fault) -> None:
    """Check that the robot has what the fault names.

    Raises:
        ConfigurationError: names the key.
    """
    check(fault)
    on = KINDS[fault.name].on
    boards = [] if on == "fingertip" else list(robot.boards)
    if on != "skin":
        boards += robot.fingertips.boards
    if fault.board is not None and fault.board not in boards:
        what = "fingertip" if on == "fingertip" else "board"
        known = ", ".join(boards) or "none"
        raise ConfigurationError(f'board: no {what} "{fault.board}"; there are: {known}')
    if fault.bus is not None and fault.bus not in robot.wires:
        known = ", ".join(robot.wires)
        raise ConfigurationError(f'bus: no bus "{fault.bus}"; there are: {known}')
    if fault.triangle is not None:
        _chip(robot, fault)
    aim = KINDS[fault.name].aim
    if aim is not None:
        aim(robot, _with_value(fault))


def line_of(fault: Fault) -> str:
    """The line that names a fault, without its times."""
    keys = ("board", "bus", "triangle", "taxel", "value")
    given = ((key, getattr(fault, key)) for key in keys)
    return " ".join([fault.name, *(f"{key}={seen}" for key, seen in given if seen is not None)])


def is_same(one: Fault, other: Fault) -> bool:
    """Whether two faults do the same, at whatever times."""
    mine, others = (
        msgspec.structs.replace(_with_value(fault), at_s=0.0, until_s=None)
        for fault in (one, other)
    )
    return mine == others


def _with_value(fault: Fault) -> Fault:
    if fault.value is not None:
        return fault
    return msgspec.structs.replace(fault, value=KINDS[fault.name].value)


def begin(robot: FaultyRobot, fault: Fault) -> Mend:
    """Start a fault now; the returned function ends it.

    Raises:
        ConfigurationError: the robot does not have what the fault names.
    """
    check_targets(robot, fault)
    return KINDS[fault.name].begin(robot, _with_value(fault))


# ---------------------------------------------------------------------- chips and pads


def _board(robot: FaultyRobot, fault: Fault) -> int:
    return list(robot.boards).index(fault.board or "")


def _chip(robot: FaultyRobot, fault: Fault) -> int:
    """The chip that the fault names, as the layout numbers it."""
    number = _board(robot, fault)
    chip = int(robot.converters.chip_of_slot[number][_slot(robot, fault)])
    if chip < 0:
        raise ConfigurationError(f'triangle: {fault.triangle} is not fitted on "{fault.board}"')
    return chip


def _taxels(robot: FaultyRobot, fault: Fault) -> slice:
    first = TAXELS_PER_TRIANGLE * _chip(robot, fault)
    if fault.taxel is None:
        return slice(first, first + TAXELS_PER_TRIANGLE)
    return slice(first + fault.taxel, first + fault.taxel + 1)


def _newest(put: Callable[[Any], object], own: Any, values: tuple[Any, ...]) -> None:
    """Of several faults the newest acts."""
    put(values[-1] if values else own)


def _force(robot: FaultyRobot, chip: int, word: int) -> Mend:
    """Let a word be read instead of a chip."""
    return robot.active.begin(("chip", chip), None, word, _forced(robot, chip))


def _forced(robot: FaultyRobot, chip: int) -> Put:
    return partial(_newest, partial(robot.converters.force, chip))


def _chip_gone(robot: FaultyRobot, fault: Fault) -> Mend:
    return _force(robot, _chip(robot, fault), round(fault.value or 0))


def _chip_back(robot: FaultyRobot, fault: Fault) -> Mend:
    chip = _chip(robot, fault)
    robot.active.end_all(("chip", chip), _forced(robot, chip))
    return Mend(robot.active)


def _shorted_finger(robot: FaultyRobot, fault: Fault) -> Mend:
    """SDA is held low: all four chips of the line read 0, whatever they would send."""
    chip_of_slot = robot.converters.chip_of_slot[_board(robot, fault)]
    first = CHIPS_PER_LINE * _line(robot, fault)
    own = chip_of_slot[first : first + CHIPS_PER_LINE].tolist()
    return _together((_force(robot, chip, 0) for chip in own if chip >= 0), robot)


def _slot(robot: FaultyRobot, fault: Fault) -> int:
    # By the configuration: what a board's firmware knows of itself comes and goes.
    return robot.converters.slot(_board(robot, fault), fault.triangle or 0)


def _line(robot: FaultyRobot, fault: Fault) -> int:
    return _slot(robot, fault) // CHIPS_PER_LINE


def _other_slot(robot: FaultyRobot, fault: Fault) -> int:
    """The slot of another address of the same line."""
    slot = _slot(robot, fault)
    other = slot - slot % CHIPS_PER_LINE + round(fault.value or 0)
    if other == slot:
        raise ConfigurationError("value: is the chip's own address; wanted another one, 0 to 3")
    return other


def _other_line(robot: FaultyRobot, fault: Fault) -> int:
    line, other = _line(robot, fault), round(fault.value or 0)
    if other == line:
        raise ConfigurationError("value: is the triangle's own line; wanted another one, 0 to 3")
    return other


def _rewire(robot: FaultyRobot, number: int, change: Callable[[NDArray[np.intp]], object]) -> Mend:
    """Change which chip sits at which slot of a board, intp[20], in place."""
    own = robot.converters.chip_of_slot[number].copy()
    return robot.active.begin(("slots", number), own, change, partial(_rewired, robot, number))


def _rewired(
    robot: FaultyRobot,
    number: int,
    own: NDArray[np.intp],
    changes: tuple[Callable[[NDArray[np.intp]], object], ...],
) -> None:
    chip_of_slot = own.copy()
    for change in changes:
        change(chip_of_slot)
    robot.rewire(number, chip_of_slot)


def _move(slot: int, other: int, chip_of_slot: NDArray[np.intp]) -> None:
    chip_of_slot[other], chip_of_slot[slot] = chip_of_slot[slot], -1


def _unplug(slot: int, chip_of_slot: NDArray[np.intp]) -> None:
    chip_of_slot[slot] = -1


def _swap(one: int, other: int, chip_of_slot: NDArray[np.intp]) -> None:
    lines = chip_of_slot.reshape(-1, CHIPS_PER_LINE)
    lines[[one, other]] = lines[[other, one]]


def _wrong_address(robot: FaultyRobot, fault: Fault) -> Mend:
    change = partial(_move, _slot(robot, fault), _other_slot(robot, fault))
    return _rewire(robot, _board(robot, fault), change)


def _swapped_lines(robot: FaultyRobot, fault: Fault) -> Mend:
    change = partial(_swap, _line(robot, fault), _other_line(robot, fault))
    return _rewire(robot, _board(robot, fault), change)


def _shared_address(robot: FaultyRobot, fault: Fault) -> Mend:
    """The chip's own place is empty; at the other one a 0 of either chip wins."""
    number, chip, other = _board(robot, fault), _chip(robot, fault), _other_slot(robot, fault)
    alone = _rewire(robot, number, partial(_unplug, _slot(robot, fault)))
    put = partial(_newest, partial(robot.converters.answer_second, number, other))
    second = robot.active.begin(("second", number, other), None, chip, put)
    return _together((second, alone), robot)


def _stuck_taxel(robot: FaultyRobot, fault: Fault) -> Mend:
    taxels = _taxels(robot, fault)
    skin = robot.skin
    held_ff = skin.capacitance_ff[taxels].copy()
    if fault.value is not None:
        held_ff = skin.resting_ff[taxels] + fault.value
    put = partial(_newest, partial(_hold, robot, _chip(robot, fault), taxels))
    own_ff = skin.held_ff[taxels].copy()
    return robot.active.begin(("held", taxels.start), own_ff, held_ff, put)


def _hold(robot: FaultyRobot, chip: int, taxels: slice, held_ff: NDArray[np.float64]) -> None:
    """Let taxels of a chip measure always the same, or what they do where it is NaN."""
    robot.skin.held_ff[taxels] = held_ff
    own = slice(TAXELS_PER_TRIANGLE * chip, TAXELS_PER_TRIANGLE * (chip + 1))
    robot.converters.hold_results(chip, ~np.isnan(robot.skin.held_ff[own]))
    robot.pass_on(taxels)


def _noisy_taxel(robot: FaultyRobot, fault: Fault) -> Mend:
    taxels = _taxels(robot, fault)
    put = partial(_newest, partial(_set_noise, robot, _chip(robot, fault), taxels))
    own_ff = robot.skin.noise_ff[taxels].copy()
    noise_ff = np.full_like(own_ff, UNIT_FF * (fault.value or 0.0))
    return robot.active.begin(("noise", taxels.start), own_ff, noise_ff, put)


def _set_noise(robot: FaultyRobot, chip: int, taxels: slice, noise_ff: NDArray[np.float64]) -> None:
    noise = robot.skin.noise_ff
    noise[taxels] = noise_ff
    own = slice(TAXELS_PER_TRIANGLE * chip, TAXELS_PER_TRIANGLE * (chip + 1))
    robot.converters.set_noise_ff(chip, noise[own])


def _temperature_step(robot: FaultyRobot, fault: Fault) -> Mend:
    return robot.active.begin(("temperature",), 0.0, fault.value or 0.0, partial(_warm, robot))


def _warm(robot: FaultyRobot, own_c: float, steps_c: tuple[float, ...]) -> None:
    robot.skin.temperature_step_c = own_c + sum(steps_c)
    robot.work_out_now()


# ---------------------------------------------------------------------- the wires to the chips


def _on_line(
    robot: FaultyRobot,
    fault: Fault,
    do: Callable[[DataLine, int], Callable[[Any], object]],
    own: float | None,
    value: float,
) -> Mend:
    """Do something to a chip, or to its data line: `do` gives the line's method for it."""
    number, slot = _board(robot, fault), _slot(robot, fault)
    line = robot.converters.i2c_wire(number).lines[slot // CHIPS_PER_LINE]
    act = do(line, ADDRESSES[slot % CHIPS_PER_LINE])
    # Of the line, if it is not of one chip.
    place = slot if isinstance(act, partial) else slot // CHIPS_PER_LINE
    return robot.active.begin((fault.name, number, place), own, value, partial(_newest, act))


def _no_acknowledge(robot: FaultyRobot, fault: Fault) -> Mend:
    byte = round(fault.value or 0)
    return _on_line(robot, fault, lambda line, at: partial(line.refuse, at), None, byte)


def _clock_stretched(robot: FaultyRobot, fault: Fault) -> Mend:
    hold_ns = round(1e3 * (fault.value or 0.0))
    return _on_line(robot, fault, lambda line, at: partial(line.stretch, at), None, hold_ns)


def _data_held_low(robot: FaultyRobot, fault: Fault) -> Mend:
    clocks = round(fault.value or 0) or FOR_EVER
    return _on_line(robot, fault, lambda line, _: line.hold, 0, clocks)


def _bit_flipped(robot: FaultyRobot, fault: Fault) -> Mend:
    return _on_line(robot, fault, lambda line, _: line.flip, 0.0, fault.value or 0.0)


def _slow_rise(robot: FaultyRobot, fault: Fault) -> Mend:
    return _on_line(robot, fault, lambda line, _: line.rise_slowly, 0, round(fault.value or 0))


def _brown_out(robot: FaultyRobot, fault: Fault) -> Mend:
    robot.converters.brown_out(_chip(robot, fault))
    return Mend(robot.active)


# ---------------------------------------------------------------------- boards and buses


def _board_reset(robot: FaultyRobot, fault: Fault) -> Mend:
    robot.boards[fault.board or ""].reset(robot.t_ns)
    return Mend(robot.active)


def _board_silent(robot: FaultyRobot, fault: Fault) -> Mend:
    name = fault.board or ""
    if name in robot.fingertips.boards:
        put = partial(_silence_fingertip, robot, name)
        return robot.active.begin(("silent", name), False, True, put)
    number = _board(robot, fault)
    return robot.active.begin(("silent", number), False, True, partial(_silence, robot, number))


def _silence(robot: FaultyRobot, number: int, _: bool, silent: tuple[bool, ...]) -> None:
    if silent:
        robot.hung.add(number)
    else:
        robot.hung.discard(number)


def _silence_fingertip(robot: FaultyRobot, name: str, _: bool, silent: tuple[bool, ...]) -> None:
    if silent:
        robot.fingertips.hung.add(name)
    else:
        robot.fingertips.revive(name, robot.t_ns)


def _board_latched(robot: FaultyRobot, fault: Fault) -> Mend:
    name = fault.board or ""
    latched = robot.fingertips.boards[name].latched
    return _together(
        (
            robot.active.begin(("latched", name, half), False, True, partial(_latch, latched, half))
            for half in _LATCHED[round(fault.value or 0)]
        ),
        robot,
    )


def _latch(latched: set[int], half: int, _: bool, holds: tuple[bool, ...]) -> None:
    if holds:
        latched.add(half)
    else:
        latched.discard(half)


def _late_period(robot: FaultyRobot, fault: Fault) -> Mend:
    number, late_ns = _board(robot, fault), round((fault.value or 0.0) * 1e6)
    put = partial(_newest, partial(_put, robot.late_ns, number))
    return robot.active.begin(("late", number), 0, late_ns, put)


def _jittered_period(robot: FaultyRobot, fault: Fault) -> Mend:
    number, jitter_ns = _board(robot, fault), (fault.value or 0.0) * 1e6
    put = partial(_newest, partial(_put, robot.jitter_ns, number))
    return robot.active.begin(("jitter", number), 0.0, jitter_ns, put)


def _put(of_board: dict[int, Any], number: int, value: float) -> None:
    """Note a value of a board; 0 is none."""
    of_board[number] = value
    if not value:
        del of_board[number]


def _on_bus(what: Literal["loss_share", "error_share", "off"]) -> Begin:
    def begin_on_bus(robot: FaultyRobot, fault: Fault) -> Mend:
        bus = fault.bus or ""
        put = partial(_newest, partial(_set_wire, robot.wires[bus], what))
        own, value = (0.0, fault.value or 0.0) if what != "off" else (False, True)
        return robot.active.begin((what, bus), own, value, put)

    return begin_on_bus


def _set_wire(wire: Wire, what: Literal["loss_share", "error_share", "off"], value: Any) -> None:
    # Not by any name: it may come from a saved state.
    if what == "off":
        wire.off = value
    elif what == "loss_share":
        wire.loss_share = value
    else:
        wire.error_share = value


def _babbling_node(robot: FaultyRobot, fault: Fault) -> Mend:
    bus = fault.bus or ""
    put = partial(_newest, partial(_babble, robot, bus))
    return robot.active.begin(("babble", bus), 0.0, fault.value or 0.0, put)


def _babble(robot: FaultyRobot, bus: str, share: float) -> None:
    robot.wires[bus].babble(share, robot.t_ns)


_CHIP = ("board", "triangle")
#: By the value of `board_latched`.
_LATCHED = ((FORCE, TORQUE), (FORCE,), (TORQUE,))
KINDS: dict[str, Kind] = {
    "chip_gone": Kind(
        "a chip does not answer; value: the word that is read",
        _CHIP,
        _chip_gone,
        0xFFFF,
        bounds=(0, 0xFFFF),
        whole=True,
    ),
    "chip_back": Kind("a chip that was gone answers again", _CHIP, _chip_back),
    "stuck_taxel": Kind(
        "a taxel's result stays as it is; value: so many fF above rest",
        (*_CHIP, "taxel"),
        _stuck_taxel,
        bounds=(-10_000, 10_000),
    ),
    "noisy_taxel": Kind(
        "a badly soldered taxel; value: rms in units of 2.88 fF",
        (*_CHIP, "taxel"),
        _noisy_taxel,
        3.0,
        bounds=(0, 1000),
    ),
    "shorted_finger": Kind(
        "the data line of a triangle is held low: its four chips read 0", _CHIP, _shorted_finger
    ),
    "wrong_address": Kind(
        "a chip answers at another address of its line; value: 0 to 3",
        _CHIP,
        _wrong_address,
        3.0,
        bounds=(0, 3),
        whole=True,
        aim=_other_slot,
    ),
    "swapped_lines": Kind(
        "the line of a triangle is plugged into another one's place; value: that line",
        _CHIP,
        _swapped_lines,
        1.0,
        bounds=(0, 3),
        whole=True,
        aim=_other_line,
    ),
    "shared_address": Kind(
        "a chip answers at another address of its line, where one is already; value: 0 to 3",
        _CHIP,
        _shared_address,
        3.0,
        bounds=(0, 3),
        whole=True,
        aim=_other_slot,
    ),
    "no_acknowledge": Kind(
        "a chip does not acknowledge a byte, and misses the rest of the message; value: which, "
        "0 is the address",
        _CHIP,
        _no_acknowledge,
        1.0,
        bounds=(0, 255),
        whole=True,
    ),
    "data_held_low": Kind(
        "a chip holds its data line low; value: until so many clocks have passed, 0 for ever",
        _CHIP,
        _data_held_low,
        9.0,
        bounds=(0, 1_000_000),
        whole=True,
    ),
    "clock_stretched": Kind(
        "a chip holds the clock, which all lines share, low after each of its bytes; value: us",
        _CHIP,
        _clock_stretched,
        20.0,
        bounds=(0, 1_000_000),
    ),
    "bit_flipped": Kind(
        "bits on the data line of a triangle are read wrong; value: share",
        _CHIP,
        _bit_flipped,
        0.001,
        bounds=(0, 1),
    ),
    "slow_rise": Kind(
        "the data line of a triangle rises slowly: every n-th 1 after a 0 is read as 0; value: n",
        _CHIP,
        _slow_rise,
        50.0,
        bounds=(1, 1_000_000),
        whole=True,
    ),
    "brown_out": Kind(
        "the supply of a chip fails for a moment: registers at reset, RAM random",
        _CHIP,
        _brown_out,
    ),
    "board_reset": Kind("a board restarts and forgets its set-up", ("board",), _board_reset),
    "board_silent": Kind(
        "a board neither receives nor sends", ("board",), _board_silent, on="skin or fingertip"
    ),
    "board_latched": Kind(
        "a fingertip's board repeats its last sample; value: 1 its force only, 2 its torque only",
        ("board",),
        _board_latched,
        0.0,
        bounds=(0, 2),
        whole=True,
        on="fingertip",
    ),
    "late_period": Kind(
        "each period lasts longer, or shorter below 0; value: ms",
        ("board",),
        _late_period,
        5.0,
        bounds=(-1000, 100_000),
    ),
    "jittered_period": Kind(
        "bursts come late by chance; value: rms ms",
        ("board",),
        _jittered_period,
        5.0,
        bounds=(0, 1000),
    ),
    "frame_loss": Kind(
        "frames are lost; value: share", ("bus",), _on_bus("loss_share"), 0.0066, bounds=(0, 1)
    ),
    "bit_errors": Kind(
        "frames arrive with one bit wrong; value: share",
        ("bus",),
        _on_bus("error_share"),
        0.001,
        bounds=(0, 1),
    ),
    "bus_off": Kind("nothing passes in either direction", ("bus",), _on_bus("off")),
    "babbling_node": Kind(
        "a node fills the bus with identifier 0; value: share of the bus",
        ("bus",),
        _babbling_node,
        1.0,
        bounds=(0, 1),
    ),
    "temperature_step": Kind(
        "the skin is suddenly warmer; value: degrees C",
        (),
        _temperature_step,
        5.0,
        bounds=(-100, 100),
    ),
}
