"""Separates and locates contacts with the method that is configured for their part."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from skin_host.config.settings import Settings
from skin_host.layout import Layout, PadKind
from skin_host.processing.events import Vector
from skin_host.processing.frame import PressureFrame
from skin_host.processing.localization import Localizer, make_localizer, separate
from skin_host.processing.masks import Mask
from skin_host.processing.pressure import PressureCurve

Floats = NDArray[np.float64]


class Places:
    """Separates and locates the contacts of one part with its configured method.

    Pressures are converted back into activations of one standard pad, the part's median: pads of
    other sizes, shifts and strengths then read alike where they are covered alike.
    """

    def __init__(
        self, layout: Layout, part_index: int, settings: Settings, pitch_m: Floats
    ) -> None:
        part = layout.parts[part_index]
        chosen = settings.parts[part.name]
        mine = slice(part.start, part.stop)
        self._localizer: Localizer = make_localizer(
            chosen.localization,
            layout.position_m[mine],
            layout.normal[mine],
            layout.radius_mm[mine],
            probe_mm=chosen.probe_mm,
            pitch_m=pitch_m,
        )
        pads = layout.pad_kind[mine] == PadKind.PRESSURE
        unit_ff = (layout.unit_ff[mine] / layout.sensitivity[mine])[pads]
        pressure = settings.processing.pressure
        self._curve = PressureCurve(
            np.median(unit_ff) if len(unit_ff) else 1.0,
            a=pressure.a_kpa_per_ff2,
            b=pressure.b_kpa_per_ff,
        )
        self._units: Floats = np.zeros(part.n_taxels)
        self._believed: Mask = np.zeros(part.n_taxels, np.bool_)
        self._free: Mask = np.zeros(part.n_taxels, np.bool_)

    def look(
        self,
        frame: PressureFrame,
        patches: list[frozenset[int]],
        reached: list[set[int]],
        neighbours: Sequence[Sequence[int]],
    ) -> list[frozenset[int]]:
        """Take in a frame and its patches; return its contacts.

        Args:
            frame: of the part.
            patches: of touched taxels, each a contact or several.
            reached: each patch with the untouched taxels that connect it, as it lands or lifts.
            neighbours: for each taxel of the part its neighbours.
        """
        self._units = self._curve.units(frame.pressure_kpa)
        self._free = frame.valid.copy()
        contacts = []
        for patch, whole in zip(patches, reached, strict=True):
            self._free[list(patch)] = False
            hills = separate(sorted(whole), self._units, neighbours)
            contacts += [own for hill in hills if (own := patch.intersection(hill))]
        self._believed = frame.valid
        return contacts

    def locate(self, taxels: list[int]) -> tuple[Vector | None, float | None]:
        """Position in the part's frame and its standard error, m, of one of the contacts."""
        index = np.array(taxels, np.intp)
        usable = self._free.copy()
        usable[index] = self._believed[index]
        location = self._localizer.locate(index, self._units, usable)
        if location is None:
            return None, None
        x, y, z = location.position_m.tolist()
        return (x, y, z), location.sigma_m
