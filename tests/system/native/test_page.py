"""The live page in a real browser, from presses on emulated foam to what a person sees."""

import json
import re
from collections.abc import AsyncIterator, Sequence
from contextlib import asynccontextmanager
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest

from skin_host.config.settings import Bus, changed, load
from skin_host.importing import configuration_text, import_files
from skin_host.importing.report import Findings
from skin_host.recording.mcap import read_messages_of
from tests.support.broker import Mosquitto
from tests.support.devtools import Page
from tests.support.stack import ROOT, Stack
from tests.support.viewing import LIVE, viewing

SAMPLES = ROOT.parent / "shared" / "data"
SCENE = ROOT / "config" / "scenes" / "demo.toml"
#: How many pixels of the map, and of curved parts below it, are not of its background.
DRAWN = """(() => {
    const map = document.getElementById("map");
    const copy = new OffscreenCanvas(map.width, map.height)
        .getContext("2d", { willReadFrequently: true });
    const body = document.getElementById("body");
    if (body) copy.drawImage(body, 0, 0);
    copy.drawImage(map, 0, 0);
    const data = copy.getImageData(0, 0, map.width, map.height).data;
    let drawn = 0;
    for (let i = 3; i < data.length; i += 4) if (data[i]) drawn++;
    return drawn;
})()"""
STALE = 'document.body.dataset.stale === "true"'
HEALTHY = """document.querySelector('#health [data-level="ok"]')
    && !document.querySelector('#health [data-level="alarm"], #health [data-level="warn"]')"""
CONTACTS = """[...document.querySelectorAll("#contacts tbody tr")]
    .map(row => [...row.cells].map(cell => cell.textContent))"""


TICKS = '[...document.querySelectorAll("#ticks span")].map(tick => tick.textContent)'
CLICK_CONTACT = """(async () => {
    for (let i = 0; i < 300; i++) {
        const row = document.querySelector("#contacts tbody tr");
        row?.click();
        await new Promise(done => setTimeout(done, 100));
        if (row?.ariaSelected === "true") return true; // it may have ended meanwhile
    }
})()"""
#: Thirteen parts as the server tells of them, of which nothing has been heard but their health.
MANY_PARTS = """(() => {
    const square = [[0, 0, 0], [0.05, 0, 0], [0.05, 0.03, 0], [0, 0.03, 0]];
    const parts = Array.from({ length: 13 }, (_, k) => ({
        name: `right_upper_part_${k}`, node: "main", period_ms: 50,
        pads: Array(12).fill("pressure"),
        position_m: Array.from({ length: 12 }, (_, i) => [0.004 * i, 0.01, 0]),
        normal: Array(12).fill([0, 0, 1]), radius_mm: Array(12).fill(2),
        area_mm2: Array(12).fill(20),
        triangles: [
            { board: "b", number: 0, kind: "x", first: 0, outline_m: square, no_load: 240 },
        ],
    }));
    say("layout", { version: 9, robot: "many", parts, nodes: {} });
    for (const part of parts) say("health", {
        part: part.name, state: "not calibrated", taxels: 12, valid_taxels: 0,
        sentences: ["Not calibrated: leave it untouched.", `${part.name} says so`], triangles: [],
    });
    const draws = () => Number(document.body.dataset.draws);
    const before = draws();
    return new Promise(done => {
        const look = () => draws() > before ? done(true) : setTimeout(look, 600);
        setTimeout(look, 600);
    });
})()"""
#: The page takes from a script what it took from its server, of which it takes nothing any more.
#: The connection may be lost for ever.
IN_ITS_PLACE = """(() => {
    const socket = window.sockets.at(-1), take = socket.onmessage;
    socket.onmessage = socket.send = () => {};
    window.serve = data => take.call(socket, { data });
    window.say = (type, message) => serve(JSON.stringify({ type, ...message }));
    window.lose = () => {
        window.WebSocket = class { static OPEN = 1; };
        socket.onclose();
    };
})()"""
#: Parts with one taxel each, and their frames: what a server would send of them.
PARTS = """(() => {
    const part = (name, more = {}) => ({
        name, node: "main", period_ms: 50, pads: ["pressure"], position_m: [[0, 0, 0]],
        normal: [[0, 0, 1]], radius_mm: [2], area_mm2: [20], triangles: [
            { board: "b", number: 0, kind: "x", first: 0, no_load: 240,
              outline_m: [[0, 0, 0], [0.01, 0, 0], [0, 0.01, 0]] },
        ], ...more,
    });
    const connect = () => say(
        "status", { connected: true, commands: true, error: "", nodes: { main: true } });
    let seq = 0;
    const frameOf = (version, number, age_s, bits, ...raw) => {
        const view = new DataView(new ArrayBuffer(41 + raw.length));
        view.setUint8(0, 1);
        view.setUint8(1, raw.length);
        view.setUint16(2, number, true);
        view.setUint32(4, 1, true);
        view.setUint32(8, version, true);
        view.setUint32(12, ++seq, true);
        view.setFloat64(16, seq / 20, true);
        view.setFloat32(32, age_s, true);
        view.setUint8(40, bits);
        raw.forEach((byte, i) => view.setUint8(41 + i, byte));
        return view.buffer;
    };
"""
#: Two of them and a fingertip.
SERVER = (
    PARTS
    + """
    const bare = { fingertip: true, period_ms: 1000, pads: [], position_m: [], normal: [],
                   radius_mm: [], area_mm2: [], triangles: [] };
    window.contacts = (part, state, why = null, contacts = []) =>
        say("contacts", { part, state, why, contacts });
    window.health = (part, age_s) => say("health", {
        part, age_s, state: "ok", sentences: [], rate_hz: 50, taxels: 1, valid_taxels: 1,
        triangles: [],
    });
    window.pressed = (number, age_s) => serve(frameOf(9, number, age_s, 1));
    say("layout", { version: 9, robot: "three", nodes: {},
                    parts: [part("palm"), part("wrist"), part("tip", bare)] });
    return true;
})()"""
)
TOUCHING = """document.getElementById("no-contacts").hidden
    ? "" : document.getElementById("no-contacts").textContent"""
