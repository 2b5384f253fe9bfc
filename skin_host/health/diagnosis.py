"""Finds the faults in a health record. Pure: takes a record, returns faults.

A fault has a code for programs, the place where it is, and a sentence that a person can act on.
`docs/operations.md` lists the codes and what to do about each.
"""

from collections import defaultdict
from collections.abc import Collection, Iterable, Iterator, Mapping
from typing import Any

from msgspec import Struct

from skin_host.config.settings import format_triangles
from skin_host.health.record import BoardHealth, BusHealth, Record
from skin_host.layout import TAXELS_PER_TRIANGLE

#: Frames of unconfigured nodes that take more than this share of a bus are a fault.
BABBLE_LOAD = 0.4
#: A period that is off by more than this share is a fault.
PERIOD_SHARE = 0.05
#: Intervals that scatter by more than this share of the period (median deviation) are a fault.
JITTER_SHARE = 0.06
#: This many lone frames (one of a pair) in the last second are a fault.
FEW_HALVES = 2
#: A bus with this load, of full frames, is full: what has the highest identifiers waits for ever.
FULL_LOAD = 0.95
#: So are this many pads of a bus that were off for one sweep, in the last ten seconds.
FEW_SPIKED_PADS = 2
#: Limit of the median shift of the temperature pads since the calibration, in units of the usual
#: shift, which are a temperature.
THERMAL_UNITS = 8.0
#: Limit of the median shift of all untouched taxels from their baselines, in units as the part's
#: coarsest triangle sends them; used without temperature pads. Less is noise, or rounding.
COMMON_UNITS = 1.5
#: What falls by so much at once, in the same units (20 degrees), is no temperature: something that
#: pressed the whole part when it was zeroed has been lifted. Its zeros follow within seconds.
LIFTED_UNITS = 10.0
#: Kinds of interface that no real board is on; the kernel's are named vcan.
EMULATED = {"virtual", "socketpair"}
#: Number of chips that share one data line.
LINE = 4
#: Data lines of the triangles of an ergoCub hand (skin type 3).
_ERGO_HAND_LINES = (0, 1, 2, 3, 4, 2, 2, 2, 3, 3, 0, 0, 0, 1, 1, 1)

_BUS_STATES = {
    "bus_off": (
        "bus_off",
        "left the bus after too many errors; check wiring, termination and its restart time",
    ),
    "error_passive": ("bus_errors", "sees many errors; check wiring, termination and bit rate"),
    "down": ("bus_down", "is down; set it up with `ip link set {channel} up`"),
    "gone": ("bus_gone", "is gone; plug the adapter in again, it is found by its name"),
}
_BOARD_EVENTS = {
    "resets": ("board_reset", " restarted by itself and was set up again"),
    "lost_set_ups": (
        "board_lost_set_up",
        " did not send what it was set up to send, and was set up again",
    ),
    "rezeros": ("board_rezeroed", " zeroed itself; its baselines were corrected for that"),
}
_TRIANGLE_SENTENCES = {
    "missing": "is missing although its board sends; check that it is enabled there",
    "not connected": "is not connected: its chip does not answer; check cable and address",
    "no ack": "does not acknowledge on I2C: its chip or its data line is dead",
    "silenced": ("stopped answering; its board was zeroed since then and sends a constant for it"),
    "answers again": (
        "answers again, but its board was zeroed while it did not; set the board up again while "
        "nothing touches it: skin command configure --board {board}"
    ),
    "frozen": "repeats the bytes of most pads, or of all, for longer than chance allows: its chip "
    "has stopped, or lost its set-up: switch the board off and on, then calibrate",
    "constant": "did not change during the calibration and has not changed since",
    "out of range": (
        "reads far out of its range: if it was pressed when its board was zeroed, set the board up "
        "again while nothing touches it: skin command configure --board {board}; if not, its chip "
        "has another address, or its data line another plug"
    ),
}
_TAXEL_FAULTS = {
    "stuck": "the same byte for too long in a triangle that otherwise works; not valid",
    "noisy": "much noisier than when calibrated; not valid",
    "out_of_range": "far out of range; not valid",
    "returned": "as high again as the zero was before it fell: pressed as when that was taken, or "
    "the zero has come back; not valid until it is released; if nothing touches: skin command "
    "calibrate",
    "drifting": "has moved far from its calibration; calibrate when nothing touches the skin",
}


