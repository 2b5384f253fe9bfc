"""An option that would have no effect is refused, whatever the command."""

import argparse
from collections.abc import Iterator
from pathlib import Path

import pytest

from skin_host.cli import build_parser, main, options
from skin_host.errors import RequestError

DEMO = str(Path(__file__).parents[2] / "config" / "demo.toml")

#: The least that each command takes.
LEAST = {
    "run": ["c.toml"],
    "command": ["status"],
    "calibrate": ["c.toml"],
    "check": ["c.toml"],
    "replay": ["a.log"],
    "import": ["positions", "a.txt", "--output", "c.toml"],
    "record": ["a.mcap"],
    "export": ["a.mcap", "a.npz"],
    "plot": ["pressure", "a.mcap", "a.png"],
    "urdf": ["c.toml"],
    "emulate": ["c.toml"],
    "bench": ["receive"],
    "completion": ["bash"],
}


def commands() -> Iterator[str]:
    for action in build_parser()._actions:
        if isinstance(action, argparse._SubParsersAction):
            yield from action.choices


@pytest.mark.parametrize(
    ("words", "line"),
    [
        ("calibrate c.toml --load a.csv", "--load needs --pressure or --relaxation"),
        ("calibrate c.toml --levels 3 9", "--levels needs --pressure"),
        ("calibrate c.toml --weight-kpa 3", "--weight-kpa needs --relaxation"),
        ("calibrate c.toml --model published", "--model needs --relaxation"),
        (
            "calibrate c.toml --relaxation a.log --load a.csv --weight-kpa 3",
            "--weight-kpa has no effect with --load",
        ),
        ("calibrate c.toml --relaxation a.log --levels 3", "--levels needs --pressure"),
        (
            "calibrate c.toml --relaxation a.log --strict",
            "--strict has no effect with --relaxation",
        ),
        ("calibrate c.toml --relaxation a.log --node a", "--node has no effect with --relaxation"),
        ("plot pressure a.mcap a.png --at 3", "--at needs map"),
        ("plot map a.mcap a.png --taxels 3", "--taxels needs pressure"),
        (
            "plot calibration a.json a.png --config c.toml --part a",
            "--part has no effect with calibration",
        ),
        (
            "plot calibration a.json a.png --config c.toml --calibration b.json",
            "--calibration has no effect with calibration",
        ),
        ("plot map a.mcap a.png --calibration b.json", "--calibration needs --config"),
        ("export a.mcap a.npz --calibrate-seconds 3", "--calibrate-seconds needs --config"),
        ("replay a.log --config c.toml --speed 2", "--speed needs --onto"),
        (
            "replay a.log --config c.toml --broker mqtt://elsewhere",
            "--broker needs --onto broker",
        ),
        (
            "replay a.log --config c.toml --onto can --robot a",
            "--robot needs --onto broker",
        ),
        (
            "replay a.log --config c.toml --onto can --output a",
            "--output has no effect with --onto",
        ),
        (
            "replay a.log --config c.toml --onto can --calibration a.json",
            "--calibration has no effect with --onto can",
        ),
        ("replay a.mcap --onto broker --calibration a.json", "--calibration needs --config"),
        ("record a.mcap --config c.toml --robot a", "--robot needs --broker or no --config"),
        ("check c.toml --running a.json --json", "--json has no effect with --running"),
        ("import skingui a.ini --output c.toml --part a", "--part needs positions"),
        ("dbc --bus can0", "--bus needs CONFIG"),
        ("view --rerun --read-only", "--read-only has no effect with --rerun"),
        ("view --foxglove --name a", "--name has no effect with --foxglove"),
        ("emulate c.toml --board a", "--board needs --i2c or --i2c-dev"),
        ("emulate c.toml --i2c /dev/i2c-1", "--i2c needs --board"),
        (
            "emulate c.toml --board a --i2c /dev/i2c-1 --speed 2",
            "--speed has no effect with --i2c",
        ),
        ("emulate c.toml --mujoco a.xml --state a", "--state has no effect with --mujoco"),
        ("bench receive --robots 3", "--robots needs fleet"),
        ("report --rig --recordings a", "--recordings has no effect with --rig"),
        ("simulate --seeds 3 --until 5", "--until has no effect with --seeds"),
        ("command status --part a", "--part needs calibrate, disable or enable"),
        ("command status --strict", "--strict needs calibrate"),
        ("command reload --reset", "--reset needs thresholds"),
        ("command disable", "disable needs --part"),
        ("command calibrate --part a --board b", "--board has no effect with --part"),
    ],
)
def test_an_option_without_effect_is_refused_with_what_it_needs(
    words: str, line: str, capsys: pytest.CaptureFixture[str]
) -> None:
    command, *rest = words.split()
    assert main([command, *rest]) == 2
    shown = capsys.readouterr()
    assert shown.err == f"skin {command}: {line}\n"
    assert shown.out == ""


