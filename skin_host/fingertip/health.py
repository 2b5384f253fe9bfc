"""Health of the force/torque boards of fingertips: a record for each, and its faults.

The record is published as `<fingertip>/health`, with the same schema, `state`, `faults` and
`sentences` as that of a part of skin; `docs/operations.md` explains the other keys.
"""

from collections.abc import Iterator
from typing import NotRequired, TypedDict

from skin_host.bus.strain import StrainCounters, StrainType
from skin_host.fingertip.engine import FingertipEngine, TipState
from skin_host.health.diagnosis import FoundFault
from skin_host.health.record import FaultName
from skin_host.health.watch import Window

#: Rates are means over about this time.
RATE_NS = 2_000_000_000
#: Saturation and losses stay in the record for this long after they were last seen.
HOLD_NS = 3_000_000_000
#: Lone frames within `RATE_NS` are a fault from this number on, and from this share on.
FEW_LONE = 3
LONE_SHARE = 0.01


class FingertipRecord(TypedDict):
    """One fingertip. Counters count from the start of the daemon.

    `lone` are frames whose other half did not arrive, `silences` counts how often the board timed
    out or stopped to send whole samples, `age_ms` is of the last of these, `full_scale` is N and
    N m of its channels, `threshold_n` the least force of a contact, which noise may raise.
    """

    part: str
    kind: str
    state: str
    bus: str
    address: int
    samples: int
    rate_hz: float
    lone: int
    saturated: int
    doubled: int
    wrong_length: int
    excess: int
    silences: int
    full_scale: list[float] | None
    threshold_n: float
    touched: bool
    flags: list[str]
    age_ms: NotRequired[float | None]
    faults: list[FaultName]
    sentences: list[str]


class FingertipHealth:
    """Watches the fingertips of an engine. Times are those of the frames."""

    def __init__(self, engine: FingertipEngine) -> None:
        self._engine = engine
        self._windows = {name: Window(RATE_NS) for name in engine.tips}
        self._gained: dict[str, dict[str, float]] = {}
        #: When frames were lone last, and whether they were only late.
        self._lossy: dict[str, tuple[int, bool]] = {}

    def tick(self, now_ns: int) -> None:
        """Read the counters; to be called several times a second."""
        for name, state in self._engine.tips.items():
            counters = _counters(state)
            totals = {key: getattr(counters, key) for key in ("samples", "lone", "late")}
            gained = self._gained[name] = self._windows[name].note(now_ns, totals)
            if gained["lone"] >= max(FEW_LONE, LONE_SHARE * gained["samples"]):
                self._lossy[name] = now_ns, gained["late"] == gained["lone"]

    def records(self, now_ns: int | None) -> dict[str, FingertipRecord]:
        """Return the record of each fingertip; without a time (a replay) without ages."""
        return {name: self._record(state, now_ns) for name, state in self._engine.tips.items()}

    def _record(self, state: TipState, now_ns: int | None) -> FingertipRecord:
        assembler, table = state.assembler, state.settings
        counters = _counters(state)
        faults = list(self._faults(state, now_ns))
        gained = self._gained.get(state.name)
        rate_hz = gained["samples"] / gained["seconds"] if gained and gained["seconds"] else 0.0
        record: FingertipRecord = {
            "part": state.name,
            "kind": "fingertip",
            "state": _state(state, faults),
            "bus": table.bus,
            "address": table.address,
            "samples": counters.samples,
            "rate_hz": round(rate_hz, 2),
            "lone": counters.lone,
            "saturated": counters.saturated,
            "doubled": counters.doubled,
            "wrong_length": counters.wrong_length,
            "excess": counters.excess,
            "silences": state.silenced,
            "full_scale": None if assembler is None else assembler.full_scale.tolist(),
            "threshold_n": round(state.tip.threshold_n, 4),
            "touched": state.tip.touched,
            "flags": state.tip.flag_names,
            "faults": [{"code": fault.code, "where": fault.where} for fault in faults],
            "sentences": [fault.sentence for fault in faults],
        }
        if now_ns is not None:
            age_ms = (now_ns - state.last_ns) / 1e6
            record["age_ms"] = round(age_ms, 1) if state.last_ns else None
        return record

    def _faults(self, state: TipState, now_ns: int | None) -> Iterator[FoundFault]:
        """Each cause before its consequences: the first fault gives the state."""
        name, table, assembler = state.name, state.settings, state.assembler
        here = f"the force/torque board of {name} (bus {table.bus}, address {table.address})"

        def fault(code: str, sentence: str) -> FoundFault:
            return FoundFault(f"fingertip_{code}", name, sentence)

        if not state.frames and not state.awaited:
            yield fault("absent", f"{here} has not sent anything yet; check power and address")
        elif state.frames and not state.alive:
            yield fault(
                "silent", f"{here} has stopped sending; it is set up again; check its power"
            )
        elif state.twice:
            yield fault(
                "twice",
                f"{here} sends more than one board in {table.period_ms} ms: another one has its "
                "address, or two gateways pass its frames on; give each board an address of its "
                "own; it is set up again, in case it sends too often; until then nothing is felt",
            )
        elif state.incomplete:
            yield fault("incomplete", f"{here} {_incomplete(state)}")
        elif state.keeps_period is False:
            seen_ms = (state.sent_period_ns or 0.0) / 1e6
            yield fault(
                "period",
                f"{here} sends every {seen_ms:.3g} ms, not {table.period_ms} ms: slips may not be "
                "noticed; it is set up again; if this stays, another program sets it up, or it "
                f"cannot do that: change fingertips.{name}.period_ms",
            )
        if state.frames and assembler is None:
            yield fault(
                "not_configured",
                f"{here} does not report its full scales; set fingertips.{name}.full_scale",
            )
        if (before := state.scale_before) is not None:
            reported, used = (
                ", ".join(f"{value:g}" for value in scale)
                for scale in (state.reported_scale, before)
            )
            if state.exchanged:
                than = (
                    f"({used}) before, as another board does: nothing is felt; calibrate it "
                    "unloaded: skin command calibrate"
                )
            else:
                than = f"fingertips.{name}.full_scale, which is used"
            yield fault("scale", f"{here} reports other full scales ({reported}) than {than}")
        if state.alive and not state.incomplete and state.frozen.repeated:
            yield fault(
                "frozen",
                f"{here} repeats the same {' and '.join(state.frozen.repeated)} for longer than "
                "chance allows: its converter has stopped; switch it off and on",
            )
        if assembler is not None and not state.tip.zeroed:
            yield fault(
                "not_calibrated",
                f"{name} has no zero: no contact is reported; calibrate it unloaded: "
                "skin command calibrate",
            )
        if state.tip.zeroed_touched:
            yield fault(
                "pressed",
                f"{name}: touched when calibrated, by its zero before; calibrate it unloaded, "
                "again if this stays: skin command calibrate",
            )
        if state.tip.unreached:
            yield fault("unreached", _unreached(state))
        # The load that came or went is in that noise.
        if state.tip.threshold_n > table.threshold_n and not state.tip.zeroed_touched:
            yield fault(
                "noisy",
                f"{name}: contacts below {state.tip.threshold_n:.2f} N drown in the noise of its "
                f"board; fingertips.{name}.threshold_n asks for {table.threshold_n:g} N",
            )
        if now_ns is None:
            return
        if state.saturated_ns and abs(now_ns - state.saturated_ns) < HOLD_NS:
            yield fault("saturated", f"{here} is saturated: the load is beyond its range")
        lossy_ns, is_late = self._lossy.get(name, (now_ns - HOLD_NS, False))
        if abs(now_ns - lossy_ns) < HOLD_NS and not state.incomplete:
            yield fault("loses_frames", f"{here}: {_LATE if is_late else _LOST}")
        if self._engine.touched_for_ns(state) > self._engine.held_report_ns:
            yield fault(
                "held",
                f"{name} has been touched for so long that its zero is uncertain; calibrate it "
                "unloaded",
            )