#: Verdicts of a calibration for which taxels are not valid, in words; the second ones because too
#: little of them came.
_REFUSED = {"stuck": "stuck", "out_of_range": "out of range", "too_noisy": "too noisy"}
_NOT_RECEIVED = {"absent": "absent", "too_few": "received too rarely"}


class FoundFault(Struct, frozen=True):
    """A fault.

    Attributes:
        code: what is wrong, for programs.
        where: the bus, board, triangle (`board/3`), or part.
        sentence: what is wrong, as a sentence for people.
    """

    code: str
    where: str
    sentence: str


def diagnose(record: Record, lost_lately: Collection[str] = ()) -> list[FoundFault]:
    """Return all faults of a part, each cause before its consequences.

    Args:
        record: of the part.
        lost_lately: counters of `output` that have risen within the last minute.
    """
    doubled = {board["bus"] for board in record["boards"] if board.get("twice")}
    faults = [
        fault
        for bus in record["buses"]
        for fault in _bus(bus)
        # Frames of two boards at one address cut each other's sweeps.
        if not (fault.code == "bus_loses_frames" and bus["name"] in doubled)
    ]
    quiet = {fault.where for fault in faults if fault.code in _SILENT}
    loads = {bus["name"]: _load(bus) for bus in record["buses"]}
    silent: set[str] = set()
    for board in record["boards"]:
        if board["bus"] in quiet:
            silent.add(board["name"])
            continue
        found = list(_board(board, loads.get(board["bus"], 0.0)))
        faults += found
        absent = any(fault.code in {"board_silent", "board_absent"} for fault in found)
        if absent or board.get("awaited"):
            silent.add(board["name"])
    faults += _triangles(record, silent)
    faults += _taxels(record)
    faults += _part(record)
    unexplained = set(record["invalid"]) - _explained(record)
    degraded = record["state"] == "degraded" and not silent
    if degraded and unexplained and not any(map(_hides_many, faults)):
        faults.append(
            FoundFault(
                "taxel_unproven",
                record["part"],
                f"{named(unexplained)} of {record['part']}: not valid: the pad failed when "
                "calibrated under pressure, or jumps, or its chip has yet to show that it lives",
            )
        )
    faults += _output(record.get("output"), lost_lately)
    for what, why in record.get("unkept", {}).items():
        sentence = f"{what} in use but not kept: {why}; lost at a restart"
        if what == "zeros":
            sentence += ": what is pressed would look untouched; calibrate after the restart"
        faults.append(FoundFault("state_not_kept", what, sentence))
    return faults


def _hides_many(fault: FoundFault) -> bool:
    """Whether a fault is a reason for which taxels are not valid that are not listed one by one."""
    return fault.code.startswith(("bus_", "board_", "line", "triangle_"))


def _explained(record: Record) -> set[int]:
    """Return the taxels of which a fault is reported for which they are not valid: their own, or
    that of their temperature pad, which is none of those that measure pressure.
    """
    found, verdicts = record["taxel_faults"], record["taxel_verdicts"]
    kinds = ("unreached", *_REFUSED, *_NOT_RECEIVED)
    explained = set().union(*(verdicts.get(kind, ()) for kind in kinds))
    explained.update(*(found.get(kind, ()) for kind in ("out_of_range", "returned")))
    failed = {taxel for kind in ("stuck", "noisy") for taxel in found.get(kind, ())}
    for temperature_pad in failed.difference(record["invalid"]):
        first = temperature_pad - temperature_pad % TAXELS_PER_TRIANGLE
        explained.update(range(first, first + TAXELS_PER_TRIANGLE))
    return explained | failed


