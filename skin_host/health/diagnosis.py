"""What is wrong, by name and in a sentence, from a health record. Pure: a record in, faults out.

A fault has a code that programs compare, the place where it is, and a sentence that a person
can act on. `docs/operations.md` lists the codes and what to do about each.
"""

from collections import defaultdict
from collections.abc import Collection, Iterable, Iterator
from typing import Any

from msgspec import Struct

from skin_host.health.record import BoardHealth, BusHealth, Record

#: Share of a bus that strangers' frames may take before they are called babble.
BABBLE_LOAD = 0.4
#: A period off by more than this share of itself is told.
PERIOD_SHARE = 0.05
#: Intervals that scatter by more than this share of the period (by the median deviation) are told.
JITTER_SHARE = 0.06
#: Triangles with one half only, in the last second.
FEW_HALVES = 2
#: Pads that jumped for one sweep and back, all over a bus, in the last second.
FEW_SPIKES = 2
#: Mean shift of the thermal pads since the calibration, in units.
THERMAL_UNITS = 8.0
#: Without thermal pads: median shift of all untouched taxels from their baselines, in units.
COMMON_UNITS = 1.5
#: Chips that share one data line.
LINE = 4
#: Where the triangles of an ergoCub hand (skin type 3) sit on the data lines.
_ERGO_HAND_SLOTS = (0, 4, 8, 12, 16, 9, 10, 11, 13, 15, 1, 2, 3, 5, 6, 7)

_BUS_STATES = {
    "bus_off": (
        "bus_off",
        "left the bus after too many errors; check wiring, termination and its restart time",
    ),
    "error_passive": ("bus_errors", "sees many errors; check wiring, termination and bit rate"),
    "down": ("bus_down", "is down; set it up with `ip link set {channel} up`"),
    "gone": ("bus_gone", "is gone; plug the adapter in again, it is found by its name"),
}
_TRIANGLE_SAYS = {
    "missing": "does not come, though its board sends; is it enabled there?",
    "not connected": "is not connected: its chip does not answer; check cable and address",
    "no ack": "does not acknowledge on I2C: its chip or its data line is dead",
    "silenced": (
        "stopped answering; its board has taken a new zero since and sends a constant for it"
    ),
    "frozen": "repeats the same bytes for longer than chance allows: its chip has stopped",
    "constant": "did not move once while it was calibrated and has not moved since",
    "out of range": "reads far outside its range on all pads",
}


class Fault(Struct, frozen=True):
    """Something that is wrong.

    Attributes:
        code: what, for programs.
        where: the bus, board, triangle (`board/3`), or part.
        says: the same for people.
    """

    code: str
    where: str
    says: str


def diagnose(record: Record) -> list[Fault]:
    """All that is wrong with a part, the cause before its consequences."""
    faults = [fault for bus in record["buses"] for fault in _bus(bus)]
    quiet = {fault.where for fault in faults if fault.code in _SILENT}
    silent: set[str] = set()
    for board in record["boards"]:
        if board["bus"] in quiet:
            silent.add(board["name"])
            continue
        found = list(_board(board))
        faults += found
        if any(fault.code in {"board_silent", "board_absent"} for fault in found):
            silent.add(board["name"])
    faults += _triangles(record, silent)
    faults += _taxels(record)
    faults += _part(record)
    faults += _output(record.get("output"))
    return faults


_SILENT = {"bus_off", "bus_down", "bus_gone", "bus_silent"}


def _bus(bus: BusHealth) -> Iterator[Fault]:
    name = bus["name"]
    state = bus.get("state", "up")
    if state in _BUS_STATES:
        code, says = _BUS_STATES[state]
        yield Fault(code, name, f"bus {name} " + says.format(channel=bus.get("channel", name)))
    elif bus.get("silent"):
        yield Fault(
            "bus_silent",
            name,
            f"bus {name}: no frame comes at all; check its plug, the boards' power and bit rate",
        )
    recent = bus.get("last_second")
    if recent is None:
        return
    if recent["other_load"] > BABBLE_LOAD:
        yield Fault(
            "bus_babbling",
            name,
            f"bus {name}: frames that are none of the skin's take {recent['other_load']:.0%} of it"
            + (f", most with identifier {bus['stranger']}" if bus.get("stranger") else "")
            + "; find the node that sends them",
        )
    if recent["dropped"]:
        yield Fault(
            "bus_drops",
            name,
            f"bus {name}: this computer lost {recent['dropped']} frames in the last second; "
            "see docs/receive.md",
        )
    if recent["halves"] >= FEW_HALVES:
        yield Fault(
            "bus_loses_frames",
            name,
            f"bus {name}: single frames are lost, {recent['halves']} in the last second; "
            "the bus is overloaded or badly terminated",
        )
    if recent["wrong"] or recent["spikes"] >= FEW_SPIKES:
        yield Fault(
            "bus_bit_errors",
            name,
            f"bus {name}: damaged frames ({recent['wrong']} with a wrong header, "
            f"{recent['spikes']} single bytes off); suspect a gateway or an adapter",
        )
    if recent["error_frames"] and state == "up":
        yield Fault(
            "bus_errors",
            name,
            f"bus {name}: {recent['error_frames']} error frames in the last second; "
            "check wiring and termination",
        )
    for address, kind in sorted(bus.get("strangers", {}).items()):
        yield Fault(
            "bus_stranger",
            f"{name}/{address}",
            f"bus {name}: a board of type {kind} at address {address} is not in the configuration",
        )


