"""A MuJoCo simulation whose contacts press the emulated skin.

A site of the model that has the name of a part of the configuration gives the frame of that part:
its origin and axes are those of the taxels' places. Geometries whose names begin with the part's
name are its surface; without such names, all geometries of the site's body are. `docs/mujoco.md`
explains a model for users.

MuJoCo computes contacts between rigid bodies; their forces are read from `efc_force`, as the
simulation's own constraint solver left them. The foam yields to the forces, but the bodies do
not feel it: its depth does not come back into the simulation.
"""

import logging
from bisect import bisect_right
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from emulator.probes.contacts import MOST_RADIUS_MM, Contacts
from emulator.probes.foam import E0_KPA
from skin_host.errors import ConfigurationError, RequestError, SkinError, required
from skin_host.layout import Layout

#: The mechanics takes up contacts this often; the simulation's steps cannot be longer.
LONGEST_STEP_S = 0.005
#: Weaker contacts are not passed on.
LEAST_N = 1e-4
#: Radius of a contact with an edge, a face or a mesh, of which MuJoCo gives some points.
POINT_RADIUS_MM = 3.0
LEAST_RADIUS_MM = 0.5
#: Name of the numeric field of a model after whose seconds the keyframes begin again.
REPEAT = "repeat_s"

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]

log = logging.getLogger(__name__)


def _line(text: str) -> str:
    return " ".join(text.split())


def _warn(text: str) -> None:
    log.warning("MuJoCo: %s", _line(text))