_SILENT = {"bus_off", "bus_down", "bus_gone", "bus_silent"}


def _bus(bus: BusHealth) -> Iterator[FoundFault]:
    name = bus["name"]

    def fault(code: str, sentence: str, where: str = name) -> FoundFault:
        return FoundFault(code, where, f"bus {name}{sentence}")

    state = bus.get("state", "up")
    if state in _BUS_STATES:
        code, sentence = _BUS_STATES[state]
        sentence = " " + sentence.format(channel=bus.get("channel", name))
        if "unopened" in bus:
            why = bus["unopened"]
            sentence = f" is gone: {why}; it goes on when that is mended, or it is plugged in"
        yield fault(code, sentence)
    elif bus.get("silent"):
        why = "check its plug, the boards' power and bit rate"
        if bus["interface"] in EMULATED or bus["channel"].startswith("vcan"):
            why = "the emulator has ended, or other work on this computer holds it up"
        yield fault("bus_silent", f": no frames are received; {why}")
    recent = bus.get("last_second")
    if recent is None:
        return
    if recent["other_load"] > BABBLE_LOAD:
        mostly = f", mostly with identifier {bus['stranger']}" if bus.get("stranger") else ""
        yield fault(
            "bus_babbling",
            f": frames of other devices take {recent['other_load']:.0%} of it{mostly}; find the "
            "node that sends them",
        )
    lost = []
    if recent["dropped"]:
        lost.append(f"this computer lost {recent['dropped']} frames in the last second")
    if recent["overflows"]:
        times = f"{recent['overflows']} times in the last second"
        lost.append(f"its controller, or the driver of that, lost frames {times}")
    if lost:
        yield fault("bus_drops", f": {', and '.join(lost)}; see docs/receive.md")
    # Of frames that were lost here, others are lone.
    if recent["halves"] >= FEW_HALVES and not bus.get("lost_here"):
        why = "the bus is overloaded or badly terminated"
        if recent["load"] >= FULL_LOAD:
            why = f"the bus is overloaded: its load is {recent['load']:.0%}"
        yield fault(
            "bus_loses_frames",
            f": single frames are lost, {recent['halves']} in the last second; {why}",
        )
    spiked_pads = bus.get("spiked_pads", 0)
    if recent["wrong"] or spiked_pads >= FEW_SPIKED_PADS:
        yield fault(
            "bus_bit_errors",
            f": damaged frames ({recent['wrong']} with a wrong header or unreadable in the last "
            f"second, single bytes of {spiked_pads} pads off in the last ten); suspect a gateway "
            "or an adapter",
        )
    # A controller that lost frames reports that in one as well.
    errors = recent["error_frames"] - recent["overflows"]
    if errors > 0 and state == "up":
        yield fault(
            "bus_errors",
            f": {errors} error frames in the last second; check wiring and termination",
        )
    for address, kind in sorted(bus.get("strangers", {}).items()):
        what = f": a board of type {kind} at address {address} is not in the configuration"
        yield fault("bus_stranger", what, f"{name}/{address}")


def _load(bus: BusHealth) -> float:
    """The share of a bus that was taken in the last second; 0: it is not known."""
    recent = bus.get("last_second")
    return 0.0 if recent is None else recent["load"]