TOTAL = 'document.querySelector("#forces span").textContent'
HEALTH = 'document.getElementById("health").innerText'
WATCH_SOCKETS = """
    window.sockets = [];
    window.WebSocket = class extends WebSocket {
        constructor(...all) { super(...all); window.sockets.push(this); }
    };
    const words = CanvasRenderingContext2D.prototype.fillText;
    window.labels = [];
    CanvasRenderingContext2D.prototype.fillText = function (text, x, y) {
        const wide = this.measureText(text).width;
        if (this.canvas.id === "map") window.labels.push([text, x, y, wide]);
        words.call(this, text, x, y);
    };
    const clear = CanvasRenderingContext2D.prototype.clearRect;
    CanvasRenderingContext2D.prototype.clearRect = function (...all) {
        if (this.canvas.id === "map") window.labels = [];
        clear.apply(this, all);
    };
"""


@pytest.fixture
def robot(tmp_path: Path, mosquitto: Mosquitto) -> Stack:
    """The demo's robot and its daemon."""
    bus = Bus(interface="virtual", channel=tmp_path.name)
    return Stack(tmp_path, bus, "virtual", mosquitto, "demo")


def start(robot: Stack) -> None:
    robot.start("run", str(robot.config), "--calibrate", scene=SCENE)


@asynccontextmanager
async def page(
    robot: Stack, profile: Path, width: int = 1280, *, watch: str = ""
) -> AsyncIterator[Page]:
    """The page of the robot, which ends with it."""
    try:
        async with viewing(robot.broker, "demo", profile, width, watch=watch) as opened:
            yield opened
    finally:
        robot.kill()


async def test_a_press_is_seen_and_parts_and_values_can_be_chosen(
    robot: Stack, tmp_path: Path
) -> None:
    start(robot)
    async with page(robot, tmp_path / "profile") as seen:
        await seen.until(LIVE)
        parts = await seen.run(
            '[...document.querySelectorAll("#parts span")].map(part => part.textContent)'
        )
        assert parts == ["all", "left_hand", "left_forearm"]
        assert await seen.run(DRAWN) > 20_000
        ticks = await seen.run(TICKS)
        assert ticks[-1].endswith(" kPa")
        # Round, and as far apart as their square roots.
        values = [float(tick.split()[0]) for tick in ticks]
        assert values[0] == 0
        assert {f"{value:e}"[0] for value in values[1:]} <= {"1", "2", "5"}
        name, number, force, peak, area = (await seen.until(f"({CONTACTS})[0]"))[:5]
        assert name in parts
        assert number.startswith("#")
        assert (force[-2:], peak[-4:], area[-4:]) == (" N", " kPa", " mm²")
        # A contact in the table is marked on the map, and a click selects it.
        assert await seen.run(CLICK_CONTACT)
        await seen.press("Escape")
        await seen.until("""!document.querySelector('#contacts tr[aria-selected="true"]')""")
        # A click chooses a taxel, whose course is drawn from before the click on.
        await seen.click_on('document.querySelectorAll("#parts button")[2]')
        await seen.press(".")
        await seen.until('!document.getElementById("tip").hidden')
        left, top, width, height = await seen.run(
            """(() => {
                const box = document.getElementById("map").getBoundingClientRect();
                return [box.left, box.top, box.width, box.height];
            })()"""
        )
        for step in range(20):
            await seen.click(left + width / 2 + 7 * step, top + height / 2)
            if await seen.run('document.querySelectorAll("#chosen button").length'):
                break
        await seen.until('/left_forearm/.test(document.getElementById("chosen").textContent)')
        # It survives a reload, with the dashes of its line in the legend.
        await seen.call("Page.reload")
        await seen.until('/left_forearm/.test(document.getElementById("chosen")?.textContent)')
        assert await seen.run('document.querySelectorAll("#chosen svg line").length') == 1
        # Raw values come on request.
        await seen.press("r")
        await seen.until('/raw \\d+/.test(document.getElementById("chosen").textContent)')
        assert (await seen.run(TICKS))[0] == "raw = no-load"
        await seen.press("r")
        await seen.until('/kPa/.test(document.getElementById("chosen").textContent)')
        # Keys: all parts, dark and light.
        await seen.press("0")
        await seen.until('document.querySelector("#parts button").ariaCurrent === "true"')
        # The theme is the system's, also when that changes, until one is chosen.
        for name in ("light", "dark"):
            feature = {"name": "prefers-color-scheme", "value": name}
            await seen.call("Emulation.setEmulatedMedia", features=[feature])
            await seen.until(f'document.documentElement.dataset.theme === "{name}"')
        before = await seen.run("document.documentElement.dataset.theme")
        await seen.press("t")
        await seen.until(f'document.documentElement.dataset.theme !== "{before}"')
        assert len(await seen.picture()) > 20_000


async def choose_two(seen: Page) -> None:
    """Choose two taxels of the first part, by keys alone."""
    for _ in range(2):
        await seen.press(".")
        await seen.press("Enter")
    await seen.until('document.querySelectorAll("#chosen button").length === 2')


AT = 'document.getElementById("at").textContent'
LEGENDS = '[...document.querySelectorAll("#chosen span, #forces span")].map(one => one.textContent)'


async def test_plots_are_held_read_and_as_long_as_wanted(robot: Stack, tmp_path: Path) -> None:
    start(robot)
    async with page(robot, tmp_path / "profile") as seen:
        await seen.until(LIVE)
        await choose_two(seen)
        left, top, width, height = await seen.box("#strip .u-over")
        # By mouse: the values under the cursor stand in the legends of both plots.
        for share, seconds in ((0.5, "(2[4-9]|3[0-6])"), (0.9, "[0-9]")):
            x, y = left + share * width, top + height / 2
            await seen.call("Input.dispatchMouseEvent", type="mouseMoved", x=x, y=y)
            await seen.until(f"/^at −{seconds}[.]/.test({AT})")
        await seen.until(f"{LEGENDS}.every(text => /: [-0-9.]+ (kPa|N)$/.test(text))")
        await seen.call("Input.dispatchMouseEvent", type="mouseMoved", x=1, y=1)
        await seen.until('document.getElementById("at").hidden')
        # By keyboard: held values stay.
        await seen.press("p")
        await seen.until(f"/^held/.test({AT})")
        await seen.run('document.getElementById("strip").focus()')
        await seen.press("End")
        await seen.until(f"/ at −0/.test({AT})")
        held = await seen.run(LEGENDS)
        draws = int(await seen.run("document.body.dataset.draws"))
        await seen.until(f"Number(document.body.dataset.draws) > {draws + 20}")
        assert await seen.run(LEGENDS) == held
        await seen.press("Home")
        await seen.until(f"/at −60/.test({AT})")
        await seen.press("ArrowRight")
        await seen.until(f"/at −5[789]/.test({AT})")
        assert await seen.run('document.querySelector("#parts button").ariaCurrent') == "true"
        await seen.press("Escape")
        await seen.until(f"!/ at /.test({AT})")
        assert await seen.run('document.querySelectorAll("#chosen button").length') == 2
        await seen.press("p")
        await seen.until('document.getElementById("at").hidden')
        # By touch, over the length that is chosen, which a reload does not forget.
        await seen.run(
            """(() => {
                const length = document.getElementById("length");
                length.value = "300";
                length.dispatchEvent(new Event("change"));
            })()"""
        )
        await seen.call("Emulation.setTouchEmulationEnabled", enabled=True)
        left, top, width, height = await seen.box("#strip .u-over")
        middle = (left + width / 2, top + height / 2)
        await seen.touch((left + width / 4, middle[1]), middle)
        await seen.until(f"/^at −1[3-6][0-9] s$/.test({AT})")
        await seen.call("Page.reload")
        await seen.until('document.getElementById("length")?.value === "300"')


