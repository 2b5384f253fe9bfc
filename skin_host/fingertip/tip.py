"""One fingertip on a force/torque board: takes samples, returns contacts, slips and excess. Pure.

Force and torque give one contact (Bicchi and Dario; Son et al.), and the flags of Ohka et al.
Where skin covers the fingertip, its contact is joined with this one, each weighted by its
precision along the surface. Times are those of the frames, ns.
"""

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

import numpy as np
from msgspec.structs import replace
from numpy.typing import NDArray

from skin_host.bus.strain import Wrench, silent_ns
from skin_host.config.fingertips import Fingertip
from skin_host.fingertip.events import Cause, FingertipEvent, Over, Slip
from skin_host.fingertip.grasp import FingerFlags, Flags, GraspThresholds
from skin_host.fingertip.intrinsic import (
    ContactVerdict,
    IntrinsicContact,
    Surface,
    cross_matrices,
    locate,
    point_covariance,
)
from skin_host.fingertip.low_pass import Butterworth2
from skin_host.fingertip.reach import reach_n
from skin_host.fingertip.slip import SlipWatch, size
from skin_host.processing.calibration import Zero
from skin_host.processing.contacts import ALIVE_NS, LOST_NS, MOVED_M, PRESSED_SHARE
from skin_host.processing.events import (
    N_DECIMALS,
    NM_DECIMALS,
    Load,
    Reason,
    Touch,
    Vector,
    rounded,
)

Floats = NDArray[np.float64]

#: A contact ends at this share of the force at which it begins.
RELEASE = 0.7
#: Slips are not detected while the force of a new contact builds up.
SETTLING_NS = 100_000_000
#: Contacts lighter than this multiple of the force noise are ignored, whatever is configured.
LEAST_NOISES = 6.0
#: A twist about the force (mm) larger than this, and larger than this multiple of its noise, means
#: several contacts.
PITCH_LIMIT_MM = 1.0
PITCH_NOISES = 4.0
#: A contact of the skin is joined while it is at most this many of the skin's periods old.
FRESH_PERIODS = 2.5
#: Relative error of a calibrated sensor (the multi-axial study: +-1 %).
RELATIVE_ERROR = 0.01
#: Distance of a real fingertip's surface from its geometrical form.
SURFACE_SD_MM = 0.05


@dataclass(frozen=True, slots=True)
class ContactPlace:
    """Where a contact is: point and outward normal, float64[3], mm; radial standard error, mm."""

    point_mm: Floats
    normal: Floats
    sigma_mm: float


def locate_with_skin(
    load: Floats,
    contact: IntrinsicContact,
    surface: Surface,
    noise: Floats,
    felt: Touch | None,
) -> ContactPlace:
    """Return the place of the contact of one sample.

    Args:
        load: float64[6], force (N) and torque (N mm) on the fingertip.
        contact: result of `intrinsic.locate` for it.
        surface: of the fingertip.
        noise: float64[6, 6], covariance of the load.
        felt: the present contact of the skin, in the same frame, if there is one.
    """
    force, torque = load[:3], load[3:]
    sizes = np.repeat([np.linalg.norm(force), np.linalg.norm(torque)], 3)
    covariance = point_covariance(
        force,
        torque,
        contact,
        noise + np.diag((RELATIVE_ERROR * sizes) ** 2),
        surface_sd_mm=SURFACE_SD_MM,
    )[0]
    point, normal = contact.point_mm[0], contact.normal[0]
    if felt is not None and felt.centroid_m is not None and felt.sigma_m is not None:
        along = np.eye(3) - np.outer(normal, normal)
        covariance = along @ covariance @ along
        # A radial standard error covers two directions.
        of_skin = along * (1e3 * felt.sigma_m) ** 2 / 2.0
        gain = covariance @ np.linalg.pinv(covariance + of_skin, hermitian=True)
        joined = point + gain @ along @ (1e3 * np.array(felt.centroid_m) - point)
        # Move the point back to the surface, which bends away below the tangent plane.
        distance, found = surface.enter((joined + normal)[None], -normal[None])
        if found[0]:
            point = joined + (1.0 - distance[0]) * normal
            normal = surface.normal(point[None])[0]
            covariance = covariance - gain @ covariance
    return ContactPlace(point, normal, math.sqrt(max(float(np.trace(covariance)), 0.0)))


Change = Literal["begin", "end"]
Told = Literal["contact", "no_single_contact", "several_contacts", "saturated"]
_VERDICTS: dict[int, Told] = {
    ContactVerdict.CONTACT: "contact",
    ContactVerdict.NO_SINGLE_CONTACT: "no_single_contact",
    ContactVerdict.SEVERAL_CONTACTS: "several_contacts",
}