def _board(board: BoardHealth, load: float) -> Iterator[FoundFault]:
    """Return the faults of a board on a bus of this load."""
    name = board["name"]

    def fault(code: str, sentence: str) -> FoundFault:
        here = f"board {name} (address {board['address']})"
        return FoundFault(code, name, here + sentence)

    if board.get("in_bootloader"):
        yield fault("board_in_bootloader", " is in its bootloader: no firmware runs")
    elif not board["alive"] and not board.get("awaited"):
        full = ""
        if load >= FULL_LOAD:
            full = (
                f"its bus is full (load {load:.0%}), and lower addresses go first: "
                "have less sent on it, then "
            )
        if board["sweeps"]:
            yield fault(
                "board_silent",
                f" has stopped sending and is being set up again; {full}check its power",
            )
        else:
            yield fault(
                "board_absent", f" has not sent anything yet; {full}check power and address"
            )
    if board.get("wrong_type"):
        yield fault(
            "board_wrong_type", f" reports type {board['board_type']}, which is no skin board"
        )
    if model := board.get("wrong_model"):
        kind = "no MTB3" if model == "mtb3" else "an MTB3"
        yield fault(
            "board_wrong_model",
            f" reports type {board['board_type']}, {kind}, but boards.{name}.model is {model}; "
            "correct that: the two compute different values",
        )
    events = board.get("lately", {})
    for event, (code, sentence) in _BOARD_EVENTS.items():
        if events.get(event):
            yield fault(code, sentence)
    if board.get("in_doubt"):
        yield fault(
            "board_in_doubt",
            f" was zeroed while it was touched (taxels: {board['in_doubt']}); those are "
            f"not valid until calibrated untouched: skin command configure --board {name}, then "
            f"skin command calibrate --board {name}",
        )
    if events.get("tx_overflows"):
        yield fault("board_overflows", " could not send all its frames: bus too full")
    if board.get("twice"):
        yield fault(
            "board_twice",
            ": two boards send at this address, or two gateways pass its frames on; give each "
            "board an address of its own, and its bus one gateway",
        )
        return
    wanted, seen, jitter_ms = board["period_ms"], board["period_seen_ms"], board["jitter_ms"]
    if events.get("excess"):
        yield fault(
            "board_period",
            f" sends far more often than every {wanted} ms: {board['excess']} of its sweeps were "
            "too many to be processed; check its firmware, and what else sends at its address",
        )
    elif board["alive"] and seen is not None and jitter_ms is not None:
        if abs(seen - wanted) > PERIOD_SHARE * wanted:
            yield fault("board_period", f" sends every {seen:.1f} ms instead of {wanted} ms")
        elif jitter_ms > JITTER_SHARE * wanted and not board.get("held_up"):
            yield fault(
                "board_jitter", f" sends irregularly: its {wanted} ms scatter by {jitter_ms:.1f} ms"
            )


def _line_of(board: BoardHealth, triangle: int) -> int:
    return _ERGO_HAND_LINES[triangle] if board.get("skin_type") == 3 else triangle // LINE


def _triangles(record: Record, silent: set[str]) -> Iterator[FoundFault]:
    if not (record["triangles"] or record.get("other_triangles")):
        return
    boards = {board["name"]: board for board in record["boards"]}
    of_line: dict[tuple[str, int], dict[int, str]] = defaultdict(dict)
    own: dict[tuple[str, int], dict[int, str]] = defaultdict(dict)
    for of, ones in ((own, record["triangles"]), (of_line, record.get("other_triangles", []))):
        for one in ones:
            if one["board"] not in silent:
                line = _line_of(boards[one["board"]], one["triangle"])
                of[one["board"], line][one["triangle"]] = one["fault"]
    # A line that parts share fails as a whole; each of them reports it.
    for where, faults in own.items():
        of_line[where] |= faults
    reported: set[tuple[str, int]] = set()
    for name, board in boards.items():
        lines = {line: faults for (owner, line), faults in of_line.items() if owner == name}
        fitted: dict[int, set[int]] = defaultdict(set)
        for triangle in board["fitted"]:
            fitted[_line_of(board, triangle)].add(triangle)
        whole = [line for line, faults in lines.items() if set(faults) == fitted[line]]
        for line in whole:
            dead = set(lines[line].values()) <= {"no ack", "silenced"}
            if dead and len(fitted[line]) > 1 and (name, line) in own:
                reported.add((name, line))
                yield FoundFault(
                    "line_shorted",
                    f"{name}/line{line}",
                    f"board {name}: triangles {_list(fitted[line])} all stopped answering: their "
                    "common data line is shorted or torn, often by one of them",
                )
        mixed = [
            line
            for line in sorted(whole)
            if (name, line) not in reported and set(lines[line].values()) & {"out of range"}
        ]
        if len(mixed) == 2 and any((name, line) in own for line in mixed):
            reported |= {(name, line) for line in mixed}
            yield FoundFault(
                "lines_swapped",
                f"{name}/line{mixed[0]}+{mixed[1]}",
                f"board {name}: the triangles {_list(fitted[mixed[0]])} and "
                f"{_list(fitted[mixed[1]])} all read wrong at once: are the plugs of their two "
                "data lines swapped? Put them right, or calibrate and change the configuration",
            )
    for (name, line), faults in own.items():
        if (name, line) in reported:
            continue
        for triangle, fault in sorted(faults.items()):
            sentence = _TRIANGLE_SENTENCES[fault].format(board=name)
            if fault == "not connected" and len(of_line[name, line]) > 1:
                sentence += " (another one on its line reads wrong too: does it have this address?)"
            code = "triangle_" + fault.replace(" ", "_")
            yield FoundFault(
                code, f"{name}/{triangle}", f"triangle {triangle} of board {name} {sentence}"
            )