async def test_stopped_data_are_called_stale_and_everything_comes_back(
    robot: Stack, tmp_path: Path, mosquitto: Mosquitto
) -> None:
    start(robot)
    async with page(robot, tmp_path / "profile") as seen:
        await seen.until(LIVE)
        robot.kill()  # robot and daemon are gone, without a word
        await seen.until(STALE)
        assert "stale" in (await seen.run('document.getElementById("banner").textContent')).lower()
        _, top, _, height = await seen.box("#banner")
        _, map_top, _, _ = await seen.box("#map")
        assert top + height <= map_top  # the names of the parts stay readable
        assert await seen.run(CONTACTS) == []
        start(robot)
        await seen.until(f"{LIVE} && !({STALE})")
        mosquitto.kill()
        await seen.until(f"{STALE} && /no broker/.test(document.body.innerText)")
        mosquitto.start()
        await seen.until(f"{LIVE} && !({STALE})")
        await seen.until(f"({CONTACTS}).length")


@asynccontextmanager
async def served(
    mosquitto: Mosquitto, profile: Path, script: str = SERVER, width: int = 1280
) -> AsyncIterator[Page]:
    """The page, and what a script sends it in a server's place."""
    async with viewing(mosquitto, "nobody", profile, width, watch=WATCH_SOCKETS) as seen:
        await seen.until("window.sockets.at(-1)?.readyState === 1")
        await seen.run(IN_ITS_PLACE)
        assert await seen.run(script)
        yield seen


async def test_nothing_touches_only_what_is_known_to_be_untouched(
    mosquitto: Mosquitto, tmp_path: Path
) -> None:
    async with served(mosquitto, tmp_path / "p") as seen:

        async def shows(text: str, total: str) -> None:
            await seen.until(f"{TOUCHING} === {json.dumps(text)} && {TOTAL} === 'total: {total}'")

        # Frames and health come; no state does.
        await seen.run("setInterval(() => { pressed(0, 0); pressed(1, 0); health('tip', 0); }, 50)")
        state = "Not known of palm, wrist, tip: no contact state has come."
        await shows(state, "not known")
        await seen.run("contacts('palm', 'OFF'); contacts('wrist', 'OFF'); contacts('tip', 'OFF')")
        await shows("Nothing touches the skin.", "0.00 N")
        # A dead board, a fingertip without a zero: of others it is known.
        unknown = "Not known of wrist: not all is felt."
        await seen.run("contacts('wrist', 'UNKNOWN', 'not_felt')")
        await shows(f"{unknown} Nothing touches palm, tip.", "not known")
        await seen.run("contacts('wrist', 'OFF'); contacts('tip', 'UNKNOWN', 'not_felt')")
        await shows("Not known of tip: not all is felt. Nothing touches palm, wrist.", "not known")
        await seen.run("contacts('tip', 'OFF'); contacts('wrist', 'UNKNOWN', 'not_felt')")
        one = "{ id: 4, taxels: [0], centroid_m: null, force_n: 1.5, peak_kpa: 9, area_mm2: 20 }"
        await seen.run(f"contacts('palm', 'ON', null, [{one}])")
        await shows(unknown, "≥ 1.50 N")
        await seen.run("contacts('palm', 'OFF')")
        await seen.run("contacts('wrist', 'ON')")
        await shows("Touched: wrist; where is not known yet.", "not known")
        await seen.run(
            "for (const one of ['palm', 'wrist', 'tip']) contacts(one, 'UNKNOWN', 'offline')"
        )
        await shows("Not known of palm, wrist, tip: the node is offline.", "not known")
        assert await seen.run(CONTACTS) == []
        # The page loses its server: at once, though the last health of a fingertip is not old yet.
        await seen.run("contacts('palm', 'OFF'); contacts('wrist', 'UNKNOWN', 'not_felt')")
        await seen.run(f"contacts('tip', 'ON', null, [{one}])")
        await shows(unknown, "≥ 1.50 N")
        await seen.run("lose()")
        await shows("Not known of palm, wrist, tip: there is no connection.", "not known")
        assert await seen.run(CONTACTS) == []


async def test_of_a_robot_that_is_not_there_no_force_is_known(
    mosquitto: Mosquitto, tmp_path: Path
) -> None:
    async with viewing(mosquitto, "nobody", tmp_path / "p") as seen:
        status = 'document.getElementById("status").textContent'
        await seen.until(f"/is `skin run` running/.test({status})")
        await seen.until(f"{TOTAL} === 'total: not known'")


@asynccontextmanager
async def untouched(mosquitto: Mosquitto, profile: Path) -> AsyncIterator[Page]:
    """The page of a skin whose frames, health and contacts come, and nothing touches."""
    async with served(mosquitto, profile) as seen:
        await seen.run("setInterval(() => { pressed(0, 0); pressed(1, 0); health('tip', 0); }, 50)")
        await seen.run("contacts('palm', 'OFF'); contacts('wrist', 'OFF'); contacts('tip', 'OFF')")
        yield seen