def test_a_refused_calibration_has_looked_at_no_skin(tmp_path: Path) -> None:
    kept = tmp_path / "kept.json"
    load = str(tmp_path / "load.csv")
    assert main(["calibrate", DEMO, "--load", load, "--output", str(kept)]) == 2
    assert not kept.exists()


def test_a_robot_that_continues_reports_that_its_scene_is_its_own(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level("INFO")
    state = tmp_path / "robot.state"
    words = ["emulate", DEMO, "--state", str(state), "--seed", "3", "--duration", "0.1"]
    line = f"{state}: continues with the scene, seed and fidelity with which it began"
    for number in (0, 1):
        assert main(words) == 0
        assert caplog.messages.count(line) == number


@pytest.mark.parametrize(
    "words",
    [
        ["calibrate", "INPUT"],
        ["calibrate", DEMO, "--relaxation", "INPUT"],
        ["calibrate", DEMO, "--pressure", "INPUT", "--levels", "9"],
        ["calibrate", DEMO, "--pressure", "a.log", "--load", "INPUT"],
        ["import", "skinspec", "INPUT"],
        ["dbc", "INPUT"],
        ["replay", "INPUT", "--config", DEMO],
    ],
)
def test_no_command_writes_over_what_it_reads(
    words: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "input"
    path.write_bytes(Path(DEMO).read_bytes())
    words = [str(path) if word == "INPUT" else word for word in words]
    assert main([*words, "--output", str(path)]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line == f"skin {words[0]}: {path}: is read by this command; choose another name"
    assert path.read_bytes() == Path(DEMO).read_bytes()


@pytest.mark.parametrize("name", list(commands()))
def test_what_was_not_typed_is_never_refused(name: str) -> None:
    parser = build_parser()
    arguments = parser.read([name, *LEAST.get(name, [])])
    options.check(parser.command(name), arguments)


@pytest.mark.parametrize("name", list(commands()))
def test_every_word_of_a_table_is_one_of_its_command(name: str) -> None:
    parser = build_parser()
    arguments = parser.read([name, *LEAST.get(name, [])])
    for table in (getattr(arguments, "needs", {}), getattr(arguments, "idle_with", {})):
        for key, others in table.items():
            for word in (key, *others):
                options.holds(parser.command(name), arguments, word)


def test_a_word_that_no_argument_has_is_a_mistake_of_the_table() -> None:
    parser = argparse.ArgumentParser()
    options.add_rules(parser, needs={"--gone": ["--either"]})
    with pytest.raises(KeyError):
        options.check(parser, parser.parse_args([]))


def test_a_value_that_equals_the_default_was_typed_nevertheless() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--speed", type=float, default=1.0)
    parser.add_argument("--onto")
    options.add_rules(parser, needs={"--speed": ["--onto"]})
    with pytest.raises(RequestError, match="--speed needs --onto"):
        options.check(parser, parser.parse_args(["--speed", "1.0"]))
    options.check(parser, parser.parse_args([]))
