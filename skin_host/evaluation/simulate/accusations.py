"""What health reports against what really happens: no fault without a cause, no cause unnamed.

A fault that health reports must be explained by a trouble: by its code, by its place, and in time.
A trouble that must be reported is, within its bound, when nothing else can hide it.
"""

from typing import Any

import numpy as np

from skin_host.evaluation.simulate.troubles.computer import LONGEST_STALL_S
from skin_host.evaluation.simulate.troubles.trouble import Trouble
from skin_host.evaluation.simulate.world import World
from skin_host.mqtt.connection import GRACE_S, LAST_RETRY_S, TIMEOUT_S

NS = 1_000_000_000
#: Health reports these for a minute after they happened; it looks ten times a second.
LATELY = {
    "board_lost_set_up",
    "board_overflows",
    "board_reset",
    "board_rezeroed",
    "broker_refuses",
    "touches_dropped",
}
#: A board's set-up takes up to 10 s more, and the first record after a stall may be of before it.
LATELY_NS = round((62.0 + 10.0 + LONGEST_STALL_S) * NS)
#: Events go on being lost until the daemon has noticed that its broker is back.
CONNECTED_NS = round((TIMEOUT_S + GRACE_S + LAST_RETRY_S) * NS)
#: These last until the skin is calibrated at rest, is enabled, or something could be written: their
#: sentences ask for that. That two boards sent at an address is true until one has sent for a
#: second, however long its bus is away before.
LASTING = {
    "board_in_doubt",
    "board_twice",
    "part_disabled",
    "part_temperature",
    "state_not_kept",
    "taxel_at_limit",
    "taxel_decides_late",
    "taxel_drifting",
    "taxel_held",
    "taxel_pressed",
    "taxel_refused",
    "taxel_returned",
    "taxel_saturates",
    "taxel_unreached",
}
#: All others end with their cause, after the time that a board's next set-up may take (8 s until it
#: is queried, 2 s until it is set up, 2 s for its zero), and the 3 s for which health holds what
#: comes and goes. Pads that were stuck or noisy need some samples to prove themselves.
PASSING_NS = 20 * NS
#: A board that fell silent is queried every 8 s at least, and set up in less than 4 s.
BACK_NS = 12 * NS
#: A board that does not send what it should is set up again after up to a minute.
WRONG_NS = 75 * NS
SLOW = {
    "board_period",
    "triangle_missing",
    "triangle_answers_again",
    "triangle_silenced",
    "triangle_frozen",
    "triangle_constant",
    "taxel_unproven",
    "taxel_stuck",
    "triangle_out_of_range",
    "taxel_out_of_range",
    "triangle_not_connected",
    "triangle_no_ack",
    "line_shorted",
    "lines_swapped",
}
#: Codes that need no trouble: pads differ from the start, presses are long, and the skin drifts.
ALWAYS = {
    "fingertip_not_calibrated",
    "part_not_calibrated",
    "taxel_decides_late",
    "taxel_drifting",
    "taxel_held",
}
#: One pad in twenty of real skin is so noisy that a calibration refuses it.
NOISE = {"taxel_refused", "taxel_noisy", "taxel_saturates"}
#: A fingertip that was loaded when its zero was taken is as noisy as that, and touched afterwards.
OF_LOADS = {"fingertip_noisy", "fingertip_unreached", "fingertip_held", "fingertip_pressed"}
#: A trouble is plain if nothing else happened for so long before it, nor a start for longer.
QUIET_NS = 10 * NS
STARTED_NS = 15 * NS