async def test_a_force_that_is_only_a_bound_is_shown_as_one(
    mosquitto: Mosquitto, tmp_path: Path
) -> None:
    """Of skin beside dead pads, or pressed beyond its range; of a fingertip whose board is."""
    async with untouched(mosquitto, tmp_path / "p") as seen:

        async def shows(part: str, cells: list[str], why: str, **changes: Any) -> None:
            contact = {
                "id": 4,
                "taxels": [0] if part == "palm" else [],
                "centroid_m": None,
                "force_n": 1.5,
                "peak_kpa": 9,
                "area_mm2": 20,
                "partial": False,
                "beyond": False,
                "verdict": None,
            } | changes
            await seen.run(f"contacts('{part}', 'ON', null, [{json.dumps(contact)}])")
            row = [part, "#4", *cells]
            await seen.until(f"JSON.stringify({CONTACTS}) === JSON.stringify({json.dumps([row])})")
            total = f"total: {'≥ ' if '≥' in cells[0] else ''}1.50 N"
            await seen.until(f"{TOTAL} === {json.dumps(total)}")
            assert await seen.run('document.querySelector("#contacts tbody tr").title') == why
            if part == "palm":
                label = json.dumps(f"#4  {cells[0]}")
                await seen.until(f"window.labels.some(([text]) => text === {label})")

        await shows("palm", ["1.50 N", "9.0 kPa", "20 mm²"], "")
        bounds = ["≥ 1.50 N", "≥ 9.0 kPa", "20 mm²"]
        await shows("palm", bounds, "a pad is pressed beyond its calibrated range", beyond=True)
        bounds = ["≥ 1.50 N", "≥ 9.0 kPa", "≥ 20 mm²"]
        await shows("palm", bounds, "pads beside it are not valid", partial=True)
        await seen.run("contacts('palm', 'OFF')")
        bare = {"peak_kpa": None, "area_mm2": None}
        bounds = ["≥ 1.50 N", "–", "–"]
        end = "its board is at the end of its range"
        await shows("tip", bounds, end, beyond=True, verdict="saturated", **bare)
        # The board measures the force, whatever the pads on it do.
        bounds = ["1.50 N", "≥ 9.0 kPa", "20 mm²"]
        why = "a pad is pressed beyond its calibrated range"
        await shows("tip", bounds, why, beyond=True, verdict="contact")


#: What the legend of the forces says beside the table, of each picture of some seconds in which
#: a force changes as fast as touches come.
SAYS_THE_SAME = """new Promise(done => {
    const contact = { id: 4, taxels: [0], centroid_m: null, peak_kpa: 9, area_mm2: 20,
                      partial: false, beyond: false, verdict: null };
    const seen = [];
    let [force_n, left] = [1, 200];
    const frame = () => {
        const list = document.querySelector("#forces span")?.textContent;
        seen.push([list, "total: " + document.getElementById("total").textContent]);
        force_n += 0.01;
        contacts("palm", "ON", null, [{ ...contact, force_n }]);
        if (left--) requestAnimationFrame(frame);
        else done(seen.slice(20));
    };
    frame();
})"""


async def test_the_legend_of_the_forces_is_as_new_as_the_table(
    mosquitto: Mosquitto, tmp_path: Path
) -> None:
    """It was up to a tenth of a second older."""
    async with untouched(mosquitto, tmp_path / "p") as seen:
        pairs = await seen.run(SAYS_THE_SAME)
        assert len({total for total, _ in pairs}) > 100
        assert [total for total, _ in pairs] == [total for _, total in pairs]


#: The course of a force from the times, values and bounds of what came, between two times.
COURSE = """(async (came, fromMs, toMs) => {
    const { Course } = await import("/history.js");
    const course = new Course(1000);
    for (const [atMs, value] of came) course.add(atMs, value, false);
    return course.between(fromMs, toMs).map(([atMs, value]) => [Math.round(atMs), value]);
})"""


async def test_the_course_of_a_force_steps_and_ends_where_it_is_not_known(
    mosquitto: Mosquitto, tmp_path: Path
) -> None:
    """It was a slope: over a pause, and from the last change to a new value."""

    async def course(came: Sequence[tuple[float, float | None]], to_ms: float) -> list[Any]:
        return list(await seen.run(f"{COURSE}({json.dumps(came)}, 0, {to_ms})"))

    async with viewing(mosquitto, "nobody", tmp_path / "p") as seen:
        rest = [(float(at), 0.0) for at in range(0, 5001, 50)]
        # A picture of a moment, and what touches then, come one after the other.
        touch = [*rest, (5001.0, 2.0), (5050.0, 2.0)]
        assert await course(touch, 5050) == [[0, 0], [5000, 0], [5001, 2], [5050, 2]]
        assert await course([*rest, (5000.0, 2.0)], 5050) == [[0, 0], [5000, 0], [5000, 2]]
        assert await course([(0.0, 1.0), (1.0, 2.0), (50.0, 3.0)], 50) == [[1, 2], [50, 3]]
        # Nothing comes for two seconds; then for ever.
        pause = [*rest, (7000.0, 2.0), (7050.0, 2.0)]
        seconds = [[0, 0], [5000, 0], [6000, None], [7000, 2], [7050, 2]]
        assert await course(pause, 8000) == seconds
        assert await course(pause, 9000) == [*seconds, [8050, None]]
        # What is not known stays so, however long that lasts.
        assert await course([(0.0, None), (9000.0, 1.0)], 9000) == [[0, None], [9000, 1]]


async def test_of_a_part_without_frames_contacts_are_shown(
    mosquitto: Mosquitto, tmp_path: Path
) -> None:
    """Its configuration has `frames = false`: it was shown as one of which nothing comes."""
    script = SERVER.replace('part("palm")', "part('palm', { frames: false })")
    async with served(mosquitto, tmp_path / "p", script) as seen:
        await seen.run(
            "setInterval(() => { health('palm', 0); pressed(1, 0); health('tip', 0); }, 50)"
        )
        await seen.run("contacts('palm', 'OFF'); contacts('wrist', 'OFF'); contacts('tip', 'OFF')")
        await seen.until(
            f"{TOUCHING} === 'Nothing touches the skin.' && {TOTAL} === 'total: 0.00 N'"
        )
        one = "{ id: 4, taxels: [0], centroid_m: null, force_n: 1.5, peak_kpa: 9, area_mm2: 20 }"
        await seen.run(f"contacts('palm', 'ON', null, [{one}])")
        await seen.until(f"({CONTACTS})[0]?.[0] === 'palm' && {TOTAL} === 'total: 1.50 N'")
        palm = """document.querySelector('#health article[data-part="palm"]')"""
        assert await seen.run(f"{palm}.dataset.level") == "ok"
        assert "no frames are published, 1 of 1 taxels valid" in await seen.run(f"{palm}.innerText")
        await seen.until("window.labels.some(([text]) => text === 'palm: touches only')")
        # Its health shows that it lives.
        await seen.run("health = () => {}; window.health = () => {}")
        gone = f"/^Not known of palm.*: nothing comes any more/.test({TOUCHING})"
        await seen.until(f"{gone} && {TOTAL} === 'total: not known'")