class MujocoModel:
    """A model that runs in the emulator's time, as a source of contacts.

    The model's keyframes are what its actuators do: the controls go in straight lines from one
    keyframe's `ctrl` to the next one's, by their `time`. A numeric field `repeat_s` lets them begin
    again.

    Args:
        path: of the model, MJCF or URDF as MuJoCo reads it.
        layout: of the skin.

    Raises:
        ConfigurationError: the file cannot be read, or has no part of the skin.
        SkinError: the package `mujoco` is not installed.
    """

    def __init__(self, path: Path, layout: Layout) -> None:
        self._mujoco = required("mujoco", "simulations of bodies", "mujoco")
        self._path = path
        if not path.is_file():  # MuJoCo would wait for a pipe
            raise ConfigurationError(f"{path}: is no file; wanted a model, MJCF or URDF")
        # Otherwise MuJoCo appends its warnings to a file in the user's working directory.
        warnings: list[str] = []
        self._mujoco.set_mju_user_warning(warnings.append)
        try:
            self.model = self._mujoco.MjModel.from_xml_path(str(path))
        except (ValueError, OSError) as error:
            reason = _line(" ".join([*warnings, str(error)]))
            raise ConfigurationError(f"{path}: MuJoCo cannot read it: {reason}") from None
        finally:
            self._mujoco.set_mju_user_warning(_warn)
        for text in warnings:
            _warn(text)
        if self.model.opt.timestep > LONGEST_STEP_S:
            raise ConfigurationError(
                f"{path}: option timestep {self.model.opt.timestep:g} s; "
                f"wanted at most {LONGEST_STEP_S:g} s"
            )
        self.data = self._mujoco.MjData(self.model)
        self._steps = 0
        self._layout = layout
        self._find_skin()
        self._radius_mm = self._roundness_mm()
        self._foam_mm = np.array([part.foam_mm for part in layout.parts])
        self._set_schedule()
        if self.model.nkey:
            self._mujoco.mj_resetDataKeyframe(self.model, self.data, 0)
            self.data.time = 0.0

    def __reduce__(self) -> str:
        raise RequestError("a robot under a MuJoCo model cannot be saved; leave out --state")

    def _find_skin(self) -> None:
        """The parts that the model has: their sites, and their geometries."""
        model = self.model
        sites = [model.site(number).name for number in range(model.nsite)]
        geoms = [model.geom(number).name for number in range(model.ngeom)]
        self._site = np.full(len(self._layout.parts), -1)
        #: The part whose surface a geometry is, else -1.
        self._part_of = np.full(model.ngeom, -1, np.intp)
        for number, part in enumerate(self._layout.parts):
            if part.name not in sites:
                continue
            self._site[number] = site = sites.index(part.name)
            named = np.array([name.startswith(part.name) for name in geoms])
            mine = named if named.any() else model.geom_bodyid == model.site_bodyid[site]
            if not mine.any():
                raise ConfigurationError(
                    f'{self._path}: site "{part.name}": its body has no geometry; '
                    f'give it one, or a geometry a name that begins with "{part.name}"'
                )
            self._part_of[mine] = number
        if (self._site < 0).all():
            names = ", ".join(part.name for part in self._layout.parts)
            seen = ", ".join(name for name in sites if name) or "none"
            raise ConfigurationError(
                f"{self._path}: its sites are {seen}; wanted one with the name of a part: {names}"
            )

    def _roundness_mm(self) -> Floats:
        """Radius of curvature of each geometry as it presses; NaN where MuJoCo gives points."""
        kinds = self._mujoco.mjtGeom
        size_mm = self.model.geom_size * 1e3
        kind = self.model.geom_type
        round_ = (kind == kinds.mjGEOM_SPHERE) | (kind == kinds.mjGEOM_CAPSULE)
        radius_mm = np.where(round_, size_mm[:, 0], np.nan)
        oval = kind == kinds.mjGEOM_ELLIPSOID
        return np.where(oval, size_mm.min(axis=1), radius_mm)

    def _set_schedule(self) -> None:
        model = self.model
        self._times_s = model.key_time.tolist()
        self._controls = model.key_ctrl.copy()
        if any(after < before for before, after in pairwise(self._times_s)):
            raise ConfigurationError(f"{self._path}: the keyframes' times run backwards")
        numerics = {model.numeric(i).name: model.numeric(i).data for i in range(model.nnumeric)}
        self._repeat_s = float(numerics[REPEAT][0]) if REPEAT in numerics else 0.0
        #: Controls that a program has taken over.
        self._held = np.full(model.nu, np.nan)

    # ------------------------------------------------------------------ time

    def at(self, t_ns: int) -> Contacts:
        """The contacts at a time of the emulator, as after the simulation's last whole step.

        Raises:
            SkinError: the simulation became unstable.
        """
        steps = round(t_ns * 1e-9 / self.model.opt.timestep - 0.5 + 1e-6)
        if steps > self._steps:
            self._control(t_ns * 1e-9)
            self._mujoco.mj_step(self.model, self.data, steps - self._steps)
            self._steps = steps
            if self._is_unstable():
                raise SkinError(
                    f"{self._path}: the simulation became unstable at {t_ns * 1e-9:.2f} s; "
                    "mend it with a smaller option timestep, or softer contacts"
                )
        return self._contacts()

    def _is_unstable(self) -> bool:
        kinds = self._mujoco.mjtWarning
        bad = (kinds.mjWARN_BADQPOS, kinds.mjWARN_BADQVEL, kinds.mjWARN_BADQACC)
        return any(self.data.warning[kind].number for kind in bad)

    def _control(self, t_s: float) -> None:
        if not self.model.nu:
            return
        if self._times_s:
            if self._repeat_s:
                t_s %= self._repeat_s
            high = min(bisect_right(self._times_s, t_s), len(self._times_s) - 1)
            low = max(high - 1, 0)
            length_s = self._times_s[high] - self._times_s[low]
            share = min(max((t_s - self._times_s[low]) / length_s, 0.0), 1.0) if length_s else 1.0
            self.data.ctrl[:] = (1 - share) * self._controls[low] + share * self._controls[high]
        held = ~np.isnan(self._held)
        self.data.ctrl[held] = self._held[held]

    def set_control(self, name: str, value: float) -> None:
        """Let an actuator's control stay at a value from now on, whatever the keyframes give.

        Raises:
            RequestError: there is no such actuator, or the simulation takes no such control.
        """
        names = [self.model.actuator(number).name for number in range(self.model.nu)]
        if name not in names:
            raise RequestError(f'"{name}": no such actuator; there are: {", ".join(names)}')
        most = self._mujoco.mjMAXVAL
        if not abs(value) <= most:
            raise RequestError(
                f"{name}: seen {value:g}, wanted a number from {-most:g} to {most:g}"
            )
        self._held[names.index(name)] = value

    # ------------------------------------------------------------------ contacts

    def _contacts(self) -> Contacts:
        """What the solver found at the last step, on the surfaces of the parts."""
        found = self.data.contact
        geom = found.geom
        if not len(geom):
            return Contacts.none()
        force_n = self._normal_n(found)
        parts = self._part_of[geom]
        #: A contact of two parts presses both: once for each side.
        rows, side = np.nonzero((parts >= 0) & (force_n > LEAST_N)[:, None])
        if not len(rows):
            return Contacts.none()
        part = parts[rows, side]
        site = self._site[part]
        turn = self.data.site_xmat[site].reshape(-1, 3, 3)
        place_m = np.einsum("ci,cij->cj", found.pos[rows] - self.data.site_xpos[site], turn)
        # A contact's normal points from its first geometry to its second.
        out = np.where(side == 0, 1.0, -1.0)[:, None] * found.frame[rows, :3]
        return Contacts(
            part,
            place_m * 1e3,
            np.einsum("ci,cij->cj", out, turn),
            force_n[rows],
            self._disc_mm(geom[rows, 1 - side], force_n[rows], self._foam_mm[part]),
        )

    def _normal_n(self, found: Any) -> Floats:
        """Normal force of each contact; 0 where the solver has none."""
        first = found.efc_address
        rows = np.ones(len(first), np.intp)
        if self.model.opt.cone == self._mujoco.mjtCone.mjCONE_PYRAMIDAL:
            # Edges of a pyramid, all of which push along the normal.
            rows = np.where(found.dim > 1, 2 * (found.dim - 1), 1)
        total = np.append(0.0, np.cumsum(self.data.efc_force))
        first = np.maximum(first, 0)
        stop = np.minimum(first + rows, len(total) - 1)
        force_n = total[stop] - total[first]
        return np.where(found.efc_address >= 0, force_n, 0.0)

    def _disc_mm(self, other: Ints, force_n: Floats, foam_mm: Floats) -> Floats:
        """Radius of the disc on which an object presses, float64[c].

        A sphere of radius R sinks into a Winkler layer of stiffness E0 / h by
        sqrt(F h / (pi R E0)) and touches it as far as sqrt(2 R depth).
        """
        round_mm = self._radius_mm[other]
        depth_mm = np.sqrt(force_n * foam_mm / (np.pi * round_mm * E0_KPA * 1e-3))
        disc_mm = np.minimum(np.sqrt(2 * round_mm * depth_mm), round_mm)
        disc_mm = np.where(np.isnan(round_mm), POINT_RADIUS_MM, disc_mm)
        return np.clip(disc_mm, LEAST_RADIUS_MM, MOST_RADIUS_MM)
