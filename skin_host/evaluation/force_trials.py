"""Force of a contact against the load of the emulator's probe, by its size and its place.

A press is a flat round probe on a mesh of triangles: foam and pads are the emulator's, drawn
for each size and place, and the truth is the load on the probe. Bytes with noise pass the pipeline
and the contact tracker that the daemon runs. All presses of a size and a kind of place are on one
part at the same time, each in a band of the mesh of its own.
"""

from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from emulator.probes.foam import Drive, Foam, FoamLayer
from emulator.probes.pads import UNIT_FF, Disc, Pads
from emulator.probes.viscoelastic import FoamTruth
from skin_host.evaluation.rig import Rig
from skin_host.layout import PadKind
from skin_host.processing.contacts import ContactTracker
from skin_host.processing.pipeline import Pipeline

Floats = NDArray[np.float64]
Row = dict[str, Any]

#: `triangle`: anywhere on a triangle among others. `seam`: the probe's middle is on the line
#: between two triangles. `inside the edge`: the probe touches the skin's edge from inside.
#: `half over the edge`: its middle is on that edge.
Where = Literal["triangle", "seam", "inside the edge", "half over the edge"]
PLACES: tuple[Where, ...] = get_args(Where)
KINDS = ("triangle", "triangle_10pad")
PROBES_MM = (4.0, 6.0, 10.0, 15.0, 20.0, 30.0)
#: Mean pressure under each probe.
LOAD_KPA = 40.0
NOISE_UNITS, FOAM_MM = 0.4, 2.0
HELD_S = 0.5
#: Two boards, four rows of eight triangles: the largest probe leaves two rows free between bands.
BOARDS_PER_BAND, TRIANGLES_PER_BAND, IN_A_ROW = 2, 32, 8


def force(
    kind: str,
    presses: int,
    probes_mm: tuple[float, ...] = PROBES_MM,
    places: tuple[Where, ...] = PLACES,
) -> list[Row]:
    """Reported over true force of presses on a kind of triangle, a row for each place and size.

    A press that comes to no contact counts as a force of 0; one that comes to several counts with
    their sum. `centroid_rms_mm` is None where no press comes to a contact.
    """
    rig = Rig(BOARDS_PER_BAND * presses, NOISE_UNITS, seed=31, kind=kind)
    mesh = _Mesh(rig)
    rng = np.random.default_rng(32)
    return [
        {"kind": kind, "where": where, "probe_mm": probe_mm, "presses": presses}
        | _pressed(mesh, mesh.draw(where, probe_mm, rng), probe_mm, rng)
        for where in places
        for probe_mm in probes_mm
    ]