def _taxels(record: Record) -> Iterator[FoundFault]:
    def fault(code: str, taxels: Collection[int], what: str) -> FoundFault:
        part = record["part"]
        return FoundFault(code, part, f"{named(taxels)} of {part}: {what}")

    for kind, what in _TAXEL_FAULTS.items():
        taxels = record["taxel_faults"].get(kind)
        if taxels:
            yield fault(f"taxel_{kind}", taxels, what)
    verdicts = record["taxel_verdicts"]
    if noisy := verdicts.get("noisy"):
        what = f"a decision within a second takes up to {record['decides_kpa']:g} kPa"
        yield fault("taxel_decides_late", noisy, f"noisy when calibrated; {what}")
    if saturated := verdicts.get("saturates"):
        yield fault(
            "taxel_saturates",
            saturated,
            "rest so near 0 that a press is cut off; set the boards up again, then calibrate",
        )
    # A calibration leaves stuck pads out.
    stuck = record["taxel_faults"].get("stuck", ())
    if touched := [taxel for taxel in verdicts.get("touched", ()) if taxel not in stuck]:
        yield fault(
            "taxel_pressed", touched, "touched when calibrated; calibrate when nothing touches"
        )
    if unreached := verdicts.get("unreached"):
        reason = _why_unreached(unreached, verdicts)
        yield fault("taxel_unreached", unreached, f"not valid: no press would be felt: {reason}")
    # If the triangle is already reported as missing, its taxels were absent because of that.
    kinds = _REFUSED if record["triangles"] else _REFUSED | _NOT_RECEIVED
    invalid = set(record["invalid"])
    why = {kind: invalid & set(verdicts.get(kind, ())) for kind in kinds}
    refused = set().union(*why.values())
    if refused:
        reasons = " or ".join(kinds[kind] for kind, taxels in why.items() if taxels)
        yield fault(
            "taxel_refused",
            refused,
            f"{reasons} when calibrated or set up; not valid until a better one",
        )
    if record["baseline_at_limit"]:
        yield fault(
            "taxel_at_limit",
            record["baseline_at_limit"],
            "the baseline cannot follow any farther; calibrate",
        )
    if record["baseline_frozen"]:
        yield fault(
            "taxel_held",
            record["baseline_frozen"],
            "touched for so long, ever since the zero came into use, or with so much drift "
            "meanwhile, that the zero is uncertain; if nothing touches: skin command calibrate",
        )


