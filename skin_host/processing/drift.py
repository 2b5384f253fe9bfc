"""Baselines that follow drift (paper, section V-C).

Once a window each taxel is in one of four states. Its baseline follows what the untouched
taxels of its part have in common, and a part of what its own reading has beyond that. A slow rise
is followed up to `SLOW_UNITS_PER_S`:

| state | when | own reading |
|---|---|---|
| idle | nothing touches the part | by the rule |
| disturbed | something touches or loads the part; or fallen | a slow rise, or `ALONE_UNITS_PER_S` |
| touched | touched, not received, or returned | a slow rise |
| recovering | `SETTLE_S` after a touch; or fallen for so long | by the rule; the whole fall |

| in common | when | is followed |
|---|---|---|
| drift | the part moves alike, and rises by less than `QUICK_UNITS_PER_S` | at once |
| perhaps a load | otherwise | up to `SLOW_UNITS_PER_S` |
| shown by few | `REFERENCES` are not untouched | a slow rise that all of these show |

What the readings can distinguish, and what they cannot:

- A load only raises a reading, so a fall of all taxels alike is drift or a release, at any
  rate. An even load of the whole part that rises slowly reads like drift, and is taken for it.
- A load may press while a zero is taken, and be in it: see `loaded_zeros`.
- A touch makes the skin around it bulge: untouched taxels read several units less while it
  lasts. If they were followed, they would read as touched afterwards.
- A hand warms what it holds, within minutes. A slow rise of a touched taxel is taken for that;
  where it becomes much, the zero is reported as uncertain. A slow fall is left alone: a grip
  that relaxes reads the same.
- Thermal pads respond to what drifts and not to what presses. How much each taxel follows those of
  its triangle is learnt while it is untouched.
- Foam that is late after a press reads too much for seconds: pauses of a grip are no time to
  recover. What reads more and more after a touch is a grip that was eased, against which the
  foam pushes back: it is not followed, and what was taken for drift since the touch ended is given
  back.
- What remains of a released contact is no touch: nothing latches.
"""

import math
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from skin_host.config.settings import Drift
from skin_host.processing.loaded_zeros import FALLEN_UNITS, LoadedZeros
from skin_host.processing.masks import Mask
from skin_host.processing.thermal import SMOOTHING_S, ThermalReference

Array = NDArray[np.float64]

#: Fewer untouched taxels than this do not represent the others, ...
REFERENCES = 4
#: ... but for a slow rise that all of them show, if they are this share of the part: the pads of a
#: fingertip that is in use are seldom free, and it becomes warm.
FEW_SHARE = 1.0 / 6.0
#: A part moves alike when this share of its received taxels stays within the tolerance of their
#: median. On an evenly pressed insole 52 to 75 % do, on drifting pads with noise of 1 unit 98 %.
ALIKE_SHARE = 0.8
#: Means of a window that differ by no more are the same: five times their noise on good pads.
TOLERANCE_UNITS = 0.5
#: Conversions of a window of a second at 50 ms: the mean of fewer is too noisy for that tolerance.
#: Whether the part moves alike is decided by means over as many.
CONVERSIONS = 20.0
#: Drift that skinManager follows reaches 0.2; air in the insole presses at 0.4 to 1.5.
QUICK_UNITS_PER_S = 0.4
#: Drift that a load may hide: 10 degrees in 10 minutes are 0.008.
SLOW_UNITS_PER_S = 0.01
#: A bulge of any depth that lasts for ten minutes does not become a touch. What rises is no bulge.
ALONE_UNITS_PER_S = 0.0005
#: Bulges without a touch are shorter, and so are the pauses of a flickering touch.
SETTLE_S = 5.0
#: A taxel recovers until the stored time in touch has faded to this.
RECOVERED_S = 1.0
#: Such means differ by no more without a change: five times their noise on good pads.
SMOOTH_TOLERANCE_UNITS = 0.25
#: A load that suddenly falls below this share of its value is eased.
EASED_SHARE = 0.8
#: A contact has released when less than this share of its largest reading remains ...
RELEASED_SHARE = 0.4
#: ... and at most this much of it can be drift that was not followed.
UNSEEN_UNITS = 3.5
#: It is no more than what may have drifted while a firm press hid it and no untouched taxel showed
#: it, what the reading under the touch has risen by, and this share of the relaxation, by which the
#: model of the foam may be wrong.
MODEL_ERROR_SHARE = 0.25
#: For so long that is found to be a load if the reading rises by more than this share of what free
#: foam would have lost of it.
REGRET_S = 180.0
HELD_SHARE = 0.5
#: For how long it counts that a load was eased when it is felt no more.
EASED_S = 60.0
#: A zero that is uncertain by more than the paper's resolution (5 kPa) is reported.
UNCERTAIN_UNITS = 2.0
#: So is one, after this time, of a taxel that has been touched ever since it came into use: no
#: reading has shown yet that it is right. After a night it may not be.
UNSHOWN_S = 60.0


