"""A calm: nothing happens any more, and a careful operator repairs what was spoiled."""

import msgspec

from emulator.probes.scene import Fault
from skin_host.evaluation.simulate.accusations import NOISE
from skin_host.evaluation.simulate.deeds import Deeds
from skin_host.evaluation.simulate.troubles.acts import act
from skin_host.mqtt.commands import MAX_RUNNING

#: How long it may take to be well, and after what time an operator calibrates again.
CALM_S = 60.0
AGAIN_S = 8.0
#: Faults that a calm may keep: they report what happened within the last minute, or real pads.
LATE_FAULTS = {
    "board_lost_set_up",
    "board_reset",
    "board_rezeroed",
    "board_overflows",
    "touches_dropped",
    "broker_refuses",
    "taxel_decides_late",
    "taxel_held",
    "part_temperature",
    "taxel_drifting",
}


class Calm:
    """Waits until all is well.

    Args:
        deeds: of the run; the operator's are some, too.
    """

    def __init__(self, deeds: Deeds) -> None:
        self._deeds = deeds
        self._world = deeds.world

    async def until_well(self) -> None:
        """Nothing happens any more. The operator does what a careful one does; then all is well."""
        world = self._world
        world.note("calm")
        began_s = world.clock.monotonic_s()
        await world.clock.sleep(8.0)
        repaired_s: float | None = None
        while not self._is_well():
            now_s = world.clock.monotonic_s()
            if now_s - began_s > CALM_S:
                self._deeds.promises.break_(
                    f"not well after {CALM_S:g} s of calm: {self._state_of_all()}"
                )
                return
            due = repaired_s is None or now_s - repaired_s > AGAIN_S
            if due and self._is_reachable():
                await self._repair(first=repaired_s is None)
                repaired_s = world.clock.monotonic_s()
            await world.clock.sleep(0.5)
        world.note("well")
        if world.life is not None:
            self._deeds.promises.account(world.life)
            self._deeds.promises.grown()

    async def _repair(self, *, first: bool) -> None:
        """The operator does what the sentences of health ask for."""
        world = self._world
        if first:
            world.note("the operator sets everything up")
            await self._enable([part.name for part in world.layout.parts])
            self._deeds.ask("thresholds", '{"reset": true}')
            for board in sorted(world.unpowered):
                self._deeds.promises.begin(act("power"))
                world.robot.inject(Fault(name="board_reset", board=board))
            world.unpowered.clear()
            self._deeds.ask("configure", "{}")
            await world.clock.sleep(6.0)
        elif world.life is not None:
            # While others ran, or the connection was lost, a request was refused or lost.
            disabled = sorted(world.life.daemon.engine.disabled)
            await self._enable([world.layout.parts[number].name for number in disabled])
        # Foam that was pressed for long relaxes for a while: then one calibration is not enough.
        world.note("the operator calibrates")
        self._deeds.ask("calibrate", "{}")
        await world.clock.sleep(7.0)
        self._deeds.promises.calibrated_at_rest()

    async def _enable(self, parts: list[str]) -> None:
        for number, part in enumerate(parts, 1):
            self._deeds.ask("enable", f'{{"part": "{part}"}}')
            if number % MAX_RUNNING == 0:  # it would refuse the next one
                await self._world.clock.sleep(0.5)

    def _is_reachable(self) -> bool:
        life = self._world.life
        return life is not None and life.daemon.publisher.counters.connected

    def _is_well(self) -> bool:
        return not self._state_of_all()

    def _state_of_all(self) -> list[str]:
        """What is not as it should be after quiet, as the broker keeps it."""
        world = self._world
        life = world.life
        if life is None:
            return ["no daemon"]
        topics, retained = life.daemon.publisher.topics, world.broker.retained
        found = []
        if retained.get(topics.node("status", "main")) != b"online":
            found.append("status is not online")
        for name in [*(part.name for part in world.layout.parts), *world.settings.fingertips]:
            state = retained.get(topics.part("contact", name))
            if state != b"OFF":
                found.append(f"{name}: contact {state!r}")
            stuck = self._deeds.promises.accusations.stuck.get(name, frozenset())
            for fault, where in self._faults(retained.get(topics.part("health", name)), stuck):
                if fault not in LATE_FAULTS and not (world.real_noise and fault in NOISE):
                    found.append(f"{name}: {fault} {where}")
        return found

    def _faults(self, payload: bytes | None, stuck: frozenset[int]) -> list[tuple[str, str]]:
        """Return what health reports of a part, but for pads that have been stuck from the first.

        A calibration by damaged bytes finds noise where there is none: then they are named.
        """
        if payload is None:
            return [("no health", "")]
        record = msgspec.json.decode(payload)
        found = [(fault["code"], fault["where"]) for fault in record["faults"]]
        refused = self._world.real_noise and any(code in NOISE for code, _ in found)
        if stuck and stuck.issuperset(record["taxel_faults"].get("stuck", ())):
            found = [(code, where) for code, where in found if code != "taxel_stuck"]
            refused |= record["state"] == "degraded" and stuck.issuperset(record["invalid"])
        if record["state"] not in ("ok", "warning") and not refused:
            taxels = f"{record['valid_taxels']} of {record['taxels']}" if "taxels" in record else ""
            found.append((record["state"], taxels))
        return found
