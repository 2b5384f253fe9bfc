"""What presses each pad, and what a valid reading of it may be: from the emulator's own truth.

Nothing here is taken from the daemon. Noise and flaws are those that the emulator drew for its
pads, places and outlines those of the layout, and errors those that `docs/accuracy.md` states.
"""

from collections import deque

import numpy as np
from numpy.typing import NDArray

from skin_host.config.settings import TouchSettings
from skin_host.evaluation.simulate.promises.limits import (
    CALIBRATED_KPA,
    DECIDES_DEVIATIONS,
    DECIDES_UNITS,
    ERROR_KPA,
    ERROR_SHARE,
    KEPT,
    LEFT_SHARE,
    NS,
    SAMPLE_S,
    SIGMAS,
    Mask,
)
from skin_host.evaluation.simulate.world import World
from skin_host.layout import TAXELS_PER_TRIANGLE, PadKind

Floats = NDArray[np.float64]
#: What pressed is kept as the least and the most of bins of this length, as many as are looked
#: back on.
BIN_NS = round(SAMPLE_S * NS)
BINS = 9


class Truth:
    """The true pressure of the whole skin lately, and bounds for what is read of it.

    Attributes:
        kpa: float64[n], what presses each pad now, at the last look.
        hardest_kpa: float64[n], the hardest press of each since its foam last had time to recover.
        unit_kpa: float64[n], one unit of the byte at rest, by the configuration's equation.
        noise_kpa: float64[n], the rms that the emulator drew, that of the triangle's temperature
            pad included, which boards take off all of its pads.
        jump_kpa: float64[n], how far a flawed pad of real skin jumps when it is pressed.
        reads: bool[n], pads whose readings are pressures: without its cover skin feels earthed
            objects, and how near they are rather than how hard they press.
        decides_kpa: float64[n], what pressure is a touch within a second on fresh foam.
        felt_kpa: float64[n], what pressure is known by then, however little is called a touch.
    """

    def __init__(self, world: World) -> None:
        self._world = world
        layout, skin = world.layout, world.robot.skin
        pressure = world.settings.processing.pressure
        kpa_per_ff = pressure.b_kpa_per_ff / layout.sensitivity
        thermal = layout.pad_kind == PadKind.THERMAL
        of_thermal_ff = np.where(thermal, skin.noise_ff, 0.0).reshape(-1, TAXELS_PER_TRIANGLE)
        common_ff = np.repeat(of_thermal_ff.max(axis=1), TAXELS_PER_TRIANGLE)
        self.noise_kpa: Floats = np.hypot(skin.noise_ff, common_ff) * kpa_per_ff
        jumps = skin._jumps
        self.jump_kpa: Floats = np.where(jumps.can, jumps._by_ff, 0.0) * kpa_per_ff
        self.unit_kpa: Floats = layout.unit_ff * kpa_per_ff
        covered = [np.full(part.n_taxels, part.covered) for part in layout.parts]
        self.reads: Mask = np.concatenate(covered) & ~thermal
        self._margin_units = world.settings.processing.touch.margin_units
        self.decides_kpa = self._decides_kpa(self._margin_units)
        usual = min(self._margin_units, TouchSettings().margin_units)
        self.felt_kpa = self._decides_kpa(usual)
        self.kpa: Floats = np.zeros(layout.n_taxels)
        self.hardest_kpa: Floats = np.zeros(layout.n_taxels)
        self._bins: deque[tuple[int, Floats, Floats]] = deque(maxlen=BINS)
        self._began_ns = -BIN_NS
        self._noted_ns = -1

    @property
    def sampled(self) -> bool:
        """Enough is known to look back on."""
        return len(self._bins) == BINS

    def note(self) -> None:
        """Look at what presses now, as far as the robot has moved."""
        robot = self._world.robot
        if robot.t_ns == self._noted_ns:
            return
        self._noted_ns = robot.t_ns
        now_ns = self._world.clock.monotonic_ns()
        kpa = self.kpa = robot.skin.true_pressure_kpa()
        np.maximum(self.hardest_kpa, kpa, out=self.hardest_kpa)
        if now_ns - self._began_ns >= BIN_NS:
            self._began_ns = now_ns - now_ns % BIN_NS
            self._bins.append((self._began_ns, kpa.copy(), kpa.copy()))
        else:
            _, at_least, at_most = self._bins[-1]
            np.minimum(at_least, kpa, out=at_least)
            np.maximum(at_most, kpa, out=at_most)

    def note_margin(self, units: float) -> None:
        """An operator asks for a margin. It may be in use from now on, also after a restart; that
        another one was asked for later may have been lost.
        """
        self._margin_units = max(self._margin_units, units)
        self.decides_kpa = self._decides_kpa(self._margin_units)

    def recover(self, taxels: Mask) -> None:
        """The foam of some pads bool[n] has recovered."""
        self.hardest_kpa[taxels] = self.kpa[taxels]

    def least_kpa(self, since_ns: int) -> Floats:
        """Return what has pressed each pad [n] all the time in the last `since_ns`."""
        found: Floats = np.min([least for _, least, _ in self._lately(since_ns)], axis=0)
        return found

    def most_kpa(self, since_ns: int) -> Floats:
        """Return the hardest that has pressed each pad [n] in the last `since_ns`."""
        found: Floats = np.max([most for *_, most in self._lately(since_ns)], axis=0)
        return found

    def bounds_kpa(self, since_ns: int) -> tuple[Floats, Floats]:
        """Return the least and the most that a valid reading of each pad [n] may be.

        Between the least and the most that pressed in the last `since_ns`, but for the errors that
        are stated: a share of the pressure (foam and curve of a pad differ from the fitted ones),
        an absolute error (the foam's memory, drift), noise, rounding, what foam keeps of a press,
        and jumps of flawed pads.
        """
        off_kpa = ERROR_KPA + SIGMAS * self.noise_kpa + self.unit_kpa
        least = np.minimum(self.least_kpa(since_ns), CALIBRATED_KPA)
        least = np.maximum((1.0 - ERROR_SHARE) * least - off_kpa, 0.0)
        most = (1.0 + ERROR_SHARE) * self.most_kpa(since_ns) + KEPT * self.hardest_kpa
        return least, most + off_kpa + self.jump_kpa

    def firm(self, since_ns: int) -> Mask:
        """Return which pads [n] have been pressed for so long so hard that this is a touch."""
        firm_kpa = self.decides_kpa + LEFT_SHARE * self.hardest_kpa
        firm: Mask = self.least_kpa(since_ns) > firm_kpa
        return firm

    def _decides_kpa(self, margin_units: float) -> Floats:
        certain = (margin_units + DECIDES_UNITS) * self.unit_kpa
        return certain + DECIDES_DEVIATIONS * self.noise_kpa

    def _lately(self, since_ns: int) -> list[tuple[int, Floats, Floats]]:
        after_ns = self._world.clock.monotonic_ns() - since_ns - BIN_NS
        lately = [one for one in self._bins if one[0] > after_ns]
        return lately or [self._bins[-1]]