def _board(board: BoardHealth) -> Iterator[Fault]:
    name = board["name"]
    here = f"board {name} (address {board['address']})"
    if board.get("in_bootloader"):
        yield Fault("board_in_bootloader", name, f"{here} waits in its bootloader for a firmware")
    elif not board["alive"]:
        if board["sweeps"]:
            yield Fault(
                "board_silent",
                name,
                f"{here} has stopped sending; it is asked and set up again; check its power",
            )
        else:
            yield Fault(
                "board_absent", name, f"{here} has not sent anything yet; check power and address"
            )
    if board.get("wrong_type"):
        yield Fault(
            "board_wrong_type",
            name,
            f"{here} says that it is of type {board['board_type']}, which is no skin board",
        )
    events = board.get("lately", {})
    if events.get("resets"):
        yield Fault("board_reset", name, f"{here} started anew by itself and was set up again")
    if events.get("lost_set_ups"):
        yield Fault(
            "board_lost_set_up",
            name,
            f"{here} sent something else than it was set up to, and was set up again",
        )
    if events.get("rezeros"):
        yield Fault(
            "board_rezeroed",
            name,
            f"{here} has taken a new zero; its baselines were moved after it",
        )
    if board.get("in_doubt"):
        yield Fault(
            "board_in_doubt",
            name,
            f"{here} took its zero while it was touched (taxels: {board['in_doubt']}); those are "
            f"not valid until calibrated: skin command calibrate --board {name}",
        )
    if events.get("tx_overflows"):
        yield Fault("board_overflows", name, f"{here} could not send all its frames: bus too full")
    wanted, seen, jitter_ms = board["period_ms"], board["period_seen_ms"], board["jitter_ms"]
    if board["alive"] and seen is not None and jitter_ms is not None:
        if abs(seen - wanted) > PERIOD_SHARE * wanted:
            yield Fault(
                "board_period", name, f"{here} sends every {seen:.1f} ms instead of {wanted} ms"
            )
        elif jitter_ms > JITTER_SHARE * wanted:
            yield Fault(
                "board_jitter",
                name,
                f"{here} sends unevenly: its {wanted} ms scatter by {jitter_ms:.1f} ms",
            )


def _line_of(board: BoardHealth, triangle: int) -> int:
    slot = _ERGO_HAND_SLOTS[triangle] if board.get("skin_type") == 3 else triangle
    return slot // LINE


def _triangles(record: Record, silent: set[str]) -> Iterator[Fault]:
    boards = {board["name"]: board for board in record["boards"]}
    of_line: dict[tuple[str, int], dict[int, str]] = defaultdict(dict)
    for one in record["triangles"]:
        if one["board"] not in silent:
            line = _line_of(boards[one["board"]], one["triangle"])
            of_line[one["board"], line][one["triangle"]] = one["fault"]
    told: set[tuple[str, int]] = set()
    for name, board in boards.items():
        lines = {line: faults for (owner, line), faults in of_line.items() if owner == name}
        fitted: dict[int, set[int]] = defaultdict(set)
        for triangle in board["fitted"]:
            fitted[_line_of(board, triangle)].add(triangle)
        whole = [line for line, faults in lines.items() if set(faults) == fitted[line]]
        for line in whole:
            if len(fitted[line]) > 1 and set(lines[line].values()) <= {"no ack", "silenced"}:
                told.add((name, line))
                yield Fault(
                    "line_shorted",
                    f"{name}/line{line}",
                    f"board {name}: triangles {_list(fitted[line])} all stopped answering: their "
                    "common data line is shorted or torn, often by one of them",
                )
        mixed = [
            line
            for line in whole
            if (name, line) not in told and set(lines[line].values()) & {"out of range"}
        ]
        if len(mixed) == 2:
            told |= {(name, line) for line in mixed}
            yield Fault(
                "lines_swapped",
                f"{name}/line{mixed[0]}+{mixed[1]}",
                f"board {name}: the triangles {_list(fitted[mixed[0]])} and "
                f"{_list(fitted[mixed[1]])} all read wrong at once: are the plugs of their two "
                "data lines swapped? Put them right, or calibrate and change the configuration",
            )
    for (name, line), faults in of_line.items():
        if (name, line) in told:
            continue
        for triangle, fault in sorted(faults.items()):
            says = _TRIANGLE_SAYS[fault]
            if fault == "not connected" and len(faults) > 1:
                says += " (another triangle of the same line reads wrong too: has it this address?)"
            code = "triangle_" + fault.replace(" ", "_")
            yield Fault(code, f"{name}/{triangle}", f"triangle {triangle} of board {name} {says}")


