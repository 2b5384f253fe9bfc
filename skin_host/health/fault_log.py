"""Writes faults to the log, at most one line a minute however many faults come and go."""

import logging

log = logging.getLogger(__name__)

#: Faults are logged together, at most once in this time.
LINE_S = 60.0
#: Ports log these faults themselves, at once.
LOGGED_BY_PORTS = {"bus_down", "bus_gone", "bus_off"}
#: A fault is logged only after it has lasted for this long.
LASTING_S = 2.0


class FaultLog:
    """Logs faults that last, and the end of faults that were logged."""

    def __init__(self) -> None:
        self._since_s: dict[tuple[str, str], float] = {}
        self._logged: set[tuple[str, str]] = set()
        self._line_s = -LINE_S

    def note(self, present: dict[tuple[str, str], str], now_s: float) -> None:
        """Take in all present faults: their sentences by code and place."""
        present = {
            key: sentence for key, sentence in present.items() if key[0] not in LOGGED_BY_PORTS
        }
        self._since_s = {key: self._since_s.get(key, now_s) for key in present}
        if now_s - self._line_s < LINE_S:
            return
        new = [
            key
            for key, since_s in self._since_s.items()
            if key not in self._logged and now_s - since_s >= LASTING_S
        ]
        over = [key for key in self._logged if key not in present]
        if not new and not over:
            return
        self._line_s = now_s
        self._logged = (self._logged - set(over)) | set(new)
        words = []
        if new:
            words.append(present[new[0]])
            if len(new) > 1:
                faults = "one more fault" if len(new) == 2 else f"{len(new) - 1} more faults"
                words[-1] += f" (and {faults}; see `skin status`)"
        if over:
            names = ", ".join(f"{code} {where}" for code, where in sorted(over)[:3])
            words.append(f"over: {names}" + (f" and {len(over) - 3} more" * (len(over) > 3)))
        log.log(logging.WARNING if new else logging.INFO, "%s", "; ".join(words))