def _why_unreached(unreached: Collection[int], verdicts: Mapping[str, Collection[int]]) -> str:
    """Why no reading of taxels would be a touch: the reasons of most, and of which others hold."""
    flat = set(verdicts.get("flat", ()))
    pressed = {*verdicts.get("touched", ()), *verdicts.get("saturates", ())} - flat
    reasons = {
        "the threshold is above all their readings; lower margin_units and "
        "minimum_threshold_units: skin command thresholds": set(unreached) - flat - pressed,
        "they rest so near 0, pressed as they were calibrated; set the boards up again, then "
        "calibrate, when nothing touches": pressed.intersection(unreached),
        "the curve does not rise with each unit, by their gain and bend of the calibration and by "
        "processing.pressure; correct that, or fit them again: skin calibrate --pressure": flat,
    }
    (first, _), *others = ((why, taxels) for why, taxels in reasons.items() if taxels)
    return "; ".join([first, *(f"of {named(taxels)} {why}" for why, taxels in others)])


def _part(record: Record) -> Iterator[FoundFault]:
    def fault(code: str, sentence: str) -> FoundFault:
        return FoundFault(code, record["part"], record["part"] + sentence)

    if record["state"] == "disabled":
        yield fault("part_disabled", " was disabled by command; nothing is published")
        return
    if record["calibration"] is None:
        yield fault("part_not_calibrated", " is not calibrated: nothing is published")
    warmth = record.get("warmth")
    if warmth is None:
        return
    thermal_units, common_units = warmth["thermal_units"], warmth["common_units"]
    least_units = COMMON_UNITS * warmth["coarsest_units"]
    lifted_units = LIFTED_UNITS * warmth["coarsest_units"]
    if thermal_units is not None and abs(thermal_units) > max(THERMAL_UNITS, least_units):
        yield fault(
            "part_temperature",
            f": its thermal pads read {thermal_units:+.0f} units since the "
            "calibration: its temperature has changed; pressures are corrected, less precisely",
        )
    elif abs(common_units) > least_units and common_units > -lifted_units:
        yield fault(
            "part_temperature",
            f": its untouched taxels all read {common_units:+.1f} units off their "
            "baselines: its temperature is changing",
        )


def _output(output: dict[str, Any] | None, lost_lately: Collection[str]) -> Iterator[FoundFault]:
    def fault(code: str, sentence: str) -> FoundFault:
        return FoundFault(code, "broker", sentence)

    if output is None:
        return
    if not output["connected"]:
        why = output.get("last_error") or "not yet reached"
        yield fault("broker_away", f"the broker is away: {why}")
    if "touches_dropped" in lost_lately:
        yield fault(
            "touches_dropped",
            f"touch events were lost within the last minute ({output['touches_dropped']} since the "
            "start): the broker was away for too long, or did not take them",
        )
    if output.get("withheld"):
        topics = ", ".join(output["withheld"])
        yield fault(
            "broker_rejects",
            f"the broker does not take what is published at {topics}; check its packet limit and "
            "its access rules",
        )
    if output.get("unsubscribed"):
        topics = ", ".join(output["unsubscribed"])
        yield fault(
            "broker_withholds",
            f"the broker does not let this node receive what is sent to {topics}; check its access "
            "rules (commands come through cmd/+)",
        )
    if output.get("name_taken"):
        yield fault(
            "node_name_taken",
            "the broker ends every connection within seconds: does a second daemon run as the same "
            "robot and node? Give one of them another --node",
        )
    if "refused" in lost_lately:
        yield fault("broker_refuses", f"the broker refuses: {output['last_error']}")


def named(taxels: Collection[int]) -> str:
    """Taxels in words: "taxels 1, 4-7, 9"; the first eight runs of many."""
    return f"{'taxel' if len(taxels) == 1 else 'taxels'} {_list(taxels)}"


def named_by_part(taxels: Mapping[str, Collection[int]]) -> str:
    """Taxels of several parts in words: "taxels 3-5, 9 of left_hand; taxel 1 of palm"."""
    return "; ".join(f"{named(numbers)} of {part}" for part, numbers in taxels.items())


def _list(numbers: Iterable[int]) -> str:
    """Numbers as a short list with ranges: 1, 4-7, 9."""
    ordered = sorted(numbers)
    texts = format_triangles(ordered).split(",")
    if len(texts) > 8:
        texts = [*texts[:8], f"... ({len(ordered)} in all)"]
    return ", ".join(texts)
