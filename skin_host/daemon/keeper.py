"""Keeps in files what a node is to know after a restart: its calibration, the changes by operators,
and the zeros of its taxels.

The event loop waits for no disk, and of two writes the newer one stays. What could not be written
is known, and is written again, as is what somebody has removed. A file is written only where it
changes, because a disk of flash wears out.
"""

import asyncio
import logging
import os
from collections.abc import Callable, Coroutine
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from skin_host.clock import Clock
from skin_host.daemon.calibrate import keep_former
from skin_host.daemon.joining import NodeMemory
from skin_host.daemon.lasting import LastingTouches
from skin_host.daemon.memory import known_of
from skin_host.daemon.state import NodeState, Zeros, kept_path, taxels_of, written_after
from skin_host.daemon.zeros import zeros_of
from skin_host.errors import SkinError
from skin_host.files import refuse_other_robot, write_document
from skin_host.processing.calibration import Calibration, with_pressures_of
from skin_host.processing.calibration.calibrator import Known
from skin_host.processing.calibration.file import find_calibration, save_calibration
from skin_host.processing.core import Engine
from skin_host.processing.masks import Mask

log = logging.getLogger(__name__)

#: Baselines and what is in doubt are looked at this often.
LOOK_S = 1.0
#: What could not be written, or was removed since, is written again after this time.
AGAIN_S = 10.0