class _Mesh:
    """The part as a flat mesh: bands [b] of triangles, each as large as a probe needs.

    Attributes:
        rig: with one part. Its skin is flat and faces z.
        pads: of the emulator.
        tracker: of the part's contacts.
    """

    def __init__(self, rig: Rig) -> None:
        layout = rig.layout
        self.rig = rig
        self.pads = Pads(layout.position_m[:, :2] * 1e3, layout.radius_mm, FOAM_MM)
        self.tracker = ContactTracker(layout, 0, rig.settings)
        outlines_mm = np.array([one.outline_m[:, :2] for one in layout.triangles]) * 1e3
        second_row = outlines_mm.reshape(-1, TRIANGLES_PER_BAND, 3, 2)[:, IN_A_ROW : 2 * IN_A_ROW]
        self._inner_mm = second_row[:, IN_A_ROW // 2]
        outer_mm = second_row[:, 0]
        # The part ends at the left of its first column.
        middle_mm = (outer_mm + np.roll(outer_mm, -1, axis=1)) / 2
        edge = middle_mm[:, :, 0].argmin(axis=1)
        band = np.arange(len(edge))
        self._edge_mm = np.stack([outer_mm[band, edge], outer_mm[band, (edge + 1) % 3]], axis=1)
        along_mm = self._edge_mm[:, 1] - self._edge_mm[:, 0]
        across = along_mm[:, ::-1] * [-1.0, 1.0]
        across /= np.linalg.norm(across, axis=1, keepdims=True)
        to_inside_mm = outer_mm.mean(axis=1) - self._edge_mm[:, 0]
        self._inwards = across * np.sign(np.sum(across * to_inside_mm, axis=1, keepdims=True))

    def draw(self, where: Where, probe_mm: float, rng: np.random.Generator) -> Floats:
        """A place [b, 2] (mm) in each band."""
        bands = len(self._inner_mm)
        if where == "triangle":
            low, high = np.sort(rng.uniform(size=(2, bands)), axis=0)
            weight = np.stack([low, high - low, 1.0 - high], axis=1)
            return np.asarray(np.einsum("bc,bcx->bx", weight, self._inner_mm))
        if where == "seam":
            band, side = np.arange(bands), rng.integers(3, size=bands)
            begin, end = self._inner_mm[band, side], self._inner_mm[band, (side + 1) % 3]
            return np.asarray(begin + rng.uniform(size=(bands, 1)) * (end - begin))
        # In the middle of the edge the largest probe stays clear of the mesh's corners.
        begin, end = self._edge_mm[:, 0], self._edge_mm[:, 1]
        place_mm = begin + rng.uniform(1 / 3, 2 / 3, size=(bands, 1)) * (end - begin)
        if where == "inside the edge":
            place_mm += self._inwards * probe_mm / 2
        return np.asarray(place_mm)


def _pressed(mesh: _Mesh, place_mm: Floats, probe_mm: float, rng: np.random.Generator) -> Row:
    """What presses at places [b, 2] come to, `HELD_S` after they began."""
    rig, layout = mesh.rig, mesh.rig.layout
    discs = [Disc(x, y, probe_mm) for x, y in place_mm.tolist()]
    footprint = mesh.pads.footprint(discs)
    drive = Drive.by_force(np.full(len(discs), LOAD_KPA * discs[0].area_mm2 * 1e-3))
    foam = FoamLayer(
        Foam.drawn(layout.n_taxels, rng, FOAM_MM), FoamTruth("S", layout.n_taxels, rng)
    )
    # Skin that was never pressed.
    rig.pipeline = Pipeline(layout, rig.settings.processing, rig.calibration)
    measures_pressure = layout.pad_kind == PadKind.PRESSURE
    for _ in range(round(HELD_S / rig.dt_s)):
        felt = foam.step(footprint, drive, rig.dt_s)
        rise_ff = np.where(measures_pressure, mesh.pads.rise_ff(felt, footprint), 0.0)
        frame = rig.step(rise_ff / UNIT_FF)
    force_n = np.zeros(len(discs))
    moment = np.zeros((len(discs), 2))
    mesh.tracker.end_all(frame.seq, frame.t_ns)
    for touch in mesh.tracker.step(frame):
        if touch.centroid_m is not None:
            found_mm = 1e3 * np.array(touch.centroid_m[:2])
            press = np.linalg.norm(place_mm - found_mm, axis=1).argmin()
            force_n[press] += touch.force_n
            moment[press] += touch.force_n * found_mm
    ratio = force_n / foam.force_n
    seen = force_n > 0.0
    off_mm = np.linalg.norm(moment[seen] / force_n[seen, None] - place_mm[seen], axis=1)
    return {
        "true_n": float(np.median(foam.force_n)),
        "median_ratio": float(np.median(ratio)),
        "mean_ratio": float(np.mean(ratio)),
        "p5_ratio": float(np.percentile(ratio, 5)),
        "p95_ratio": float(np.percentile(ratio, 95)),
        "unseen_share": float(np.mean(~seen)),
        "centroid_rms_mm": float(np.sqrt(np.mean(off_mm**2))) if seen.any() else None,
    }