_LOST = (
    "force comes without torque, or the reverse: frames are lost or late; the bus is overloaded or "
    "badly terminated"
)
_LATE = (
    "force and torque come so far apart that they may be of different samples; the bus is "
    "overloaded, or a computer that sends its frames or passes them on is busy"
)


def _counters(state: TipState) -> StrainCounters:
    return StrainCounters() if state.assembler is None else state.assembler.counters


def _incomplete(state: TipState) -> str:
    """Return what a board sends instead of whole samples, and what mends it."""
    names = {StrainType.FORCE: "force", StrainType.TORQUE: "torque"}
    came = [name for kind, name in names.items() if state.lately(state.half_ns.get(kind))]
    wrong = "frames of a wrong length" if state.lately(state.wrong_ns) else ""
    mend = "it is set up again; switch it off and on"
    if len(came) == len(names):
        sends = "force and torque that do not follow each other within a period"
        mend = "the bus is overloaded or badly terminated"
    elif came:
        (missing,) = set(names.values()) - set(came)
        sends = f"{came[0]} without {missing}" + (f", and {wrong}" if wrong else "")
    else:
        sends = f"only {wrong}"
    return f"sends {sends}: without whole samples nothing is felt; {mend}"


def _unreached(state: TipState) -> str:
    tip, here = state.tip, f"fingertips.{state.name}"
    mend = f"correct threshold_n, full_scale or matrix of {here}"
    if state.settings.threshold_n <= tip.reach_n:
        mend = (
            f"its zero was that noisy ({here}.threshold_n asks for "
            f"{state.settings.threshold_n:g} N); calibrate it unloaded: skin command calibrate"
        )
    return (
        f"{state.name}: contacts begin at {tip.threshold_n:.4g} N, and in some direction its board "
        f"measures only {tip.reach_n:.4g} N; {mend}"
    )


_STATES = {
    "fingertip_silent": "silent",
    "fingertip_incomplete": "silent",
    "fingertip_not_configured": "not configured",
    "fingertip_not_calibrated": "not calibrated",
    "fingertip_saturated": "saturated",
}


def _state(tip: TipState, faults: list[FoundFault]) -> str:
    if not tip.frames or not (faults or tip.frozen.trusted):
        return "no data"
    return _STATES.get(faults[0].code, "degraded") if faults else "ok"
