"""Keys of the health record of a part, which is the payload of `<part>/health`.

The records are plain dictionaries because they are published as they are. Counters count from
the start of the daemon. Keys marked as not required are left out where they are unknown: in a
replay, which has no clock, and without a port or board managers.
"""

from typing import Any, NotRequired, TypedDict


class LastSecond(TypedDict):
    """What a bus has gained in about the last second.

    `load` and `other_load` are shares of the bus: of all frames, and of the frames of devices that
    are not configured. The others are counts; `wrong` are frames with a wrong header, too few
    bytes, or unreadable; `spikes` single bytes that were off for one sweep; `overflows` how often
    the controller or its driver lost frames.
    """

    frames_hz: int
    load: float
    other_load: float
    wrong: int
    halves: int
    missed: int
    unknown: int
    spikes: int
    dropped: int
    overflows: int
    error_frames: int


class BusHealth(TypedDict):
    """One bus: the counters of `AssemblerCounters`, and those of its port.

    `port` are `PortCounters`. Unconfigured boards are given by type and address, and by the
    identifiers of the unconfigured node that sends most. `spiked_pads` are those of which a
    single byte was off within the last ten seconds. `unopened` is why the bus cannot be opened.
    `lost_here`: within the last two seconds this computer or its controller lost frames.
    """

    name: str
    interface: str
    channel: str
    frames: int
    other: int
    force_torque: int
    wrong_header: int
    short: int
    unknown_board: int
    unknown_triangle: int
    late: int
    doubled: int
    sweeps: int
    incomplete: int
    halves: int
    missed: int
    state: NotRequired[str]
    unopened: NotRequired[str]
    port: NotRequired[dict[str, int]]
    strangers: NotRequired[dict[int, int]]
    stranger: NotRequired[str]
    last_second: NotRequired[LastSecond]
    spiked_pads: NotRequired[int]
    silent: NotRequired[bool]
    lost_here: NotRequired[bool]


class BoardHealth(TypedDict):
    """One board.

    `period_seen_ms` and `jitter_ms` come from the kernel's time stamps of its last sweeps;
    `in_doubt` counts taxels whose zero is unknown; `awaited`: since the start it has not had
    the time to send, or it paused and may have zeroed itself; `lately` has the counters among
    `resets`, `lost_set_ups`, `tx_overflows`, `excess` and `rezeros` that rose within the last
    minute; `excess` are sweeps that were too many to be processed;
    `twice`: two boards send at its address; `held_up`: it may be regular, but its frames waited
    for those of more urgent boards; `wrong_model` is the configured one if it reports another.
    """

    name: str
    bus: str
    address: int
    skin_type: int
    alive: bool
    sweeps: int
    fitted: list[int]
    triangles_present: int
    triangles: int
    period_ms: int
    period_seen_ms: float | None
    jitter_ms: float | None
    rezeros: int
    excess: int
    in_doubt: int
    board_type: NotRequired[int | None]
    wrong_type: NotRequired[bool]
    wrong_model: NotRequired[str]
    firmware: NotRequired[tuple[int, int, int] | None]
    in_bootloader: NotRequired[bool]
    awaited: NotRequired[bool]
    configurations: NotRequired[int]
    silences: NotRequired[int]
    resets: NotRequired[int]
    lost_set_ups: NotRequired[int]
    tx_overflows: NotRequired[int]
    age_ms: NotRequired[float | None]
    lately: NotRequired[dict[str, int]]
    twice: NotRequired[bool]
    held_up: NotRequired[bool]


class TriangleHealth(TypedDict):
    """A triangle with a fault."""

    board: str
    triangle: int
    fault: str


class Temperatures(TypedDict):
    """Median shift of the temperature pads since the calibration, and of all untouched taxels from
    their baselines, in units of the usual shift.

    `coarsest_units`: what a unit of the part's coarsest bytes is of these, 1 at least.
    """

    thermal_units: float | None
    common_units: float
    coarsest_units: float


class CalibrationName(TypedDict):
    """Which calibration is in use."""

    id: str
    time: str


class FaultName(TypedDict):
    """A fault, for programs: `diagnosis` lists the codes."""

    code: str
    where: str


class Record(TypedDict):
    """One part.

    Taxels are given by their number in the part; `output` are `PublisherCounters`;
    `other_triangles` are those with a fault that other parts have on its boards: parts may share a
    data line.
    """

    part: str
    frames: int
    rate_hz: float
    taxels: int
    valid_taxels: int
    invalid: list[int]
    beyond_range: list[int]
    triangles: list[TriangleHealth]
    taxel_verdicts: dict[str, list[int]]
    decides_kpa: float | None
    taxel_faults: dict[str, list[int]]
    boards: list[BoardHealth]
    buses: list[BusHealth]
    warmth: Temperatures | None
    baseline_frozen: list[int]
    baseline_at_limit: list[int]
    calibration: CalibrationName | None
    state: str
    other_triangles: NotRequired[list[TriangleHealth]]
    age_ms: NotRequired[float | None]
    output: NotRequired[dict[str, Any]]
    unkept: NotRequired[dict[str, str]]
    log_lines_lost: NotRequired[int]
    faults: NotRequired[list[FaultName]]
    sentences: NotRequired[list[str]]