class State(IntEnum):
    """What a baseline follows, see the module's table."""

    IDLE = 0
    DISTURBED = 1
    TOUCHED = 2
    RECOVERING = 3


def paper_step(units: Array, dt_s: float, rate_units_per_s: float, dead_band_units: float) -> Array:
    """Return the paper's change of baseline [n] for activations above it [n].

    A fixed rate towards the reading outside the dead band. (The paper prints "< 0.5" for
    the second comparison; it lacks the minus sign, which would pull all baselines down.)
    """
    step = rate_units_per_s * dt_s
    change: Array = step * ((units > dead_band_units) - 1.0 * (units < -dead_band_units))
    return change


def proportional_step(units: Array, dt_s: float, gain_per_s: float) -> Array:
    """Return the change of baseline [n] that closes the share gain x dt of the distance.

    The rule of the deployed iCub host, exact for any dt.
    """
    change: Array = -math.expm1(-gain_per_s * dt_s) * units
    return change


class BaselineTracker:
    """The baselines of the n taxels of one part.

    The readings that it follows must be corrected for relaxation: the residual that a touch leaves
    in the foam is not drift.

    Args:
        baseline: float64[n] in units, as calibrated; moved in place.
        usable: bool[n], taxels that measure pressure and are valid.
        triangle: int[n], the triangle of each taxel, any numbering.
        thermal: bool[n], pads that measure temperature.
        settings: the rule and its numbers.
        fineness: how many of the units of each taxel, a number or [n], are a usual one. Drift,
            noise and bulges are as many times as large in them: all is judged in usual units.

    Attributes:
        calibrated: float64[n], the baselines before any drift.
        shared_units: by how much, a number or [n], baselines moved in the last window with what the
            untouched taxels have in common and temperature pads show.
        owed_units: by how much, a number or [n], those of touched taxels are to rise with it when
            they are released, as they have not yet.
        is_released: whether most of the taxels that were pressed of late are free, which shows that
            what pressed the part has gone.
    """

    def __init__(
        self,
        baseline: Array,
        usable: Mask,
        triangle: NDArray[np.int32],
        thermal: Mask,
        settings: Drift,
        fineness: Array | float = 1.0,
    ) -> None:
        n = len(baseline)
        self.fineness = fineness
        self.baseline = baseline
        #: The baselines in usual units, while they are moved.
        self._zero: Array = baseline / fineness
        self.calibrated = baseline.copy()
        self.shared_units: Array | float = 0.0
        self.owed_units: Array | float = 0.0
        self.is_released = False
        self._loads = LoadedZeros(n)
        self._configure(usable, settings)
        self._thermal = ThermalReference(triangle, thermal) if np.any(thermal) else None
        #: Whether something may press on the whole part without any of its taxels being touched
        #: yet.
        self._loaded = False
        #: Whether the last window's common change was not followed at once.
        self._behind = False
        #: Whether any taxel is not idle.
        self._unsettled = False
        self._fallen_s: Array = np.zeros(n)
        self._last: Array = np.zeros(n)
        #: How far each reading is from what the untouched ones have in common, over as many windows
        #: as `CONVERSIONS` take.
        self._apart: Array = np.zeros(n)
        #: For how long each taxel has been free of touch, and its lowest reading since.
        self._free_s: Array = np.full(n, np.inf)
        self._lowest: Array = np.full(n, np.inf)
        #: Where a touch was released, or has ended by itself, so that its reading is taken for
        #: unseen drift: the baseline before, for how long it may yet go back, the reading with and
        #: without relaxation, by how much the reading without it has risen since, and which of
        #: the two it was.
        self._before: Array = np.zeros(n)
        self._taken_s: Array = np.zeros(n)
        self._taken_level: Array = np.zeros(n)
        self._taken_free: Array = np.zeros(n)
        self._risen: Array = np.zeros(n)
        self._by_itself: Mask = np.zeros(n, np.bool_)
        #: For how long a taxel that was given back its baseline yet counts as loaded.
        self._loaded_s: Array = np.zeros(n)
        #: Which taxels have been free since their zero came into use.
        self._shown: Mask = np.zeros(n, np.bool_)
        self._touches = _Touches(n)

    def step(
        self,
        units: Array,
        touched: Mask,
        missing: Mask,
        dt_s: float,
        relaxed_units: Array | float = 0.0,
        conversions: Array | float = CONVERSIONS,
        lowest: tuple[Array, Array] | None = None,
    ) -> NDArray[np.intp] | None:
        """Move the baselines, in place.

        Args:
            units: mean activation [n] above the baseline in the last dt_s seconds. Entries
                of temperature pads count too.
            touched: taxels [n] that were touched at any time in it.
            missing: taxels [n] that were received too rarely in it for a mean.
            dt_s: that time. Where it is 0, nothing has changed.
            relaxed_units: the relaxation [n] that units was corrected for.
            conversions: how many independent measurements are in each mean, a number or [n].
            lowest: the lowest activation [n] of a shorter time in it, by default the mean, and the
                noise [n] of single readings.

        Returns:
            Numbers of taxels whose touch was recognised as drift, or None. Their baselines have
            moved up to their readings.
        """
        self.shared_units = 0.0
        if self._settings.rule == "none" or dt_s <= 0.0:
            return None
        touched = touched & self._usable
        hidden = self._usable & (touched | missing | self.returned)
        free = self._usable & ~hidden
        self._shown |= free
        of_late = self._touches.touched_s > RECOVERED_S
        recovering = free & of_late
        pressed = np.count_nonzero(touched | (of_late & self._usable))
        self.is_released = bool(2 * np.count_nonzero(recovering) > pressed)
        fine, forecast = self.fineness, None
        self._zero = self.baseline / fine
        if self._thermal is not None:
            forecast = self._thermal.step(units, self.baseline, free, missing, dt_s) / fine
        units, relaxed_units = units / fine, relaxed_units / fine
        if forecast is not None:
            units = units - forecast
            self._note_drift(forecast)

        received = self._usable & ~missing
        shows = free & ~recovering
        low, noise = (units, 0.0) if lowest is None else (lowest[0] / fine, lowest[1] / fine)
        low = low + relaxed_units
        lifted = self._loads.lifted(low, noise, touched, received, dt_s)
        share = _share(conversions)
        share = np.where(shows | missing, share, 1.0)
        common = self._common(units, shows, int(np.count_nonzero(received)), share, dt_s)
        self.shared_units = (common if forecast is None else common + forecast) * fine
        if lifted is None and self._is_calm(units, common, hidden, dt_s):
            rate = self._settings.rate_units_per_s * dt_s
            change = self._own(units - common, rate, rate, dt_s)
            self._move(change + common, common, forecast)
            return None
        state = self._states(units, touched | self.returned, hidden, recovering, dt_s)
        held = recovering & ~self._remains(units, hidden, dt_s)
        given_back = free & (self._loaded_s > 0.0)
        state[held | given_back] = State.DISTURBED
        change = self._followed(units, common, state, shows & ~given_back, dt_s)
        fallen = self._fallen_s >= SETTLE_S
        change[fallen] = units[fallen]
        if lifted is not None:
            fallen = fallen | lifted
        self._loads.expect_back(fallen if common > FALLEN_UNITS else free | fallen, self._zero)
        if abs(common) <= QUICK_UNITS_PER_S * dt_s:
            self._note_drift(common)

        level = self._zero + units + relaxed_units
        still = (np.abs(level - self._last) < TOLERANCE_UNITS) & ~missing
        self._last = level
        shown = bool(np.count_nonzero(free) >= REFERENCES)
        change += self._touches.step(units, touched, dt_s, relaxed_units, shown)
        owed_units = self.owed_units / fine
        released = still & self._touches.released(units, touched, relaxed_units, owed_units)
        change[released] = units[released]
        ended = recovering & (self._free_s <= dt_s) & (self._taken_s <= 0.0)
        self._by_itself = (self._by_itself | ended) & ~released
        change += self._given_back(units, level, touched, released | ended, dt_s)
        if lifted is not None:
            change[lifted] = low[lifted]
        self._loads.note_returns(level, self._zero, still, missing, dt_s)
        self._move(change, common, forecast)
        self._unsettled = self._touches.fading or bool(
            np.count_nonzero(self._fallen_s)
            or self._loads.may_return
            or np.count_nonzero(self._taken_s > 0.0)
            or np.count_nonzero(self._loaded_s > 0.0)
        )
        found = np.flatnonzero(released)
        return found if len(found) else None

    def pass_gap(self, gap_s: float) -> None:
        """Nothing was received for this time: a touch after it is a new touch."""
        self._touches.fade(math.exp(-gap_s / SETTLE_S))

    def catch_up(self, units: Array) -> None:
        """Taxels have drifted by this [n] while they were not received."""
        self._note_drift(units / self.fineness)
        np.clip(self.baseline + units * self._usable, self._low, self._high, out=self.baseline)
        if self._thermal is not None:
            self._thermal.miss(units != 0.0)

    def forget(self, taxels: Mask) -> None:
        """Start again with some taxels, bool[n]: their baselines are new, and drift counts from
        them.
        """
        np.copyto(self.calibrated, self.baseline, where=taxels)
        self._configure(self._usable, self._settings)
        touched_s = self._touches.touched_s
        for memory in (self._fallen_s, self._taken_s, self._loaded_s, touched_s):
            memory[taxels] = 0.0
        self._loads.forget(taxels)
        self._apart[taxels] = 0.0
        self._shown[taxels] = False
        if self._thermal is not None:
            self._thermal.forget(taxels)

    def renew(self, usable: Mask, zeroed: Mask, settings: Drift) -> None:
        """Continue with other settings, and from new baselines of the taxels `zeroed`, bool[n]."""
        self._configure(usable, settings)
        if settings.rule == "none":
            # Nothing moves that a touch could hold, and nothing would end what is known of touches.
            self._touches = _Touches(len(zeroed))
            self._loads = LoadedZeros(len(zeroed))
        self.forget(zeroed)

    def _configure(self, usable: Mask, settings: Drift) -> None:
        self._usable = usable
        self._settings = settings
        self._low = self.calibrated - settings.limit_units * self.fineness
        self._high = self.calibrated + settings.limit_units * self.fineness
        rates = {
            State.IDLE: settings.rate_units_per_s,
            State.DISTURBED: ALONE_UNITS_PER_S,
            State.TOUCHED: 0.0,
            State.RECOVERING: settings.rate_units_per_s,
        }
        self._own_rate = np.array([rates[state] for state in State])

    @property
    def returned(self) -> Mask:
        """Return taxels [n] that read what their baseline was before it fell: they are pressed
        again, or it has returned. The array changes only by being replaced.
        """
        return self._loads.returned

    @property
    def frozen(self) -> Mask:
        """Return taxels [n] whose zero is uncertain: touched for long, ever since it came into use,
        or with much drift meanwhile.
        """
        longest_s = self._settings.frozen_report_s
        limit_s = np.where(self._shown, longest_s, min(longest_s, UNSHOWN_S))
        long = self._touches.touched_s >= limit_s
        return long | (self._touches.drifted > UNCERTAIN_UNITS)

    @property
    def at_limit(self) -> Mask:
        """Return taxels [n] whose baseline is at its greatest permitted distance from the
        calibration.
        """
        edge = (self.baseline <= self._low) | (self.baseline >= self._high)
        return edge & self._usable

    @property
    def may_be_loaded(self) -> bool:
        """Whether the untouched taxels rose faster than drift in the last window, so that something
        may press on the whole part.
        """
        return self._loaded

    def _common(self, units: Array, free: Mask, received: int, share: Array, dt_s: float) -> float:
        """Return how much of the untouched taxels' common change is followed.

        Args:
            units, dt_s: see `step`.
            free: untouched taxels, bool[n].
            received: how many usable taxels were received, touched ones as well.
            share: of this window [n] in the mean by which each taxel moves alike or does not.
        """
        self._loaded = False
        reading = units[free]
        limit = SLOW_UNITS_PER_S * dt_s
        if len(reading) < REFERENCES:
            enough = len(reading) >= max(FEW_SHARE * received, 2.0)
            return min(max(float(reading.min()), 0.0), limit) if enough else 0.0
        median = _median(reading)
        # Where noise has made the last window differ, this one has the drift of both.
        self._loaded = median > QUICK_UNITS_PER_S * dt_s * (2.0 if self._behind else 1.0)
        self._apart += share * (units - median - self._apart)
        alike = np.count_nonzero(np.abs(self._apart[free]) < TOLERANCE_UNITS)
        self._behind = bool(self._loaded or alike < ALIKE_SHARE * received)
        if not self._behind:
            return median
        reading = reading[reading > FALLEN_UNITS]
        if len(reading) < REFERENCES:
            return 0.0
        return min(max(_median(reading), -limit), limit)

    def _is_calm(self, units: Array, common: float, hidden: Mask, dt_s: float) -> bool:
        """Whether all taxels are idle, and none needs more than its own rule."""
        return not (
            self._unsettled
            or self._loaded
            or abs(common) > self._settings.rate_units_per_s * dt_s
            or np.count_nonzero(hidden)
            or np.count_nonzero((units < FALLEN_UNITS) & self._usable)
        )

    def _move(self, change: Array, common: float, forecast: Array | None) -> None:
        """Move the baselines, within their limits, by `common` and what each moves beyond it."""
        self._apart -= change - common
        if forecast is not None:
            change += forecast
        change *= self._usable
        np.add(self._zero, change, out=self._zero)
        np.multiply(self._zero, self.fineness, out=self.baseline)
        np.fmax(self.baseline, self._low, out=self.baseline)
        np.fmin(self.baseline, self._high, out=self.baseline)

    def _remains(self, units: Array, hidden: Mask, dt_s: float) -> Mask:
        """Which taxels [n] read what remains of a touch: for long enough, and not more and more."""
        self._free_s += dt_s
        self._free_s[hidden] = 0.0
        level = self._zero + units
        np.fmin(self._lowest, level, out=self._lowest)
        self._lowest[hidden] = np.inf
        calm = level < self._lowest + 2.0 * TOLERANCE_UNITS
        remains: Mask = calm & (self._free_s > SETTLE_S)
        return remains

    def _note_drift(self, change: Array | float) -> None:
        """All readings have changed by this: those from before would be others now."""
        self._loads.note_drift(change)
        self._before += change
        self._taken_free += change
        self._taken_level += change

    def _given_back(
        self, units: Array, level: Array, touched: Mask, ended: Mask, dt_s: float
    ) -> Array | float:
        """Return the change [n] of baselines that took a load that had been eased for drift.

        Foam that is free comes back: its reading falls, relaxation included (`level` [n]), by what
        the model of the foam expects. Where it falls by less than half of that, the corrected
        reading rises: something still presses the foam.
        """
        self._loaded_s -= dt_s
        free = self._zero + units
        self._before[ended] = self._zero[ended]
        self._taken_level[ended] = level[ended]
        self._taken_free[ended] = free[ended]
        self._risen[ended] = 0.0
        self._taken_s[ended] = REGRET_S
        if not np.count_nonzero(self._taken_s > 0.0):
            return 0.0
        since_s = REGRET_S - self._taken_s
        settling = np.where(since_s < SETTLE_S, dt_s / (since_s + dt_s), 0.0)
        self._taken_free += settling * (free - self._taken_free)
        self._taken_level += settling * (level - self._taken_level)
        # A press, which rises before its mean does, is no foam that pushes back. After a release it
        # is a reason to doubt it: too much may have been taken at once.
        pressed = touched & self._by_itself & (free - self._taken_free > UNSEEN_UNITS)
        self._taken_s[pressed & ~ended] = 0.0
        share = -math.expm1(-dt_s / SMOOTHING_S)
        self._risen += share * (free - self._taken_free - self._risen)
        expected = (self._taken_level - self._taken_free) - (level - free)
        load = (self._taken_s > 0.0) & (self._risen > TOLERANCE_UNITS) & ~ended
        load &= self._risen > HELD_SHARE * expected
        given = np.where(load, np.minimum(self._before - self._zero, 0.0), 0.0)
        self._taken_s -= dt_s
        self._taken_s[load] = 0.0
        self._loaded_s[load & ~touched] = REGRET_S
        return given

    def _states(
        self, units: Array, touched: Mask, hidden: Mask, recovering: Mask, dt_s: float
    ) -> NDArray[np.int8]:
        """Return the state of each taxel, and update for how long each has been fallen."""
        touching = bool(np.count_nonzero(touched))
        disturbed = touching or self._loaded
        state = np.full(len(units), State.DISTURBED if disturbed else State.IDLE, np.int8)
        fallen = units < FALLEN_UNITS
        state[fallen] = State.DISTURBED
        state[recovering] = State.RECOVERING
        state[hidden] = State.TOUCHED
        # A bulge lasts as long as the touch beside it, and relaxation is overestimated after a
        # touch, so that time does not count.
        self._fallen_s += 0.0 if touching else dt_s
        self._fallen_s *= fallen & self._usable & ~hidden & ~recovering
        return state

    def _followed(
        self, units: Array, common: float, state: NDArray[np.int8], shows: Mask, dt_s: float
    ) -> Array:
        """Return the change of each baseline: the common change, and what a reading has beyond
        it.

        Args:
            units, common, dt_s: see `step` and `_common`.
            state: of each taxel, int8[n].
            shows: which, bool[n], have not been touched of late, so that a slow rise is their own.
        """
        # An undisturbed taxel that differs from the others moves no farther than its reading.
        differs = (np.abs(units - common) > TOLERANCE_UNITS) & (
            (state == State.IDLE) | (state == State.RECOVERING)
        )
        shared = np.full(len(units), common)
        np.clip(units, min(common, 0.0), max(common, 0.0), out=shared, where=differs)
        beyond = units - shared
        limit = self._own_rate[state] * dt_s
        slow = min(SLOW_UNITS_PER_S, self._settings.rate_units_per_s) * dt_s
        # What noise may be is followed as slowly up as down: it would lift the baseline otherwise.
        risen = shows & (beyond > TOLERANCE_UNITS) & (not self._loaded)
        change = self._own(beyond, np.fmax(limit, slow * risen), limit, dt_s)
        change += shared
        return change

    def _own(self, beyond: Array, rise: Array | float, fall: Array | float, dt_s: float) -> Array:
        """Return the change by the rule, within its limits, for what readings have beyond the
        common change.
        """
        settings = self._settings
        if settings.rule == "paper":
            change = paper_step(beyond, dt_s, settings.rate_units_per_s, settings.dead_band_units)
        else:
            change = proportional_step(beyond, dt_s, settings.gain_per_s)
        np.fmin(change, rise, out=change)
        np.fmax(change, np.negative(fall), out=change)
        return change


