"""Events as lines for people."""

import json

from skin_host.errors import visible
from skin_host.fingertip.events import Over, Slip
from skin_host.processing.events import Touch

#: What first indicated a slip.
_CAUSES = {
    "rate": "by how fast the tangential force changes",
    "friction": "at the limit of friction",
    "fall": "by the fall of the tangential force",
}


def event_line(event: Touch | Slip | Over) -> str:
    match event:
        case Touch():
            return _touch_line(event)
        case Slip(event="begin"):
            told = (
                f"begins, {_CAUSES[event.cause]}: {event.force_n:.2f} N normal, "
                f"{event.shear_n:.2f} N tangential, {event.shear_rate_n_s:+.1f} N/s"
            )
            return _line(event.part, "slip", event.id, told)
        case Over(event="begin"):
            return _line(event.part, "over", event.id, f"begins: {event.force_n:.2f} N normal")
        case _:
            kind = "slip" if isinstance(event, Slip) else "over"
            return _line(event.part, kind, event.id, "ends")


def _line(part: str, kind: str, number: int, told: str) -> str:
    return f"{visible(part):<14} {kind:<5} #{number:<4} {told}".rstrip()


def _touch_line(touch: Touch) -> str:
    taxels = ", ".join(map(str, touch.taxels[:8])) + (" ..." if len(touch.taxels) > 8 else "")
    where = " " * 19
    if touch.centroid_m is not None:
        x_mm, y_mm = 1e3 * touch.centroid_m[0], 1e3 * touch.centroid_m[1]
        where = f"({x_mm:6.1f},{y_mm:6.1f}) mm "
    peak = " " * 10 if touch.peak_kpa is None else f"{touch.peak_kpa:6.1f} kPa"
    force = f"{'≥' if touch.force_is_bound else ''}{touch.force_n:.2f}"
    load = f"{peak} {force:>6} N"
    if touch.event == "end":
        load = " " * len(load)
    felt = f"  taxels {taxels}" if taxels else ""
    why = f"  {touch.reason}: it may still last" if touch.may_last else ""
    return _line(touch.part, touch.event, touch.id, f"{where} {load}{felt}{why}")


def missed_line(event: Touch | Slip | Over, *, as_json: bool) -> str:
    """Return a line that reports how many events were lost before this one."""
    kind = type(event).__name__.lower()
    if as_json:
        return json.dumps({"missed": event.missed, "part": event.part, "kind": kind})
    return f"({event.missed} {kind} events of {visible(event.part)} were missed)"