RAW = 'document.getElementById("show-raw").ariaPressed === "true"'


async def test_raw_values_stay_while_any_node_sends_them(
    mosquitto: Mosquitto, tmp_path: Path
) -> None:
    """One that is offline, or takes no commands, is not asked; one may refuse."""
    async with served(mosquitto, tmp_path / "p") as seen:
        await seen.run("""(() => {
            window.asked = [];
            window.sockets.at(-1).send = text => asked.push(JSON.parse(text));
            window.answer = (node, ok) => say("answer", { do: "raw", node, ok, error: "no" });
            const part = (name, node) => ({
                name, node, period_ms: 50, pads: ["pressure"], position_m: [[0, 0, 0]],
                normal: [[0, 0, 1]], radius_mm: [2], area_mm2: [20], triangles: [],
            });
            say("layout", {
                version: 10, robot: "r", parts: [..."abcd"].map(name => part(name, name)),
                nodes: Object.fromEntries([..."abcd"].map(n => [n, { commands: n !== "d" }])) });
            say("status", { connected: true, commands: true, error: "",
                            nodes: { a: true, b: false, c: null, d: true } });
        })()""")
        await seen.until('!document.getElementById("show-raw").disabled')
        await seen.run('answer("b", false)')  # to what was asked before: nobody waits for it
        await seen.click_on('document.getElementById("show-raw")')
        await seen.until('document.getElementById("banner").textContent !== "no"')
        wanted = [{"do": "raw", "node": "a"}, {"do": "raw", "node": "c"}]
        assert await seen.run("asked") == wanted
        await seen.run('answer("c", false)')
        assert await seen.run(RAW)
        await seen.run('answer("a", true)')
        assert await seen.run(RAW)
        await seen.run('answer("a", false)')
        assert not await seen.run(RAW)
        await seen.until('document.getElementById("banner").textContent === "no"')


async def test_without_a_broker_nothing_is_asked_and_raw_values_come_back_with_it(
    mosquitto: Mosquitto, tmp_path: Path
) -> None:
    """Nobody calibrates a robot that is out of reach, and finds it calibrated later."""
    async with served(mosquitto, tmp_path / "p", RAW_SERVER) as seen:
        await seen.run("""(() => {
            window.asked = [];
            window.sockets.at(-1).send = text => asked.push(JSON.parse(text).do);
            window.linked = connected => say("status",
                { connected, commands: true, error: "", nodes: { main: true } });
        })()""")
        await seen.click_on('document.getElementById("show-raw")')
        await seen.run("linked(false)")
        await seen.until('document.getElementById("calibrate").disabled')
        assert await seen.run(RAW)
        assert await seen.run("asked") == ["raw"]
        await seen.run("linked(true)")
        await seen.until('!document.getElementById("calibrate").disabled')
        assert await seen.run(RAW)
        assert await seen.run("asked") == ["raw", "raw"]
        await seen.run("lose()")
        await seen.until('document.getElementById("calibrate").disabled')


#: Two of them, of a node that sends raw values: the byte of each, and its bits.
RAW_SERVER = (
    PARTS
    + """
    say("layout", { version: 10, robot: "r", parts: [part("palm"), part("wrist")],
                    nodes: { main: { commands: true } } });
    connect();
    window.bytes = (number, byte, bits) => serve(frameOf(10, number, 0, bits, byte));
    return true;
})()"""
)


async def test_a_byte_that_was_not_received_is_no_press(
    mosquitto: Mosquitto, tmp_path: Path
) -> None:
    """Frames hold 0 for it, which a pad that is pressed to the end of its scale sends, too."""
    async with served(mosquitto, tmp_path / "p", RAW_SERVER) as seen:
        await seen.run("setInterval(() => { bytes(0, 0, 0); bytes(1, 0, 1); }, 50)")
        await seen.click_on('document.getElementById("show-raw")')
        for key in (".", "Enter", ".", "Enter"):
            await seen.press(key)
        chosen = 'document.getElementById("chosen").innerText'

        async def shows(*lines: str) -> None:
            await seen.until(f"{chosen} === {json.dumps(chr(10).join(lines))}")

        await shows("palm 0: raw 0, or not received", "wrist 0: raw 0 (−240)")
        # In the plot, too, only one of them is pressed.
        await seen.run('document.getElementById("strip").focus()')
        await seen.press("ArrowLeft")
        await shows("palm 0: –", "wrist 0: −240 units")


@pytest.mark.parametrize("width", [1280, 400])
async def test_the_words_at_the_scale_of_raw_values_stand_apart(
    mosquitto: Mosquitto, tmp_path: Path, width: int
) -> None:
    async with served(mosquitto, tmp_path / "p", RAW_SERVER, width) as seen:
        await seen.run("setInterval(() => { bytes(0, 230, 1); bytes(1, 239, 1); }, 50)")
        await seen.click_on('document.getElementById("show-raw")')
        await seen.until(f'{TICKS}[0] === "raw = no-load"')
        boxes = await seen.run("""[...document.querySelectorAll("#ticks span")]
            .map(tick => tick.getBoundingClientRect()).map(box => [box.left, box.right])""")
        assert len(boxes) > 2
        assert all(one[1] < other[0] for one, other in pairwise(boxes)), boxes