class _Touches:
    """History of n taxels since they were touched.

    Attributes:
        touched_s: for how long; it fades after the touch, because the touch may only flicker.
        drifted: how many units their baselines have followed a slow rise during the touch.
    """

    def __init__(self, n: int) -> None:
        self.touched_s: Array = np.zeros(n)
        self.drifted: Array = np.zeros(n)
        #: For how long they have been pressed firmly while no untouched taxel showed the drift.
        self._hidden_s: Array = np.zeros(n)
        self._peak: Array = np.zeros(n)
        #: The smoothed reading, and its lowest value while the load was steady.
        self._level: Array = np.zeros(n)
        self._lowest: Array = np.zeros(n)
        #: The same with the relaxation, and by how much it has slowly risen under the touch.
        self._reading: Array = np.zeros(n)
        self._risen: Array = np.zeros(n)
        self._before: Mask = np.zeros(n, np.bool_)
        #: The highest level that a load was suddenly eased from.
        self._eased: Array = np.zeros(n)
        self._fading_s = 0.0

    def step(
        self,
        units: Array,
        touched: Mask,
        dt_s: float,
        relaxed_units: Array | float,
        shown: bool,
    ) -> Array | float:
        """Return the slow rise [n] that the baselines of touched taxels follow.

        Args:
            units, touched, dt_s, relaxed_units: see `BaselineTracker.step`.
            shown: whether untouched taxels show the drift.
        """
        if np.count_nonzero(touched):
            self._fading_s = 10.0 * SETTLE_S
        elif self._fading_s <= 0.0:
            return 0.0
        self._fading_s -= dt_s
        self.fade(
            np.where(touched, 1.0, math.exp(-dt_s / SETTLE_S) if self._fading_s > 0.0 else 0.0)
        )
        self.touched_s += dt_s * touched
        np.fmax(self._peak, units, out=self._peak, where=touched)
        if not shown:
            self._hidden_s += dt_s * (touched & ~self._fallen(units))

        share = -math.expm1(-dt_s / SMOOTHING_S)
        distance = units - self._level
        changed = ~self._before | (np.abs(distance) > 2.0 * TOLERANCE_UNITS)
        # While foam is held it loses pressure, not reading: drift shows even where that hides it.
        moved = units + relaxed_units - self._reading
        moved = np.where(changed, moved, share * moved)
        self._reading += moved
        moved[changed] = 0.0
        self._risen = np.fmax(self._risen + moved, 0.0)
        # Foam that was pressed harder before pushes back more and more: that rise is a load.
        np.fmax(self._eased, self._level, out=self._eased, where=units < EASED_SHARE * self._level)
        self._eased *= np.where(self._before, 1.0, math.exp(-dt_s / EASED_S))
        self._before = touched
        self._level += np.where(changed, distance, share * distance)
        # So is a rise that is too fast for the baselines.
        changed |= self._level - self._lowest > 3.0 * TOLERANCE_UNITS
        self._lowest = np.where(changed, self._level, np.minimum(self._lowest, self._level))
        rise = self._level - self._lowest - SMOOTH_TOLERANCE_UNITS
        rise = np.clip(rise, 0.0, SLOW_UNITS_PER_S * dt_s) * touched
        rise *= self._level > EASED_SHARE * self._eased
        self._level -= rise
        self._reading -= rise
        self._risen = np.fmax(self._risen - rise, 0.0)
        self.drifted += rise
        return rise

    def fade(self, kept: Array | float) -> None:
        """Forget all but this share [n] of what is known."""
        self.touched_s *= kept
        self.drifted *= kept
        self._hidden_s *= kept
        self._risen *= kept
        self._peak *= kept

    @property
    def fading(self) -> bool:
        """Whether any touch is still remembered."""
        return self._fading_s > 0.0

    def released(
        self,
        units: Array,
        touched: Mask,
        relaxed_units: Array | float,
        owed_units: Array | float = 0.0,
    ) -> Mask:
        """Return which touched taxels [n] read no more than a released contact and drift can
        leave.

        Args:
            units, touched: of the last step.
            relaxed_units: the relaxation [n].
            owed_units: drift [n] that was shown, but not followed.
        """
        left = self._risen + MODEL_ERROR_SHARE * relaxed_units + SMOOTH_TOLERANCE_UNITS
        left = np.minimum(left + SLOW_UNITS_PER_S * self._hidden_s, UNSEEN_UNITS)
        left = np.minimum(left, SLOW_UNITS_PER_S * self.touched_s) + owed_units
        return touched & self._fallen(units) & (units < left)

    def _fallen(self, units: Array) -> Mask:
        """Return which taxels [n] read so much less than they did that what pressed them has gone.

        What reads so little hides no drift: it would show as a rise.
        """
        fallen: Mask = units < RELEASED_SHARE * self._peak
        return fallen


def _share(conversions: Array | float) -> Array:
    """Return the weight of a mean of so many conversions in one that is as steady as `CONVERSIONS`.

    Independent means, each of which enters a running mean with the share a, leave a / (2 - a) of
    their variance.
    """
    share: Array = np.minimum(2.0 * conversions / (conversions + CONVERSIONS), 1.0)
    return share


def _median(values: Array) -> float:
    """Return the upper median; numpy's own takes five times as long for so few values."""
    middle = len(values) // 2
    return float(np.partition(values, middle)[middle])
