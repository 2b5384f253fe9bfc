"""Faults in the log: few lines, however many there are and however often they come and go."""

import logging

log = logging.getLogger(__name__)

#: Faults are logged together, and not more often than this.
TELL_S = 60.0
#: Ports log these themselves, at once.
TOLD_BY_PORTS = {"bus_down", "bus_gone", "bus_off"}
#: A fault must have lasted for this long to be logged.
LASTING_S = 2.0


class Teller:
    """Logs faults that last and faults that are over, in at most one line a minute."""

    def __init__(self) -> None:
        self._since_s: dict[tuple[str, str], float] = {}
        self._logged: set[tuple[str, str]] = set()
        self._line_s = -TELL_S

    def look(self, told: dict[tuple[str, str], str], now_s: float) -> None:
        """Take in all faults there are now: their sentences by code and place."""
        told = {key: says for key, says in told.items() if key[0] not in TOLD_BY_PORTS}
        self._since_s = {key: self._since_s.get(key, now_s) for key in told}
        if now_s - self._line_s < TELL_S:
            return
        new = [
            key
            for key, since_s in self._since_s.items()
            if key not in self._logged and now_s - since_s >= LASTING_S
        ]
        over = [key for key in self._logged if key not in told]
        if not new and not over:
            return
        self._line_s = now_s
        self._logged = (self._logged - set(over)) | set(new)
        words = []
        if new:
            more = f" (and {len(new) - 1} more faults; see `skin status`)" if len(new) > 1 else ""
            words.append(told[new[0]] + more)
        if over:
            names = ", ".join(f"{code} {where}" for code, where in sorted(over)[:3])
            words.append(f"over: {names}" + (f" and {len(over) - 3} more" * (len(over) > 3)))
        log.log(logging.WARNING if new else logging.INFO, "%s", "; ".join(words))
