"""Contact state of a part, which fails safe. Pure: takes frames and events, returns the state."""

import math
from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from skin_host.layout import Layout, PadKind
from skin_host.mqtt.messages import ContactState
from skin_host.processing.contacts import LOST_NS
from skin_host.processing.conversions import CONVERSION_S
from skin_host.processing.events import Touch
from skin_host.processing.frame import PressureFrame
from skin_host.processing.masks import all_of, any_of

if TYPE_CHECKING:
    from skin_host.processing.core import Engine

#: Without a calibration, a place that was not valid counts as untouched after so many measurements.
SURE_MEASUREMENTS = 4


class PartContact:
    """The contact state of one part.

    ON: a taxel is touched. OFF: none is, and every triangle has a valid taxel, and all usable
    taxels that were touched when they were last valid, or whose contact was lost, are valid again,
    in each case for the measurements in which they decide whether something touches them. A frame
    is one measurement at most, and less where it comes sooner than a conversion. UNKNOWN: all other
    cases. A triangle may miss frames for `LOST_NS`, as a contact may; a part without any valid
    taxel is UNKNOWN at once.

    Args:
        layout: the skin.
        part: index of the part.
    """

    def __init__(self, layout: Layout, part: int) -> None:
        here = layout.parts[part]
        pads: list[NDArray[np.intp]] = []
        for triangle in layout.triangles:
            if triangle.part == part:
                row = layout.boards[triangle.board].taxel_index[triangle.number]
                taxels = row[row >= 0]
                taxels = taxels[layout.pad_kind[taxels] == PadKind.PRESSURE]
                if len(taxels):
                    pads.append((taxels - here.start).astype(np.intp))
        #: Pressure pads triangle by triangle, and where each triangle begins among them.
        self._pads = np.concatenate(pads)
        self._starts = np.cumsum([0, *(len(one) for one in pads[:-1])])
        #: When each triangle last felt, `PressureFrame.elapsed_ns`.
        self._felt_ns = np.zeros(len(pads), np.int64)
        #: Measurements in which each taxel, and the slowest of each triangle, decides. A
        #: temperature pad is never valid, so nothing is waited for there.
        self._decides = np.zeros(here.n_taxels)
        self._decides[self._pads] = SURE_MEASUREMENTS
        self._triangle_decides = np.full(len(pads), float(SURE_MEASUREMENTS))
        #: Measurements that are still wanted of the taxels where a contact was lost, and of each
        #: triangle.
        self._lost = np.zeros(here.n_taxels)
        self._unsure = self._triangle_decides.copy()
        #: `PressureFrame.elapsed_ns` of the last frame.
        self._elapsed_ns = -math.inf
        #: Whether any of these is wanted.
        self._is_unsure = True
        #: The valid taxels of the last frame, and the triangles that have any.
        self._valid: NDArray[np.bool_] | None = None
        self._feels = np.zeros(len(pads), np.bool_)
        self._all_feel = False
        self._present: set[int] = set()
        #: The touched taxels of the last frame.
        self._touched: NDArray[np.bool_] = np.zeros(here.n_taxels, np.bool_)

    def step(self, frame: PressureFrame, events: Iterable[Touch]) -> ContactState:
        """Take a frame and the events of its contacts; return the state."""
        passed_ns = frame.elapsed_ns - self._elapsed_ns
        self._elapsed_ns = frame.elapsed_ns
        for event in events:
            if event.event == "end":
                self._present.discard(event.id)
                if event.reason == "lost":
                    self._lost[event.taxels] = self._decides[event.taxels]
                    self._is_unsure = True
            else:
                self._present.add(event.id)
        if frame.valid is not self._valid:
            self._valid = frame.valid
            self._feels = np.logical_or.reduceat(frame.valid[self._pads], self._starts)
            self._all_feel = all_of(self._feels)
            if any_of(gone := self._touched & ~frame.valid):
                # Whatever becomes of its contact, nobody has seen it released.
                self.doubt(gone)
        self._touched = frame.touched
        if self._all_feel and not self._is_unsure:
            self._felt_ns.fill(frame.elapsed_ns)
            return "ON" if self._present or any_of(frame.touched) else "OFF"
        feels = self._feels
        self._felt_ns[feels] = frame.elapsed_ns
        unfelt = frame.elapsed_ns - self._felt_ns >= LOST_NS
        np.copyto(self._unsure, self._triangle_decides, where=unfelt)
        measurements = min(max(passed_ns * 1e-9 / CONVERSION_S, 0.0), 1.0)
        self._unsure -= measurements * feels
        self._lost -= measurements * frame.valid
        for wanted in (self._unsure, self._lost):
            np.maximum(wanted, 0.0, out=wanted)
        self._is_unsure = any_of(self._unsure > 0) or any_of(self._lost > 0)
        if any_of(frame.touched):
            return "ON"
        if not any_of(feels):
            return "UNKNOWN"
        if self._present:  # frames of the touched place were lost, for less than `LOST_NS`
            return "ON"
        return "UNKNOWN" if self._is_unsure else "OFF"

    def doubt(self, taxels: NDArray[np.bool_]) -> None:
        """Something may touch these taxels [m], as it did when they were last valid, when an
        earlier daemon ended, or while the part was disabled.
        """
        np.copyto(self._lost, self._decides, where=taxels)
        self._is_unsure = True

    def stop_waiting(self, taxels: NDArray[np.bool_]) -> None:
        """The skin was calibrated at rest while these taxels [m] were stuck: they will not show
        that nothing touches them.
        """
        self._lost[taxels] = 0.0

    def use(self, decides: NDArray[np.int64]) -> None:
        """A calibration has found how many measurements int[m] each taxel takes for a decision; 0:
        it is not usable, and will not be valid again.
        """
        self._decides[self._pads] = found = decides[self._pads]
        self._triangle_decides = np.maximum(np.maximum.reduceat(found, self._starts), 1.0)
        # Of what is waited for, all is wanted again.
        np.copyto(self._lost, self._decides, where=self._lost > 0.0)
        np.copyto(self._unsure, self._triangle_decides, where=self._unsure > 0.0)

    def unread(self) -> ContactState:
        """What was felt for a while has not been read: what was untouched before may be touched."""
        self._unsure[:] = self._triangle_decides
        self._is_unsure = True
        return "ON" if self._present else "UNKNOWN"

    def stop(self, events: Iterable[Touch]) -> ContactState:
        """End the contacts, because no data of the part will come for a while."""
        self._present.difference_update(event.id for event in events)
        self.unread()
        return "UNKNOWN"


def use_measurements(contacts: Mapping[int, PartContact], engine: "Engine") -> None:
    """Let the contacts of parts, by index, wait only for taxels that can be valid by the engine's
    calibration, if it has one, until these have decided.
    """
    decides = engine.measurements()
    if decides is not None:
        for index, contact in contacts.items():
            part = engine.layout.parts[index]
            contact.use(decides[part.start : part.stop])