async def test_the_words_at_many_contacts_stand_apart_and_the_selected_one_has_its_own(
    mosquitto: Mosquitto, tmp_path: Path
) -> None:
    async with served(mosquitto, tmp_path / "p") as seen:
        await seen.run("""setInterval(() => {
            pressed(0, 0);
            contacts("palm", "ON", null, Array.from({ length: 12 }, (_, i) => ({
                id: i + 1, taxels: [0], centroid_m: null, force_n: 1.5, peak_kpa: 3,
                area_mm2: 20, partial: false, beyond: false, verdict: null,
            })));
        }, 50)""")
        words = "window.labels.filter(([text]) => text.startsWith('#'))"
        labels = await seen.until(f"({words}.length > 1 && {words})")
        for i, (_, x, y, wide) in enumerate(labels):
            for _, other_x, other_y, other_wide in labels[:i]:
                apart = x > other_x + other_wide or other_x > x + wide or abs(y - other_y) >= 18
                assert apart, labels
        assert "#12  1.50 N" not in [text for text, *_ in labels]
        await seen.click_on('document.querySelectorAll("#contacts tbody tr")[11]')
        await seen.until(f"{words}[0]?.[0] === '#12  1.50 N'")


#: A part that publishes touches alone, with a pad that measures temperature, and one with frames.
THINNED = (
    PARTS
    + """
    const two = { pads: ["pressure", "thermal"], position_m: [[0, 0, 0], [0.01, 0, 0]],
                  normal: [[0, 0, 1], [0, 0, 1]], radius_mm: [2, 2], area_mm2: [20, 0],
                  frames: false, thinned: true };
    window.layOut = (version, parts) => say("layout", { version, robot: "r", nodes: {}, parts });
    window.palm = [part("palm", two)];
    window.wrist = [part("wrist", { thinned: true })];
    connect();
    return true;
})()"""
)


async def test_pads_that_feel_no_pressure_are_no_taxels_and_frames_left_out_are_not_missed(
    mosquitto: Mosquitto, tmp_path: Path
) -> None:
    async with served(mosquitto, tmp_path / "p", THINNED) as seen:
        await seen.run("""layOut(11, palm); say("contacts", {
            part: "palm", state: "OFF", why: null, contacts: [] }); say("health", {
            part: "palm", age_s: 0, state: "ok", sentences: [], rate_hz: 20, taxels: 1,
            valid_taxels: 1, triangles: [] })""")
        await seen.until('document.getElementById("status").textContent === "live, 1 taxel"')
        await seen.run("layOut(12, wrist)")
        await seen.until(f"/0 lost or left out, \\? of 1 taxels/.test({HEALTH})")


async def test_what_is_at_the_cursor_stands_beside_it_under_a_banner(
    mosquitto: Mosquitto, tmp_path: Path
) -> None:
    async with served(mosquitto, tmp_path / "p", RAW_SERVER, 400) as seen:
        await seen.run("setInterval(() => { bytes(0, 230, 1); bytes(1, 230, 1); }, 50)")
        await seen.press(".")
        # How far below the name of its part it stands, on the map.
        below = """document.getElementById("tip").hidden ? null
            : document.getElementById("tip").getBoundingClientRect().top
                - document.getElementById("map").getBoundingClientRect().top
                - window.labels.find(([text]) => text.startsWith("palm"))[2]"""

        async def drawn() -> None:
            """A slow browser draws the map some more times before all have their places."""
            draws = await seen.run("Number(document.body.dataset.draws)")
            await seen.until(f"Number(document.body.dataset.draws) > {draws} + 2")

        await seen.until(f"{below} !== null")
        await drawn()
        before = await seen.until(below)
        # The connection is lost: the banner stands above the map.
        await seen.run("lose()")
        high = await seen.until('document.getElementById("banner").offsetHeight')
        assert high > 30
        await drawn()
        await seen.until(f"Math.abs({below} - {before}) < {high / 2}")


async def test_what_is_old_when_the_page_opens_is_not_shown_as_present(
    mosquitto: Mosquitto, tmp_path: Path
) -> None:
    async with served(mosquitto, tmp_path / "p") as seen:
        # In the first picture that is drawn of it.
        palm, wrist, tip = await seen.run("""(() => {
            pressed(0, 3000); health('palm', 3000); health('tip', 3000);
            pressed(1, 0); health('wrist', 0);
            for (const one of ['palm', 'wrist', 'tip']) contacts(one, 'OFF');
            return new Promise(done => requestAnimationFrame(() => setTimeout(() => done(
                ['palm', 'wrist', 'tip'].map(part => document.querySelector(
                    `#health article[data-part="${part}"]`).innerText),
            ))));
        })()""")
        assert re.search("No frame for 300[0-9] s", palm)
        assert "? of 1 taxels valid" in palm
        assert "1 of 1 taxels valid" in wrist
        assert re.search("Nothing for 300[0-9] s", tip)
        assert "– of force and torque" in tip
        old = "Not known of palm, tip: nothing comes any more. Nothing touches wrist."
        await seen.run("setInterval(() => { pressed(1, 0); health('wrist', 0); }, 50)")
        await seen.until(f"{TOUCHING} === {json.dumps(old)}")
        labels = await seen.run("window.labels.map(([text]) => text)")
        assert any(re.fullmatch("palm: stale, 300[0-9] s", one) for one in labels)
        # The same frame again, as after a new connection, is as old as it was.
        await seen.run("pressed(0, 3001)")
        await seen.until(f"/No frame for 30[0-9][0-9] s/.test({HEALTH})")


async def test_a_part_without_health_is_not_called_well(
    mosquitto: Mosquitto, tmp_path: Path
) -> None:
    """Its frames come; its health does not: a broker's rules or its packet limit may keep it."""
    async with untouched(mosquitto, tmp_path / "p") as seen:
        await seen.run("health('palm', 6)")
        await seen.until(f"/No health for [67] s/.test({HEALTH})")
        palm, wrist, tip = await seen.run(
            """['palm', 'wrist', 'tip'].map(part => document.querySelector(
                `#health article[data-part="${part}"]`)).map(one => [
                    one.dataset.level, one.querySelector("h3").innerText.split("\\n").at(-1),
                    one.querySelector("ul").innerText])"""
        )
        assert palm[:2] == ["warn", "no health"]
        assert wrist == ["warn", "no health", "No health has come yet."]
        assert tip == ["ok", "ok", ""]
        levels = '[...document.querySelectorAll("#parts [data-part]")].map(b => b.dataset.level)'
        assert await seen.run(levels) == ["", "warn", "warn", "ok"]
        await seen.run("health('palm', 0)")
        assert await seen.until(f"({levels})[1] === 'ok'")