class Keeper:
    """The files of one node.

    Args:
        engine: what it knows is kept.
        node: whose files they are.
        memory: what the node started with.
        clock: for waiting and threads.

    Attributes:
        unkept: what could not be written (`calibration`, `state`, `zeros`), and why.
    """

    def __init__(self, engine: Engine, node: str, memory: NodeMemory, clock: Clock) -> None:
        self._engine = engine
        self._path = {
            what: kept_path(engine.settings, node, what)
            for what in ("calibration", "state", "zeros")
        }
        self._clock = clock
        self._state = memory.state
        self._zeros = memory.zeros
        self._others_s = memory.others_s
        self.unkept = dict(memory.unkept)
        #: Id of the calibration in the file, which a start would find; empty if not known.
        self._stored = ""
        if memory.calibration is not None and "calibration" not in self.unkept:
            self._stored = memory.calibration.id
        #: Files that were found or written.
        self._files = {what for what, file in self._path.items() if os.access(file, os.F_OK)}
        #: Of the calibration and the state. Zeros are written by one task at a time.
        self._writing = asyncio.Lock()
        self._zeros_task: asyncio.Task[None] | None = None
        layout = engine.layout
        board_of = np.array([triangle.board for triangle in layout.triangles], np.int64)
        touched = taxels_of(layout, memory.zeros.touched)
        self._touches = LastingTouches(board_of[layout.triangle_of], touched)
        #: How many of the zeros found are kept; the engine's knowledge at the last look, and when
        #: that was.
        self._n_kept = 0
        self._seen = self._knowledge()
        self._looked_s = 0.0

    @property
    def zeros_are_kept(self) -> bool:
        """Whether the file holds the zeros that were to be written last."""
        return "zeros" not in self.unkept and self._under_way() is None

    def use(self, engine: Engine) -> None:
        """Continue with another engine, which goes on from the one before."""
        self._engine = engine

    async def stored(self) -> Calibration | None:
        """Return the calibration of this skin that the file holds now, which another program may
        have written; None if it holds none.

        Raises:
            OtherRobotError: the file is another robot's.
            NewerFileError: a newer version has written it.
            BusyFileError: another program is writing it.
        """
        found = await self._clock.in_thread(self._in_file)
        self._stored = "" if found is None else found.id
        return found

    def known(self, calibration: Calibration) -> Known:
        """Return what is known of the skin by a calibration of before; see `memory.known_of`."""
        return known_of(calibration, self._zeros, self._engine.layout)

    async def keep_calibration(
        self, measured: Mask, before: Calibration | None = None, doubted: Mask | bool = False
    ) -> None:
        """Write the calibration that the engine has in use since now. If that fails it is used
        anyway, until a restart.

        Args:
            measured: bool[n], taxels whose zeros were measured.
            before: the one before, if the other taxels have their zeros from it.
            doubted: bool[n], taxels whose zero was not known by that one.
        """
        self._touches.calibrated(measured)
        async with self._writing:
            if before is not None:
                # Whichever of the two a start finds, the other boards keep their zeros.
                await self._zeros_written()
                self._begin(self._keep_zeros(doubted=doubted))
                await self._zeros_written()
            await self._write_calibration()

    async def keep_state(self, state: NodeState) -> bool:
        """Write what operators have changed; return whether that succeeded."""
        self._state = msgspec.structs.replace(state, robot=self._engine.layout.robot)
        async with self._writing:
            return await self._write_state()

    def look(self, now_s: float) -> None:
        """Begin to write the zeros if what is to be known of them has changed. What was pressed,
        what lasts and what is stuck must be doubted after a crash, too: that is written at once.
        """
        engine, before = self._engine, self._seen
        self._seen = self._knowledge()
        is_due = now_s - self._looked_s >= LOOK_S
        if is_due:
            self._looked_s = now_s
        touches_changed = False
        if engine.ledger.any_silent or self._touches.is_due(now_s):
            silent = [board for board in engine.boards if engine.ledger.silent_ns(board)]
            touches_changed = self._touches.look(
                engine.zeros.touched(), engine.layout.taxels_of(silent), now_s
            )
        if (is_due or touches_changed or self._seen != before) and self._under_way() is None:
            self._begin(self._keep_zeros())

    async def keep_again(self) -> None:
        """Write again what could not be written, and what somebody removed with its folder."""
        while True:
            await self._clock.sleep(AGAIN_S)
            removed = await self._clock.in_thread(self._removed)
            for what in removed:
                log.warning("%s: was removed; it is written again", self._path[what])
            wanted = removed | self.unkept.keys()
            async with self._writing:
                if "calibration" in wanted:
                    await self._write_calibration()
                if "state" in wanted:
                    await self._write_state()
            if "zeros" in removed:
                await self._zeros_written()
                self._begin(self._keep_zeros(anyway=True))

    async def end(self) -> None:
        """Write what is to be known after the end of the daemon."""
        await self._zeros_written()
        await self._keep_zeros(ends=True)

    def _knowledge(self) -> tuple[int, bytes]:
        return self._engine.zeros.changes, self._engine.intake.liveness.stuck.tobytes()

    def _removed(self) -> set[str]:
        """Return what was kept and whose file has been removed."""
        kept = self._files - self.unkept.keys()
        return {what for what in kept if not os.access(self._path[what], os.F_OK)}

    def _begin(self, keeping: Coroutine[Any, Any, None]) -> None:
        """Write the zeros in a task: a caller that is cancelled must not leave two writes."""
        self._zeros_task = asyncio.create_task(keeping, name="keep zeros")

    def _under_way(self) -> asyncio.Task[None] | None:
        """Return the task that is writing the zeros; None if none is."""
        task = self._zeros_task
        return None if task is None or task.done() else task

    async def _zeros_written(self) -> None:
        """Wait until the zeros are not being written."""
        while (task := self._under_way()) is not None:
            await asyncio.wait([task])

    async def _keep_zeros(
        self,
        *,
        ends: bool = False,
        anyway: bool = False,
        doubted: Mask | bool = False,
    ) -> None:
        """Write the zeros, see `zeros.zeros_of`, if they have changed, or `anyway`.

        Until the calibration in use is in its file, they are those of the one that is there, too.
        """
        engine, before = self._engine, self._zeros
        if engine.calibration is None:
            return
        n_found = engine.zeros.found
        zeros = zeros_of(
            engine,
            before,
            self._touches.kept,
            ends=ends,
            found=n_found != self._n_kept,
            replaced="" if self._stored == engine.calibration.id else self._stored,
            doubted=doubted,
        )
        is_news = zeros != before and bool(zeros.baselines or _doubts(zeros) or _doubts(before))
        if is_news or anyway or "zeros" in self.unkept:
            zeros.written = written_after(self._clock.today().timestamp(), self._others_s)
            # What is being written counts as kept: what is asked for later is written after it.
            self._zeros = zeros
            if not await self._write("zeros", lambda path: write_document(path, zeros)):
                return
        self._n_kept = n_found

    async def _write_calibration(self) -> None:
        """Write the calibration in use, with the gains and curves of one that another program has
        written since: they may be in no other file.
        """
        found, known = self._engine.calibration, self._stored
        layout, configuration = self._engine.layout, self._engine.configuration
        if found is None:
            return
        kept = found

        def write(path: Path) -> None:
            nonlocal kept
            before = self._in_file()
            if before is not None and before.id != known:
                kept = with_pressures_of(found, before)
            keep_former(path, layout, configuration)
            save_calibration(path, kept, layout)

        if await self._write("calibration", write):
            self._stored = kept.id
            log.info("calibration %s kept in %s", kept.id, self._path["calibration"])

    def _in_file(self) -> Calibration | None:
        """Read what `stored` returns."""
        path, layout = self._path["calibration"], self._engine.layout
        refuse_other_robot(path, layout.robot, "calibration")
        return find_calibration(path, layout, self._engine.configuration)

    async def _write_state(self) -> bool:
        state = self._state
        return await self._write("state", lambda path: write_document(path, state))

    async def _write(self, what: str, write: Callable[[Path], None]) -> bool:
        """Write one of the files in a thread; return whether that succeeded."""
        path = self._path[what]
        try:
            await self._clock.in_thread(write, path)
        except (OSError, SkinError) as error:
            reason = f"{path}: {error.strerror}" if isinstance(error, OSError) else str(error)
            if what not in self.unkept:
                log.error("%s not kept: %s", what, reason)
            self.unkept[what] = reason
            return False
        self.unkept.pop(what, None)
        self._files.add(what)
        return True


def _doubts(zeros: Zeros) -> bool:
    """Whether any taxel cannot be valid after a restart as it was at the calibration."""
    return bool(zeros.unknown or zeros.touched or zeros.stuck)