def _taxels(record: Record) -> Iterator[Fault]:
    part = record["part"]
    says = {
        "stuck": "the same byte for too long in a triangle that is otherwise alive; not valid",
        "noisy": "up and down far more than when calibrated; not valid",
        "out_of_range": "far out of range; not valid",
        "drifting": "far from the calibration by now; calibrate when nothing touches",
    }
    for kind, what in says.items():
        taxels = record["taxel_faults"].get(kind)
        if taxels:
            yield Fault(f"taxel_{kind}", part, f"{_named(taxels)} of {part}: {what}")
    verdicts = record["taxel_verdicts"]
    # What a triangle that is told of did not send, was absent because of that.
    kinds = ["stuck", "out_of_range"] + ["absent", "too_few"] * (not record["triangles"])
    refused = {taxel for kind in kinds for taxel in verdicts.get(kind, ())}
    refused &= set(record["invalid"])
    if refused:
        yield Fault(
            "taxel_refused",
            part,
            f"{_named(refused)} of {part}: stuck, out of range, absent or heard too rarely when "
            "calibrated; not valid until a calibration says better",
        )
    if record["baseline_at_limit"]:
        at_limit = _named(record["baseline_at_limit"])
        yield Fault(
            "taxel_at_limit",
            part,
            f"{at_limit} of {part}: the baseline cannot follow any farther; calibrate",
        )
    if record["baseline_frozen"]:
        held = _named(record["baseline_frozen"])
        yield Fault(
            "taxel_held",
            part,
            f"{held} of {part}: touched for so long that the zero is uncertain",
        )


def _part(record: Record) -> Iterator[Fault]:
    part = record["part"]
    if record["state"] == "disabled":
        yield Fault("part_disabled", part, f"{part} was disabled by command; nothing is published")
        return
    if record["calibration"] is None:
        yield Fault("part_not_calibrated", part, f"{part} is not calibrated: nothing is published")
    warmth = record.get("warmth")
    if warmth is None:
        return
    if warmth["thermal_units"] is not None and abs(warmth["thermal_units"]) > THERMAL_UNITS:
        yield Fault(
            "part_temperature",
            part,
            f"{part}: its thermal pads read {warmth['thermal_units']:+.0f} units since the "
            "calibration: its temperature has changed; pressures are corrected, less surely",
        )
    elif abs(warmth["common_units"]) > COMMON_UNITS:
        yield Fault(
            "part_temperature",
            part,
            f"{part}: its untouched taxels all read {warmth['common_units']:+.1f} units off their "
            "baselines: its temperature is changing",
        )


def _output(output: dict[str, Any] | None) -> Iterator[Fault]:
    if output is None:
        return
    if not output["connected"]:
        why = output.get("last_error") or "not yet reached"
        yield Fault("broker_away", "broker", f"the broker is away: {why}")
    if output["touches_dropped"]:
        yield Fault(
            "touches_dropped",
            "broker",
            f"{output['touches_dropped']} touch events were lost since the start: the broker was "
            "away for too long",
        )
    if output["refused"]:
        yield Fault("broker_refuses", "broker", f"the broker refuses: {output['last_error']}")


def _named(taxels: Collection[int]) -> str:
    return f"{'taxel' if len(taxels) == 1 else 'taxels'} {_list(taxels)}"


def _list(numbers: Iterable[int]) -> str:
    """Numbers as a short list with ranges: 1, 4-7, 9."""
    ordered = sorted(numbers)
    runs: list[tuple[int, int]] = []
    for number in ordered:
        if runs and number == runs[-1][1] + 1:
            runs[-1] = (runs[-1][0], number)
        else:
            runs.append((number, number))
    texts = [str(a) if a == b else f"{a}-{b}" for a, b in runs]
    if len(texts) > 8:
        texts = [*texts[:8], f"... ({len(ordered)} in all)"]
    return ", ".join(texts)