class Tip:
    """Contact sensing of one fingertip.

    At most `move_hz` events `move` are sent; `array_period_ns` is that of the skin on it.

    Attributes:
        threshold_n: least force of a contact; noise may raise the configured one.
        reach_n: the greatest force that is measured in every direction, beside the load of the
            zero; infinite while the full scales of the board are not known.
        samples: how many have been taken in since the zero was known.
        silent_ns: a pause longer than this is one of its board, not of single samples.
        lost_ns: a contact ends after a pause of this length.
    """

    def __init__(
        self, name: str, settings: Fingertip, move_hz: float, array_period_ns: int = 0
    ) -> None:
        self.samples = 0
        self.threshold_n = settings.threshold_n
        self.reach_n = math.inf
        self.silent_ns = silent_ns(settings.period_ms)
        self.lost_ns = max(LOST_NS, self.silent_ns)
        self._name = name
        self._settings = settings
        self._surface = settings.surface
        # Of the board's values (N, N m): force (N) and torque (N mm) on the fingertip.
        self._to_load = settings.to_wrench
        self._to_load[3:] *= 1e3
        self._to_load[3:] += cross_matrices(np.array([settings.sensor_mm]))[0] @ self._to_load[:3]
        self._rate_hz = 1000.0 / settings.period_ms
        self.move_hz = move_hz
        self._fresh_ns = int(FRESH_PERIODS * array_period_ns)
        self._skin: dict[int, Touch] = {}
        self._skin_ns = 0
        self._zero: Zero | None = None
        self._full_scale: Floats | None = None
        #: Samples arrive, and the zero is known.
        self._arrives = False
        self._next_id = 1
        self._reported: Touch | None = None
        self._begun_ns = 0
        self._located_ns = 0
        self._contact: IntrinsicContact | None = None
        self._last_ns = 0
        self._cause: Cause = "rate"
        self._ids: dict[Flags, int] = {}
        self._noise_n = 0.0
        self._covariance = np.zeros((6, 6))
        self._forget()

    @property
    def flags(self) -> Flags:
        """The present flags of the finger, see `grasp.Flags`."""
        return self._finger.flags

    @property
    def flag_names(self) -> list[str]:
        return [str(flag.name).lower() for flag in self.flags]

    @property
    def zeroed(self) -> bool:
        """Whether the load of the unloaded board is known; before that there is no output."""
        return self._zero is not None

    @property
    def zeroed_touched(self) -> bool:
        """Whether something touched the fingertip when its zero was taken."""
        return self._zero is not None and self._zero.touched

    @property
    def touched(self) -> bool:
        """Whether something touches the fingertip."""
        return self._reported is not None

    @property
    def lasts(self) -> bool:
        """Whether something has begun and not ended: a slip may outlast its contact a little."""
        return self.touched or bool(self.flags & (Flags.SLIP | Flags.OVER))

    @property
    def unreached(self) -> bool:
        """Whether there are directions in which no load within the board's range is a touch."""
        return self.threshold_n > self.reach_n

    @property
    def feels(self) -> bool:
        """Whether it would be touched if something pressed on it."""
        return self._arrives and not self.unreached

    def set_range(self, full_scale: Floats) -> None:
        """Take the full scales of the board, float64[6]."""
        self._full_scale = full_scale
        self._find_reach()

    def _find_reach(self) -> None:
        if self._full_scale is not None:
            offset = None if self._zero is None else self._zero.offset
            self.reach_n = reach_n(self._to_load[:3], self._full_scale, offset)

    def use(self, zero: Zero | None) -> None:
        """Use this zero from now on. All contacts must have been ended before."""
        self._zero = zero
        self.samples = 0
        self._arrives = False
        self.threshold_n = self._settings.threshold_n
        if zero is not None:
            per_channel = self._moved(np.eye(6))
            self._covariance = per_channel.T @ np.diag(zero.noise**2) @ per_channel
            self._noise_n = float(np.sqrt(np.trace(self._covariance[:3, :3]) / 3.0))
            self.threshold_n = max(self.threshold_n, LEAST_NOISES * self._noise_n)
        self._find_reach()
        self._forget()

    def note_skin(self, events: Iterable[Touch], t_ns: int) -> None:
        """Take in the contact events of a frame of the skin on the fingertip."""
        self._skin_ns = t_ns
        for event in events:
            if event.event == "end":
                self._skin.pop(event.id, None)
            else:
                self._skin[event.id] = event

    def step(self, wrench: Wrench) -> list[FingertipEvent]:
        """Take in a sample; return its events."""
        if self._zero is None:
            return []
        if not 0 <= wrench.t_ns - self._last_ns <= self.silent_ns and self.samples:
            # A sample after a pause, or after the clock was set back, does not continue the samples
            # before it.
            self._restart()
        self._last_ns = wrench.t_ns
        self.samples += 1
        self._arrives = True
        measured = np.concatenate([wrench.force_n, wrench.torque_nm]) - self._zero.offset
        load = self._moved(measured[None])[0]
        least_n = self.threshold_n * (1.0 if self._reported is None else RELEASE)
        touches = wrench.saturated or size(load[:3]) >= least_n
        if self._reported is None:
            if not touches and self.flags == Flags.SEARCH:
                return []
            if touches:
                self._restart()  # the samples before belong to no contact
        smooth = self._filter.step(load)
        if touches and size(smooth[:3]) < least_n:
            smooth = load
        # The place is computed only when it may be reported; slips are detected at every sample.
        locates = (
            self._reported is None or not 0 <= wrench.t_ns - self._located_ns < 1e9 / self.move_hz
        )
        if not touches or wrench.saturated:
            self._contact = None
        elif locates:
            self._contact = self._locate(smooth, least_n)
        events = self._grasp(load, self._contact, wrench.t_ns, touches=touches)
        if touches:
            if locates:
                self._located_ns = wrench.t_ns
                events += self._touch(smooth, wrench.t_ns)
        elif self._reported is not None:
            events += self._end(wrench.t_ns)
        return events

    def expire(self, t_ns: int, quiet_ns: int) -> list[FingertipEvent]:
        """End what has begun, if samples have stopped for too long: now, and for how long."""
        return [] if quiet_ns < self.lost_ns else self.lose(t_ns)

    def lose(self, t_ns: int) -> list[FingertipEvent]:
        """End what has begun, because samples have stopped or do not show it any more."""
        self._arrives = False
        return self.end_all(t_ns, "lost") if self.lasts else []

    def end_all(self, t_ns: int, reason: Reason = "stopped") -> list[FingertipEvent]:
        """End all that has begun, because the fingertip will not send for a while."""
        events: list[FingertipEvent] = []
        if self.flags & Flags.SLIP:
            number = self._ids[Flags.SLIP]
            events.append(self._slip("end", number, t_ns, 0.0, 0.0, 0.0))
        if self.flags & Flags.OVER:
            events.append(self._over("end", self._ids[Flags.OVER], t_ns, 0.0))
        if self._reported is not None:
            events += self._end(t_ns, reason)
        self._forget()
        return events

    def _forget(self) -> None:
        self._restart()
        self._finger = FingerFlags(
            GraspThresholds(
                touch_n=self.threshold_n,
                over_n=self._settings.over_n,
                slip_n_s=self._watch.threshold_n_s,
            )
        )

    def _restart(self) -> None:
        """Forget the earlier samples, but keep contact and flags."""
        self._filter = Butterworth2(self._settings.filter_hz, self._rate_hz, 6)
        self._watch = SlipWatch(self._settings, self._noise_n)

    def _moved(self, measured: Floats) -> Floats:
        """Convert rows of the board's values (N, N m) to force (N) and torque (N mm) on the
        fingertip.
        """
        load: Floats = measured @ self._to_load.T
        return load

    def _locate(self, load: Floats, least_n: float) -> IntrinsicContact:
        noise_nmm = math.sqrt(float(np.trace(self._covariance[3:, 3:])) / 3.0)
        force_n = max(size(load[:3]), least_n)
        return locate(
            load[:3],
            load[3:],
            self._surface,
            minimum_force_n=least_n,
            pitch_limit_mm=PITCH_LIMIT_MM + PITCH_NOISES * noise_nmm / force_n,
        )

    def _felt(self) -> list[Touch]:
        """Return the contacts of the skin, if it still sends."""
        fresh = abs(self._last_ns - self._skin_ns) <= self._fresh_ns
        return list(self._skin.values()) if fresh else []

    def _grasp(
        self, load: Floats, contact: IntrinsicContact | None, t_ns: int, *, touches: bool
    ) -> list[FingertipEvent]:
        """Update the flags from a sample that is not smoothed."""
        settled = self._reported is not None and not (0 <= t_ns - self._begun_ns <= SETTLING_NS)
        located = contact is not None and int(contact.verdict[0]) == ContactVerdict.CONTACT
        normal = contact.normal[0] if contact is not None and located else None
        seen = self._watch.step(load, normal, t_ns, settled=settled)
        normal_n = seen.normal_n if touches else 0.0
        if seen.cause is not None and not self.flags & Flags.SLIP:
            self._cause = seen.cause
        changed = self._finger.step(
            np.array([normal_n]),
            np.array([seen.rate_n_s]),
            t_ns,
            slips=seen.cause is not None,
        )
        events: list[FingertipEvent] = []
        if not changed:
            return events  # nearly always
        for flag in changed & (Flags.SLIP | Flags.OVER):
            event: Change = "begin" if flag & self.flags else "end"
            if event == "begin":
                # The contact may begin with this same sample.
                self._ids[flag] = self._next_id if self._reported is None else self._reported.id
            number = self._ids[flag]
            if flag == Flags.OVER:
                events.append(self._over(event, number, t_ns, normal_n))
            else:
                events.append(
                    self._slip(event, number, t_ns, normal_n, seen.shear_n, seen.rate_n_s)
                )
        return events

    def _slip(
        self, event: Change, number: int, t_ns: int, force_n: float, shear_n: float, rate_n_s: float
    ) -> Slip:
        return Slip(
            event=event,
            id=number,
            t_ns=t_ns,
            part=self._name,
            cause=self._cause,
            force_n=force_n,
            shear_n=shear_n,
            shear_rate_n_s=rate_n_s,
        )

    def _over(self, event: Change, number: int, t_ns: int, force_n: float) -> Over:
        return Over(event=event, id=number, t_ns=t_ns, part=self._name, force_n=force_n)

    def _touch(self, load: Floats, t_ns: int) -> list[FingertipEvent]:
        before = self._reported
        touch = self._described(load, self._contact, t_ns)
        if before is None:
            self._next_id += 1
            self._begun_ns = t_ns
        elif not self._worth_reporting(before, touch):
            return []
        self._reported = touch
        return [touch]

    def _described(self, load: Floats, contact: IntrinsicContact | None, t_ns: int) -> Touch:
        """Return the contact as it is now; one without a location is saturated."""
        felt = self._felt()
        skin = felt[0] if len(felt) == 1 else None
        verdict: Told = "saturated"
        place = None
        if contact is not None:
            verdict = _VERDICTS.get(int(contact.verdict[0]), "no_single_contact")
            if verdict == "contact" and len(felt) > 1:
                verdict = "several_contacts"
            if verdict == "contact":
                place = locate_with_skin(load, contact, self._surface, self._covariance, skin)
        normal_n, shear = size(load[:3]), None
        if place is not None:
            normal_n = max(0.0, -float(load[:3] @ place.normal))
            shear = rounded((load[:3] + normal_n * place.normal).tolist(), N_DECIMALS)
        force_n = rounded(load[:3].tolist(), N_DECIMALS)
        torque_nm = rounded((1e-3 * load[3:]).tolist(), NM_DECIMALS)
        before = self._reported
        return Touch(
            event="begin" if before is None else "move",
            id=self._next_id if before is None else before.id,
            seq=self.samples,
            t_ns=t_ns,
            part=self._name,
            taxels=[] if skin is None else skin.taxels,
            centroid_m=None if place is None else _vector(1e-3 * place.point_mm),
            normal=None if place is None else _vector(place.normal),
            area_mm2=None if skin is None else skin.area_mm2,
            peak_kpa=None if skin is None else skin.peak_kpa,
            mean_kpa=None if skin is None else skin.mean_kpa,
            force_n=normal_n,
            sigma_m=None if place is None else 1e-3 * place.sigma_mm,
            partial=skin is not None and skin.partial,
            beyond=verdict == "saturated" or (skin is not None and skin.beyond),
            load=Load(verdict, force_n, torque_nm, shear, self.flag_names),
        )

    def _end(self, t_ns: int, reason: Reason = "released") -> list[FingertipEvent]:
        last, self._reported = self._reported, None
        assert last is not None and last.load is not None
        zero = (0.0, 0.0, 0.0)
        load = Load(last.load.verdict, zero, zero, zero, self.flag_names)
        return [replace(last.ended(self.samples, t_ns, reason), load=load)]

    def _worth_reporting(self, said: Touch, now: Touch) -> bool:
        assert said.load is not None and now.load is not None
        if not 0 <= now.t_ns - said.t_ns < ALIVE_NS:
            return True
        if (now.load.verdict, now.load.flags) != (said.load.verdict, said.load.flags):
            return True
        if (now.partial, now.beyond) != (said.partial, said.beyond):
            return True
        change_n = math.dist(now.load.force_n, said.load.force_n)
        if change_n > max(0.25 * self.threshold_n, PRESSED_SHARE * math.hypot(*said.load.force_n)):
            return True
        if now.centroid_m is None or said.centroid_m is None:
            return now.centroid_m is not said.centroid_m
        moved_m = math.dist(now.centroid_m, said.centroid_m)
        return moved_m > max(MOVED_M, now.sigma_m or 0.0)


def _vector(values: Floats) -> Vector:
    x, y, z = values.tolist()
    return x, y, z