class Accusations:
    """Compares.

    Args:
        world: what lives.

    Attributes:
        codes: what health reports now, by part.
        required: kinds of trouble that health had to name if they lasted.
        named: those of them that it named.
        troubles: those of now and lately: each with when it began, and ended.
        stuck: by part, the pads of real skin that have been stuck from the first.
    """

    def __init__(self, world: World) -> None:
        self._world = world
        self.codes: dict[str, set[str]] = {}
        self.required: set[str] = set()
        self.named: set[str] = set()
        self.troubles: list[tuple[Trouble, int, int | None]] = []
        #: Fingertips whose zero may be of a load.
        self.loaded: set[str] = set()
        self._faults: dict[str, set[tuple[str, str]]] = {}
        held = ~np.isnan(world.robot.skin.held_ff)
        self.stuck = {
            part.name: frozenset(np.flatnonzero(held[part.start : part.stop]).tolist())
            for part in world.layout.parts
        }
        #: Troubles, and when they began, for which it is known whether they were named in time.
        self._settled: set[tuple[str, int]] = set()

    def begin(self, trouble: Trouble) -> None:
        """A trouble begins."""
        now_ns = self._world.clock.monotonic_ns()
        if trouble.must:
            self.required.add(trouble.name)
        self.troubles.append((trouble, now_ns, None if trouble.lasts_s[1] else now_ns))

    def end(self, trouble: Trouble) -> None:
        """A trouble ends."""
        now_ns = self._world.clock.monotonic_ns()
        self.troubles = [
            (one, began, now_ns if one is trouble else over) for one, began, over in self.troubles
        ]

    def repaired(self) -> None:
        """All was set up, calibrated at rest and written: nothing of before lasts."""
        now_ns = self._world.clock.monotonic_ns()
        self.troubles = [
            one for one in self.troubles if one[2] is None or now_ns - one[2] < WRONG_NS
        ]

    def may_be_silent(self, board: str) -> bool:
        """Whether something keeps a board from being received, or did so lately."""
        now_ns = self._world.clock.monotonic_ns()
        return any(
            trouble.accuses("board_silent", board)
            and (over is None or trouble.lingers or now_ns - over < BACK_NS)
            for trouble, _, over in self.troubles
        )

    def may_damage(self, tip: str) -> bool:
        """Whether something damages what a fingertip's board sends, or did so lately."""
        return self._lately("fingertip_noisy", tip)

    def may_repeat(self, tip: str) -> bool:
        """Whether a fingertip's board repeats what it sent, or did so lately."""
        return self._lately("fingertip_frozen", tip)

    def may_lose(self, tip: str) -> bool:
        """Whether something loses what a fingertip's board sends, or did so lately."""
        return self._lately("fingertip_loses_frames", tip) or self._lately("bus_drops", tip)

    def may_wait(self, tip: str) -> bool:
        """Whether what a fingertip's board sends waits for a bus, or did so lately."""
        return self._lately("bus_babbling", tip)

    def _lately(self, code: str, where: str) -> bool:
        now_ns = self._world.clock.monotonic_ns()
        return any(
            trouble.accuses(code, where) and (over is None or now_ns - over < QUIET_NS)
            for trouble, _, over in self.troubles
        )

    def restarted(self) -> None:
        """Another daemon has reported nothing yet."""
        self.codes.clear()
        self._faults.clear()

    def note(self, part: str, record: Any) -> str | None:
        """Take a record of health; return a fault without a cause."""
        faults = {(fault["code"], fault["where"]) for fault in record["faults"]}
        if faults == self._faults.get(part):
            return None
        self._faults[part] = faults
        self.codes[part] = {code for code, _ in faults}
        for fault, text in zip(record["faults"], record["sentences"], strict=True):
            if not self._has_cause(fault["code"], fault["where"]):
                return f"{part}: accused without a cause: {text} ({fault['code']})"
        return None

    def _has_cause(self, code: str, where: str) -> bool:
        if code in ALWAYS or (code in NOISE and self._world.real_noise):
            return True
        if code in OF_LOADS and where in self.loaded:
            return True
        if code == "taxel_stuck" and self.stuck.get(where):
            return True
        now_ns = self._world.clock.monotonic_ns()
        longest_ns = PASSING_NS
        if code in LATELY:
            longest_ns = LATELY_NS + CONNECTED_NS * (where == "broker")
        elif code in SLOW:
            longest_ns = WRONG_NS
        return any(
            trouble.accuses(code, where)
            and (
                over is None
                or now_ns - over < longest_ns
                or trouble.lingers
                or code in LASTING
                or code in trouble.lasting
            )
            for trouble, _, over in self.troubles
        )

    def unnamed(self) -> str | None:
        """Return a trouble that health does not report within its bound."""
        now_ns = self._world.clock.monotonic_ns()
        said = set().union(*self.codes.values()) if self.codes else set()
        for trouble, began_ns, over in self.troubles:
            at_once = not trouble.lasts_s[1]
            if not trouble.must or (trouble.name, began_ns) in self._settled:
                continue
            if over is not None and not at_once:
                continue
            passed_ns = now_ns - began_ns
            late = passed_ns > trouble.within_s * NS
            if trouble.must & said:
                self.named.add(trouble.name)
            elif not late:
                continue
            self._settled.add((trouble.name, began_ns))
            if not trouble.must & said and self._is_plain(trouble, began_ns) and trouble.shows():
                wanted = " or ".join(sorted(trouble.must))
                return f"{trouble.about}: health lacks {wanted} after {trouble.within_s:g} s"
        return None

    def _is_plain(self, trouble: Trouble, began_ns: int) -> bool:
        """Whether nothing else can hide a trouble: no other, and a daemon that works."""
        life = self._world.life
        if life is None or life.dead or began_ns - life.began_ns < STARTED_NS or trouble.writes:
            return False
        engine = life.daemon.engine
        if engine.calibration is None or engine.calibrating or engine.disabled:
            return False
        return not any(
            one is not trouble and (over is None or began_ns - over < QUIET_NS)
            for one, _, over in self.troubles
        )
