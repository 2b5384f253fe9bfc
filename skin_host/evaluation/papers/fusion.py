"""One planar fingertip with an array and force/torque (Son et al.): each alone, and both as one.

The array locates a contact in the three ways of its section 2.2, and a fourth; samples without a
response give NaN. Force and torque locate it by one angle on a circle (section 3): the force is the
object's on the fingertip with reversed sign, so it points outward, from the centre to the contact.
Derivatives are the corrected ones: the paper's eq. 3.6 has a wrong sign in its second term, a wrong
denominator under dm and a missing square under dr.

Each makes up for the other (section 5). The array is blind to inertia but is
pulled aside by shear: the force sensor measures the shear. The force sensor is fast but is
hard to calibrate and answers every acceleration: the array shows its errors. Presses by
hand calibrate both corrections; a Kalman filter over place, speed and the force sensor's
remaining bias joins them in time.

All work on many samples at once. Places are in mm along the circumference, forces in N, torque in
N mm about the circle's centre.

`TrialFingertip` has all methods under test, in the tasks of section 4: a pin and a box are moved
along a 2 cm square at 4 cm/s, and turned by 20 degrees each way. Servo samples come at 300 Hz; the
array is read at every tenth.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from skin_host.errors import CalibrationError
from skin_host.evaluation.papers.force_torque import calibrate
from skin_host.evaluation.papers.truth import (
    LoadPatch,
    PlanarGauges,
    StripArray,
    box_patch,
    pin_patch,
    planar_load,
)
from skin_host.fingertip.low_pass import Butterworth2

Floats = NDArray[np.float64]

#: Vibration (10 to 20 Hz, Son et al. section 4.3) makes so many servo samples err alike, so
#: each counts for one of them.
ALIKE_SAMPLES = 6.0
#: Errors of the array, from strips and gains, do not average out over samples.
ARRAY_SD_MM = 0.06
#: Width of the window of `smooth_peak`, in pitches. Wide enough that a sum over places a
#: pitch apart is as good as an integral, narrow enough to leave far elements out.
WINDOW_PITCHES = 1.25
RATE_HZ = 300.0
ARRAY_EVERY = 10
RADIUS_MM = 15.7
GRASP_N = 3.0
#: A contact is set up by hand: it lies within so much of where it should.
SET_UP_MM = 0.5

NOISE_V = 1.0e-4
MASS_KG = 0.035
#: Methods of the paper; "force, 10 Hz" is its two-pole low-pass on the force sensor's places.
SINGLE_METHODS = ("centroid", "half maximum", "peak", "force")
METHODS = (*SINGLE_METHODS, "force, 10 Hz", "smooth peak", "fused")
TASKS = (
    "pin translation centred",
    "pin translation off centre",
    "pin rotation centred",
    "pin rotation off centre",
    "box translation",
    "box rotation",
)


@dataclass(frozen=True, slots=True)
class ArrayLayout:
    """Crossed strips wrapped around a cylinder (Son et al., Fig. 1).

    Attributes:
        around_mm: float64[columns], places along the circumference, from the middle.
        along_mm: float64[rows], places along the cylinder's axis, from the middle.
        radius_mm: of the outer surface.
        depth_mm: of the elements below it.
    """

    around_mm: Floats
    along_mm: Floats
    radius_mm: float
    depth_mm: float


def strip_array(
    *,
    strips: int = 8,
    pitch_mm: float = 2.0,
    radius_mm: float = 15.7,
    depth_mm: float = 2.4,
) -> ArrayLayout:
    """The 8 x 8 array of Son et al.: 2 mm pitch under 2.4 mm of rubber, radius 15.7 mm."""
    place: Floats = pitch_mm * (np.arange(strips, dtype=np.float64) - 0.5 * (strips - 1))
    return ArrayLayout(place, place.copy(), radius_mm, depth_mm)


def centroid(response: ArrayLike, around_mm: Floats, *, share: float = 0.0) -> Floats:
    """Centroid over all elements of at least `share` of the greatest (eq. 2.2).

    With share 0 it is the paper's simple centroid, with 0.5 its threshold centroid.
    """
    p = np.asarray(response, np.float64)
    if share > 0.0:
        p = np.where(p >= share * p.max(axis=(1, 2), keepdims=True), p, 0.0)
    # Negative readings stay: cutting them off would turn noise into load all over the array.
    columns = p.sum(axis=1)
    total = columns.sum(axis=1)
    total = np.where(total > 0.0, total, np.nan)
    place: Floats = columns @ around_mm / total
    return place


def peak(response: ArrayLike, around_mm: Floats) -> Floats:
    """Top of a parabola through the greatest element and its neighbours in its row.

    At an edge of the array the greatest element itself is the answer.
    """
    p = np.asarray(response, np.float64)
    n, _, columns = p.shape
    row, column = np.divmod(p.reshape(n, -1).argmax(axis=1), columns)
    inner = np.clip(column, 1, columns - 2)
    sample = np.arange(n)
    a, b, c = (p[sample, row, inner + side] for side in (-1, 0, 1))
    offset = quadratic_peak(a, b, c, float(around_mm[1] - around_mm[0]))
    place = around_mm[column] + np.where(inner == column, offset, 0.0)
    return np.where(p.max(axis=(1, 2)) > 0.0, place, np.nan)


def quadratic_peak(before: Floats, middle: Floats, after: Floats, pitch: float) -> Floats:
    """Return the offset of the top of a parabola through three readings in a row from the middle
    one.

    (p / 2)(a - c) / (a - 2 b + c). 0 where the three have no top, and never more than half
    a pitch: beyond that, another reading would have been the greatest.
    """
    bend = before - 2.0 * middle + after
    with np.errstate(divide="ignore", invalid="ignore"):
        offset = 0.5 * pitch * (before - after) / bend
    offset = np.where(bend < 0.0, offset, 0.0)
    limited: Floats = np.clip(offset, -0.5 * pitch, 0.5 * pitch)
    return limited


def smooth_peak(response: ArrayLike, around_mm: Floats, *, steps: int = 8) -> Floats:
    """Top of the profile after smoothing with a Gaussian window (mean shift).

    Each step takes the centroid within a window about the last. It looks neither at one
    element's noise, as `peak` does, nor at far elements, as `centroid` does, and has no
    threshold for elements to jump across.
    """
    profile = np.maximum(np.asarray(response, np.float64), 0.0).sum(axis=1)
    place: Floats = around_mm[profile.argmax(axis=1)]
    width = WINDOW_PITCHES * float(around_mm[1] - around_mm[0])
    for _ in range(steps):
        off = around_mm - place[:, None]
        weight = profile * np.exp(-0.5 * (off / width) ** 2)
        with np.errstate(divide="ignore", invalid="ignore"):
            # A bell under the window of its own width moves only half way: step twice.
            place = place + 2.0 * (weight * off).sum(axis=1) / weight.sum(axis=1)
    return place


def contact_angle(fx: ArrayLike, fy: ArrayLike, m: ArrayLike, radius_mm: float) -> Floats:
    """Angle of the contact, rad (eq. 3.5). NaN where |m| >= f r: no single contact.

    m = fy x - fx y = f r sin(psi - theta), psi the direction of the force.
    """
    fx, fy, m = (np.asarray(values, np.float64) for values in (fx, fy, m))
    with np.errstate(divide="ignore", invalid="ignore"):
        lever = m / (np.hypot(fx, fy) * radius_mm)
        lever = np.where(np.abs(lever) < 1.0, lever, np.nan)
    angle: Floats = np.arctan2(fy, fx) - np.arcsin(lever)
    return angle


@dataclass(frozen=True, slots=True)
class AngleDerivatives:
    """Derivatives of the contact angle: 1/N, 1/N, 1/(N mm), 1/mm."""

    fx: Floats
    fy: Floats
    m: Floats
    r: Floats


def angle_derivatives(
    fx: ArrayLike, fy: ArrayLike, m: ArrayLike, radius_mm: float
) -> AngleDerivatives:
    """Derivatives of `contact_angle` with respect to what goes into it."""
    fx, fy, m = (np.asarray(values, np.float64) for values in (fx, fy, m))
    f2 = fx**2 + fy**2
    f = np.sqrt(f2)
    g = np.sqrt(1.0 - (m / (f * radius_mm)) ** 2)
    pull = m / (radius_mm * f2 * f * g)
    return AngleDerivatives(
        fx=-fy / f2 + fx * pull,
        fy=fx / f2 + fy * pull,
        m=-1.0 / (f * radius_mm * g),
        r=m / (f * radius_mm**2 * g),
    )


def position_sd_mm(
    fx: ArrayLike,
    fy: ArrayLike,
    m: ArrayLike,
    radius_mm: float,
    *,
    force_sd_n: ArrayLike,
    torque_sd_nmm: ArrayLike,
    radius_sd_mm: float = 0.0,
) -> Floats:
    """Standard deviation of the contact along the circumference, mm (eq. 3.6 corrected).

    Errors of fx, fy, m and r are taken as independent; fx and fy have the same one.
    """
    d = angle_derivatives(fx, fy, m, radius_mm)
    force_sd, torque_sd = np.asarray(force_sd_n), np.asarray(torque_sd_nmm)
    variance = (
        (d.fx**2 + d.fy**2) * force_sd**2 + (d.m * torque_sd) ** 2 + (d.r * radius_sd_mm) ** 2
    )
    deviation: Floats = radius_mm * np.sqrt(variance)
    return deviation


@dataclass(frozen=True, slots=True)
class FusionCalibration:
    """Corrections of the two places, each linear in (1, shear ratio, place / radius).

    Attributes:
        array, force: float64[3], what to take off each place, mm.
        force_sd_mm: what is left of the force sensor's, against the array.
    """

    array: Floats
    force: Floats
    force_sd_mm: float


def shear_ratio(load: ArrayLike, place_mm: ArrayLike, radius_mm: float) -> Floats:
    """Tangential over normal force at a place, float64[n], within -1..1."""
    fx, fy, _ = np.moveaxis(np.asarray(load, np.float64), -1, 0)
    angle = np.asarray(place_mm, np.float64) / radius_mm
    normal = fx * np.cos(angle) + fy * np.sin(angle)
    tangential = -fx * np.sin(angle) + fy * np.cos(angle)
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio: Floats = np.clip(np.where(normal > 0.0, tangential / normal, 0.0), -1.0, 1.0)
    return ratio


def _traits(ratio: Floats, place_mm: ArrayLike, radius_mm: float) -> Floats:
    turn = np.asarray(place_mm, np.float64) / radius_mm
    return np.stack([np.ones_like(turn), ratio, turn], axis=-1)


def _fit(traits: Floats, error_mm: Floats) -> Floats:
    solution = np.linalg.lstsq(traits, error_mm, rcond=None)[0]
    return solution.astype(np.float64)


def calibrate_fusion(
    place_mm: ArrayLike, load: ArrayLike, response: ArrayLike, around_mm: Floats, radius_mm: float
) -> FusionCalibration:
    """Learn both corrections from presses at about known places.

    The array is corrected to the places meant; errors of the hand average out over the
    presses. The force sensor is corrected to the array, press by press: there the
    hand's errors are no matter, as both sensors felt the same press.

    Args:
        place_mm: [k], places meant.
        load: [k, 3], fx, fy, m as the calibrated force sensor measures them.
        response: [k, rows, columns], of the array.
        around_mm: places of the columns.
        radius_mm: of the fingertip.

    Raises:
        CalibrationError: fewer than 12 presses in which both sensors answer.
    """
    loads = np.asarray(load, np.float64)
    by_array = smooth_peak(response, around_mm)
    by_force = radius_mm * contact_angle(loads[:, 0], loads[:, 1], loads[:, 2], radius_mm)
    good = np.isfinite(by_array) & np.isfinite(by_force)
    if good.sum() < 12:
        raise CalibrationError(
            f"fingertip fusion: {int(good.sum())} presses felt by both sensors; wanted at least 12"
        )
    meant, loads = np.asarray(place_mm, np.float64)[good], loads[good]
    by_array, by_force = by_array[good], by_force[good]
    ratio = shear_ratio(loads, by_array, radius_mm)
    traits = _traits(ratio, by_array, radius_mm)
    array = _fit(traits, by_array - meant)
    corrected = by_array - traits @ array
    force_traits = _traits(ratio, by_force, radius_mm)
    force = _fit(force_traits, by_force - corrected)
    left = by_force - force_traits @ force - corrected
    spread = float(np.std(left))
    return FusionCalibration(array, force, spread)


class FingertipFusion:
    """One contact estimate from both sensors, sample by sample.

    Args:
        calibration: of the corrections.
        radius_mm: of the fingertip.
        force_sd_n, torque_sd_nmm: noise of the force sensor.
        mass_kg: between force sensor and contact; its inertia is unknown force.
        minimum_force_n: below it the force sensor is not asked (Son et al., section 4.4).
        speed_change_mm_s2: how fast a rolling contact changes its speed.
    """

    def __init__(
        self,
        calibration: FusionCalibration,
        radius_mm: float,
        *,
        force_sd_n: float,
        torque_sd_nmm: float,
        mass_kg: float = 0.0,
        minimum_force_n: float = 0.5,
        speed_change_mm_s2: float = 25.0,
    ) -> None:
        self._calibration = calibration
        self._radius_mm = radius_mm
        self._force_sd_n = force_sd_n
        self._torque_sd_nmm = torque_sd_nmm
        self._mass_kg = mass_kg
        self._minimum_force_n = minimum_force_n
        self._speed_change = speed_change_mm_s2
        self._state = np.zeros(3)
        self._covariance = np.zeros((3, 3))
        self._known = False

    def reset(self) -> None:
        """Forget the contact; the next reading of the array starts a new one."""
        self._known = False

    @property
    def sigma_mm(self) -> float:
        """Standard error of the place; infinite without a contact."""
        return float(np.sqrt(self._covariance[0, 0])) if self._known else float("inf")

    def step(
        self,
        dt_s: float,
        load: ArrayLike,
        array_place_mm: float | None = None,
        acceleration_m_s2: float = 0.0,
    ) -> float:
        """Place of the contact, mm; NaN before the array has shown one.

        Args:
            dt_s: since the last step.
            load: fx, fy (N), m (N mm) of the force sensor.
            array_place_mm: of `array.smooth_peak`, when there is a new reading.
            acceleration_m_s2: how large unknown accelerations of the fingertip may be.
        """
        loads = np.asarray(load, np.float64)
        if self._known:
            self._predict(dt_s)
        if array_place_mm is not None and np.isfinite(array_place_mm):
            ratio = shear_ratio(loads, array_place_mm, self._radius_mm)
            traits = _traits(ratio, array_place_mm, self._radius_mm)
            place = float(array_place_mm - traits @ self._calibration.array)
            if not self._known:
                self._begin(place)
            else:
                self._correct(place, np.array([1.0, 0.0, 0.0]), ARRAY_SD_MM)
        if self._known:
            self._use_force(loads, acceleration_m_s2)
            return float(self._state[0])
        return float("nan")

    def _begin(self, place_mm: float) -> None:
        self._state = np.array([place_mm, 0.0, 0.0])
        self._covariance = np.diag([ARRAY_SD_MM**2, 100.0, self._calibration.force_sd_mm**2])
        self._known = True

    def _predict(self, dt_s: float) -> None:
        step = np.array([[1.0, dt_s, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
        self._state = step @ self._state
        self._covariance = step @ self._covariance @ step.T
        # A rolling contact turns round within about a tenth of a second.
        push = self._speed_change**2 * 0.1 * dt_s
        self._covariance[1, 1] += push
        self._covariance[2, 2] += 0.1**2 * dt_s

    def _use_force(self, loads: Floats, acceleration_m_s2: float) -> None:
        fx, fy, m = loads
        if np.hypot(fx, fy) < self._minimum_force_n:
            return
        place = float(self._radius_mm * contact_angle(fx, fy, m, self._radius_mm))
        if not np.isfinite(place):
            return
        unknown_n = np.hypot(self._force_sd_n, self._mass_kg * acceleration_m_s2)
        deviation = float(
            position_sd_mm(
                fx,
                fy,
                m,
                self._radius_mm,
                force_sd_n=unknown_n,
                torque_sd_nmm=self._torque_sd_nmm,
            )
        )
        ratio = shear_ratio(loads, place, self._radius_mm)
        traits = _traits(ratio, place, self._radius_mm)
        self._correct(
            place - float(traits @ self._calibration.force),
            np.array([1.0, 0.0, 1.0]),
            deviation * np.sqrt(ALIKE_SAMPLES),
        )

    def _correct(self, place_mm: float, sees: Floats, deviation_mm: float) -> None:
        surprise = place_mm - float(sees @ self._state)
        variance = float(sees @ self._covariance @ sees) + deviation_mm**2
        # Accelerations come in bursts: what lies beyond 3 deviations counts for less.
        excess = surprise**2 / (9.0 * variance)
        if excess > 1.0:
            variance += (excess - 1.0) * variance
        gain = self._covariance @ sees / variance
        self._state = self._state + gain * surprise
        self._covariance = self._covariance - np.outer(gain, sees @ self._covariance)


@dataclass(frozen=True, slots=True)
class ManipulationTask:
    """One task over time. Rows are servo samples.

    Attributes:
        name: one of `TASKS`.
        place_mm: float64[n], true contact along the circumference.
        normal_n, tangential_n: float64[n], the contact's force in Son's sign.
        acceleration_m_s2: float64[n, 2], of the fingertip.
        patch: of the contact.
    """

    name: str
    place_mm: Floats
    normal_n: Floats
    tangential_n: Floats
    acceleration_m_s2: Floats
    patch: LoadPatch


def make_task(name: str, rng: np.random.Generator, seconds: float = 8.0) -> ManipulationTask:
    """Make one of `TASKS`.

    Raises:
        KeyError: no such task.
    """
    if name not in TASKS:
        raise KeyError(name)
    n = int(seconds * RATE_HZ)
    t = np.arange(n) / RATE_HZ
    set_up = rng.uniform(-SET_UP_MM, SET_UP_MM)
    shake = 0.3 * _unrest(rng, n, 2, 0.01)
    grasp = GRASP_N + 0.15 * _unrest(rng, n, 1, 0.1)[:, 0]
    lift = 0.05 * _unrest(rng, n, 1, 0.1)[:, 0]
    if "translation" in name:
        velocity = _square_path(t)
        acceleration = _smooth(np.gradient(velocity, 1 / RATE_HZ, axis=0), 0.02) + shake
        mass_kg = 0.0042 if name.startswith("pin") else 0.077
        # Half of the object's inertia on each of the two fingers.
        normal = grasp + 0.5 * mass_kg * acceleration[:, 0]
        tangential = lift + 0.5 * mass_kg * acceleration[:, 1]
        place = np.full(n, set_up)
        if name == "pin translation off centre":
            place -= 3.0
            tangential = tangential + 0.19 * normal
        if name == "box translation":
            # Fingers roll on the box while they go up and down (a trapezoid in time).
            place = 1.5 * np.cumsum(velocity[:, 1]) / RATE_HZ / 0.01 - 1.5 + set_up
        patch = pin_patch() if name.startswith("pin") else box_patch(skew=0.2)
        return ManipulationTask(name, place, normal, tangential, acceleration, patch)
    turn = np.deg2rad(20.0) * _triangle(t / 4.0)
    # The fingertip swings on an arm of half the object.
    swing = np.gradient(np.gradient(0.05 * turn, 1 / RATE_HZ), 1 / RATE_HZ)
    acceleration = np.stack([np.zeros(n), _smooth(swing, 0.01)], axis=1) + shake
    if name.startswith("pin"):
        place = np.full(n, set_up - 3.0 * name.endswith("off centre"))
        lean = turn - place / RADIUS_MM
        return ManipulationTask(
            name,
            place,
            grasp * np.cos(lean),
            grasp * np.sin(lean) + lift,
            acceleration,
            pin_patch(),
        )
    # A face that turns rolls over the fingertip; there is no shear but the object's weight.
    return ManipulationTask(
        name, RADIUS_MM * 0.9 * turn + set_up, grasp, lift, acceleration, box_patch(skew=0.2)
    )


def _square_path(t: Floats) -> Floats:
    """Velocity along a square of 2 cm at 4 cm/s, m/s, float64[n, 2]."""
    side = np.floor(t / 0.5).astype(int) % 4
    directions = np.array([[0.0, 1.0], [1.0, 0.0], [0.0, -1.0], [-1.0, 0.0]])
    velocity: Floats = 0.04 * directions[side]
    return velocity


def _triangle(phase: Floats) -> Floats:
    """A triangular wave of height 1 and period 1 that starts at 0."""
    wave: Floats = 4.0 * np.abs((phase + 0.75) % 1.0 - 0.5) - 1.0
    return wave


def _smooth(values: Floats, seconds: float) -> Floats:
    """Gaussian mean over about `seconds`, down the columns of [n] or [n, k]."""
    half = int(np.ceil(3.0 * seconds * RATE_HZ))
    kernel = np.exp(-0.5 * (np.arange(-half, half + 1) / (seconds * RATE_HZ)) ** 2)
    kernel /= kernel.sum()
    columns = np.pad(values.reshape(len(values), -1), ((half, half), (0, 0)), mode="edge")
    smooth = [np.convolve(column, kernel, mode="valid") for column in columns.T]
    return np.stack(smooth, axis=1).reshape(values.shape)


def _unrest(rng: np.random.Generator, n: int, channels: int, seconds: float) -> Floats:
    """Noise of standard deviation 1 that changes within about `seconds`, [n, channels]."""
    noise = _smooth(rng.normal(size=(n, channels)), seconds)
    unrest: Floats = noise / noise.std(axis=0)
    return unrest


class TrialFingertip:
    """One emulated fingertip of Son et al., calibrated by presses with a pointed indenter.

    Args:
        seed: of the fingertip's traits and noise.
        presses: of the calibration.
        place_sd_mm: how well each press hits its place.
    """

    def __init__(self, seed: int, presses: int = 200, place_sd_mm: float = 0.2) -> None:
        rng = np.random.default_rng(seed)
        layout = strip_array()
        self.around_mm = layout.around_mm
        self.array = StripArray(layout.around_mm, layout.along_mm, rng)
        self.gauges = PlanarGauges(rng, mass_kg=MASS_KG, noise_v=NOISE_V)
        meant, signals, true = self.gauges.calibration_presses(
            presses, RADIUS_MM, place_sd_mm=place_sd_mm
        )
        self.force = calibrate(signals, meant)
        response = self.array.read(true[:, 0], true[:, 1], -true[:, 2], pin_patch())
        place = RADIUS_MM * contact_angle(meant[:, 0], meant[:, 1], meant[:, 2], RADIUS_MM)
        self.calibration = calibrate_fusion(
            place[1:], self.force.loads(signals)[1:], response[1:], self.around_mm, RADIUS_MM
        )
        noise = NOISE_V * np.linalg.norm(self.force.matrix, axis=1)
        self.fusion = FingertipFusion(
            self.calibration,
            RADIUS_MM,
            force_sd_n=float(noise[:2].max()),
            torque_sd_nmm=float(noise[2]),
            mass_kg=MASS_KG,
        )

    def places(self, task: ManipulationTask) -> dict[str, Floats]:
        """Where each method puts the contact, mm, at the 300 Hz of the servo.

        The array's methods hold their last place between two readings.
        """
        load = planar_load(task.place_mm, task.normal_n, task.tangential_n, RADIUS_MM)
        loads = self.force.loads(self.gauges.read(load, task.acceleration_m_s2))
        seen = slice(None, None, ARRAY_EVERY)
        response = self.array.read(
            task.place_mm[seen], task.normal_n[seen], -task.tangential_n[seen], task.patch
        )
        by_array = smooth_peak(response, self.around_mm)
        by_force = RADIUS_MM * contact_angle(loads[:, 0], loads[:, 1], loads[:, 2], RADIUS_MM)
        low_pass = Butterworth2(10.0, RATE_HZ)
        self.fusion.reset()
        fused = [
            self.fusion.step(
                1 / RATE_HZ, load, by_array[i // ARRAY_EVERY] if i % ARRAY_EVERY == 0 else None, 1.0
            )
            for i, load in enumerate(loads)
        ]

        def held(places: Floats) -> Floats:
            return np.repeat(places, ARRAY_EVERY)[: len(loads)]

        return {
            "centroid": held(centroid(response, self.around_mm)),
            "half maximum": held(centroid(response, self.around_mm, share=0.5)),
            "peak": held(peak(response, self.around_mm)),
            "force": by_force,
            "force, 10 Hz": np.array([low_pass.step(place)[0] for place in by_force]),
            "smooth peak": held(by_array),
            "fused": np.array(fused),
        }


def task_errors(
    fingertips: int, seconds: float, presses: int = 200, place_sd_mm: float = 0.2
) -> dict[str, dict[str, Floats]]:
    """Errors in mm of every method in every task, over several fingertips and set-ups.

    The first half second, in which filters settle, is left out. The fingertips are others
    than those on which the constants of the fusion were chosen.
    """
    found: dict[str, dict[str, list[Floats]]] = {
        name: {method: [] for method in METHODS} for name in TASKS
    }
    settled = int(0.5 * RATE_HZ)
    for seed in range(50, 50 + fingertips):
        fingertip = TrialFingertip(seed, presses, place_sd_mm)
        for name in TASKS:
            task = make_task(name, np.random.default_rng(1000 + seed), seconds)
            for method, places in fingertip.places(task).items():
                found[name][method].append((places - task.place_mm)[settled:])
    return {
        name: {method: np.concatenate(parts) for method, parts in methods.items()}
        for name, methods in found.items()
    }


def rms(values: Floats) -> float:
    """Root of the mean square, numbers only."""
    return float(np.sqrt(np.nanmean(np.square(values))))