async def test_what_the_broker_had_stored_shows_no_part_as_well(
    mosquitto: Mosquitto, tmp_path: Path
) -> None:
    """A robot that was switched off has left its last health there."""
    async with served(mosquitto, tmp_path / "p") as seen:
        await seen.run("health('tip', null); health('palm', null); pressed(0, 0)")
        states = """JSON.stringify(['palm', 'tip'].map(part => document.querySelector(
            `#health article[data-part="${part}"] h3`)?.innerText.split("\\n").at(-1)))"""
        await seen.until(f"""{states} === '["no health","no data"]'""")
        assert "No health has come yet" in await seen.run(HEALTH)
        await seen.run("health('tip', 0); health('palm', 0); pressed(0, 0)")
        await seen.until(f"""{states} === '["ok","ok"]'""")


async def test_an_age_is_never_below_zero(mosquitto: Mosquitto, tmp_path: Path) -> None:
    """What comes while a picture is drawn is newer than the picture."""
    async with untouched(mosquitto, tmp_path / "p") as seen:
        await seen.run("contacts('palm', 'UNKNOWN', 'stale'); pressed(0, -0.3)")
        labels = "window.labels.map(([text]) => text).find(text => text.startsWith('palm: stale'))"
        assert await seen.until(labels) == "palm: stale, 0 s"


async def test_the_skin_can_be_calibrated_from_the_page(robot: Stack, tmp_path: Path) -> None:
    start(robot)
    async with page(robot, tmp_path / "profile") as seen:
        await seen.until(LIVE)
        # The daemon calibrates at its start, and takes one calibration at a time.
        await seen.until("!document.getElementById('calibrate').disabled")
        # The part that is chosen alone, whose name stands above the question and in the answer.
        await seen.press("1")
        await seen.press("c")
        await seen.until('document.getElementById("confirm").open')
        title = await seen.run('document.getElementById("confirm-title").textContent')
        assert title == "Calibrate left_hand?"
        await seen.click_on('document.querySelector("#confirm button.do")')
        done = "/^Calibrated. left_hand: [^;]*$|^Touched .* [0-9]+ taxels? of left_hand[.]/"
        await seen.until(f'{done}.test(document.getElementById("banner").textContent)')
        # And the whole skin.
        await seen.press("0")
        await seen.click_on('document.getElementById("calibrate")')
        await seen.until('document.getElementById("confirm").open')
        title = await seen.run('document.getElementById("confirm-title").textContent')
        assert title == "Calibrate the whole skin?"
        await seen.click_on('document.querySelector("#confirm button.do")')
        # The scene presses on meanwhile, which is told.
        done = "/^Calibrated. .*left_forearm|^Touched while it was calibrated: /"
        await seen.until(f'{done}.test(document.getElementById("banner").textContent)')


RECORD = 'document.getElementById("record").textContent'
BANNER = 'document.getElementById("banner").textContent'


async def centre(seen: Page, selector: str) -> tuple[float, float]:
    left, top, width, height = await seen.box(selector)
    return left + width / 2, top + height / 2


@pytest.mark.parametrize("by", ["mouse", "touch", "keyboard"])
async def test_a_recording_is_begun_marked_and_ended_from_the_page(
    robot: Stack, tmp_path: Path, by: str
) -> None:
    start(robot)
    async with page(robot, tmp_path / "profile", width=400 if by == "touch" else 1280) as seen:
        await seen.until(LIVE)
        await seen.call("Emulation.setTouchEmulationEnabled", enabled=by == "touch")

        async def use(button: str, key: str) -> None:
            if by == "keyboard":
                await seen.press(key)
            elif by == "touch":
                await seen.touch(await centre(seen, f"#{button}"))
            else:
                await seen.click(*await centre(seen, f"#{button}"))

        await use("record", "o")
        await seen.until(f"/^stop 0:0[1-9]/.test({RECORD})")
        await use("mark", "m")
        await seen.until('document.getElementById("note").open')
        await seen.call("Input.insertText", text="a knock, <b>bold</b>")
        await seen.press("Enter")
        await seen.until(f"{BANNER} === 'Mark 1'")
        await use("record", "o")
        told = f"/^Recorded [0-9]+ messages, 1 of them marks: .*/.exec({BANNER})?.[0]"
        name = (await seen.until(told)).rpartition("/")[2]
        await seen.until(f"{RECORD} === 'record'")
    recorded = list(read_messages_of(tmp_path / "recordings" / name))
    assert any(message.topic == "skin/demo/left_hand/frame" for message in recorded)


#: Where the chosen taxel is on the map, by the ring around it.
POSE = """(() => {
    const ring = [...window.rings].at(-1);
    return ring && ring.map(Math.round).join();
})()"""
WATCH_RINGS = """
    window.rings = [];
    const arc = CanvasRenderingContext2D.prototype.arc;
    CanvasRenderingContext2D.prototype.arc = function (x, y, ...all) {
        if (this.canvas.id === "map") window.rings = [...window.rings.slice(-9), [x, y]];
        arc.call(this, x, y, ...all);
    };
"""


@pytest.mark.parametrize("by", ["mouse", "touch", "keyboard"])
async def test_a_curved_part_turns_beside_others(robot: Stack, tmp_path: Path, by: str) -> None:
    start(robot)
    async with page(robot, tmp_path / "profile", watch=WATCH_RINGS) as seen:
        await seen.call("Emulation.setTouchEmulationEnabled", enabled=by == "touch")
        await seen.until(f"{LIVE} && document.getElementById('body') !== null")
        # The cursor is on a taxel of the forearm, which is drawn beside the hand.
        await seen.run('document.getElementById("map").focus()')
        await seen.press(",")
        await seen.until("/^left_forearm/.test(document.getElementById('tip').textContent)")
        # A banner makes the map smaller.
        before = await seen.until(f"document.getElementById('banner').hidden && {POSE}")
        left, top, width, height = await seen.box("#map")
        places = [(left + share * width, top + 0.5 * height) for share in (0.7, 0.75, 0.8)]
        if by == "touch":
            await seen.touch(*places)
        elif by == "mouse":
            await seen.drag(*places)
        else:
            arrow = {"key": "ArrowRight", "modifiers": 8}
            await seen.call("Input.dispatchKeyEvent", type="keyDown", **arrow)
            await seen.call("Input.dispatchKeyEvent", type="keyUp", **arrow)
        await seen.call("Input.dispatchMouseEvent", type="mouseMoved", x=1, y=1)
        await seen.press("Escape")
        await seen.press(",")
        await seen.until("/^left_forearm/.test(document.getElementById('tip').textContent)")
        await seen.until(f"{POSE} !== '{before}'")
        # What fits again is as it was at first.
        await seen.press("f")
        await seen.until(f"{POSE} === '{before}'")


async def test_skin_in_front_hides_what_is_behind_it(robot: Stack, tmp_path: Path) -> None:
    start(robot)
    async with page(robot, tmp_path / "profile") as seen:
        await seen.until(f"{LIVE} && document.getElementById('body') !== null")
        await seen.press("2")
        # From behind, of the same skin, no taxel can be seen or chosen.
        for _ in range(33):  # of 12 px, 0.008 rad each: half a turn
            arrow = {"key": "ArrowUp", "modifiers": 8}
            await seen.call("Input.dispatchKeyEvent", type="keyDown", **arrow)
        await seen.until(f"{DRAWN} > 20_000")
        left, top, width, height = await seen.box("#map")
        for share in (0.3, 0.4, 0.5, 0.6, 0.7):
            await seen.click(left + share * width, top + height / 2)
        assert await seen.run('document.querySelectorAll("#chosen button").length') == 0


async def test_without_three_js_curved_parts_are_drawn_flat_and_it_says_so(
    robot: Stack, tmp_path: Path
) -> None:
    start(robot)
    no_webgl = "HTMLCanvasElement.prototype.getContext = (get => function (kind, ...all) {"
    no_webgl += "return /webgl/.test(kind) ? null : get.call(this, kind, ...all);"
    no_webgl += "})(HTMLCanvasElement.prototype.getContext);"
    async with page(robot, tmp_path / "profile", watch=no_webgl) as seen:
        await seen.until(f"{LIVE} && !document.getElementById('flattened').hidden")
        assert await seen.run('document.getElementById("body")') is None
        assert await seen.run(DRAWN) > 20_000


async def test_what_is_touched_is_44_pixels_large(robot: Stack, tmp_path: Path) -> None:
    start(robot)
    async with page(robot, tmp_path / "profile", width=400) as seen:
        await seen.until(LIVE)
        await choose_two(seen)
        for width in (400, 1280):
            await seen.resize(width, 800)
            await seen.call("Emulation.setTouchEmulationEnabled", enabled=True)
            small = """[...document.querySelectorAll("button, select, summary, tbody tr")]
                .filter(one => one.checkVisibility())
                .map(one => [one.id || one.textContent, one.getBoundingClientRect()])
                .filter(([, box]) => box.width < 44 || box.height < 44).map(([name]) => name)"""
            await seen.until(f"({CONTACTS}).length")
            assert await seen.run(small) == []


async def test_a_phone_shows_everything_without_scrolling_sideways(
    robot: Stack, tmp_path: Path
) -> None:
    start(robot)
    async with page(robot, tmp_path / "profile", width=400) as seen:
        await seen.until(LIVE)
        assert await seen.run("document.documentElement.scrollWidth") == 400
        assert await seen.run(DRAWN) > 8_000


async def test_a_name_that_is_wider_than_the_map_makes_no_skin_small(
    mosquitto: Mosquitto, tmp_path: Path
) -> None:
    async with served(mosquitto, tmp_path / "p", MANY_PARTS, 400) as seen:
        drawn = await seen.run(DRAWN)
        name = "`right_upper_part_${k}`"
        assert await seen.run(MANY_PARTS.replace(name, f"k ? {name} : 'w'.repeat(64)"))
        assert await seen.run(DRAWN) > 0.8 * drawn


@pytest.mark.parametrize("width", [1280, 400])
async def test_a_whole_robot_is_one_line_that_opens_and_its_labels_keep_apart(
    mosquitto: Mosquitto, tmp_path: Path, width: int
) -> None:
    async with served(mosquitto, tmp_path / "p", MANY_PARTS, width) as seen:
        text = await seen.run('document.getElementById("health").innerText')
        assert text.startswith("13 parts: not calibrated")
        assert "right_upper_part_3 says so" not in text
        said = await seen.run('document.getElementById("shared").innerText')
        assert said == "Not calibrated: leave it untouched. (13 parts)"
        await seen.click_on('document.querySelector("#health summary")')
        await seen.until('document.getElementById("health").innerText.includes("part_3 says so")')
        labels = await seen.run("window.labels")
        assert len(labels) == 13
        for i, (_, x, y, wide) in enumerate(labels):
            for _, other_x, other_y, other_wide in labels[:i]:
                apart = abs(x - other_x) >= (wide + other_wide) / 2 or abs(y - other_y) >= 15
                assert apart
        assert await seen.run("document.documentElement.scrollWidth") == width
        # One part needs no more height than the window has.
        await seen.click_on('document.querySelectorAll("#parts button")[1]')
        await seen.until('document.getElementById("stage").offsetHeight < innerHeight')


@pytest.mark.skipif(not SAMPLES.exists(), reason=f"{SAMPLES} is not here")
async def test_the_imported_arm_of_an_icub_is_drawn(robot: Stack, tmp_path: Path) -> None:
    arm, findings = robot.config, Findings()
    demo = load(arm)
    for source, sample in {
        "skinspec": "icub_genova11_left_arm_skinSpec.xml",
        "skingui": "icub_left_forearm_V2_gui.ini",
        "positions": "icub_left_forearm_V2_positions.txt",
    }.items():
        known = None if source == "skinspec" else arm
        import_files(source, [SAMPLES / sample], arm, findings, config=known)  # type: ignore[arg-type]
    settings = load(arm)
    settings = changed(
        settings,
        {
            "robot": demo.robot,
            "buses": dict.fromkeys(settings.buses, robot.bus),
            "mqtt": demo.mqtt,
            "service": demo.service,
        },
    )
    arm.write_text(configuration_text(settings))
    robot.start("run", str(arm), "--calibrate")
    async with page(robot, tmp_path / "profile") as seen:
        await seen.until(LIVE)
        parts = await seen.run(
            '[...document.querySelectorAll("#parts span")].map(part => part.textContent)'
        )
        assert parts == ["all", "left_arm", "left_forearm"]
        assert await seen.run(DRAWN) > 20_000
        for part in (1, 2):  # each alone: the tiled one, and the one that is curved in space
            await seen.click_on(f'document.querySelectorAll("#parts button")[{part}]')
            await seen.until(f"{DRAWN} > 20_000")
