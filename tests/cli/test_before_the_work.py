"""What cannot be written at the end is refused before the work, which may take minutes."""

import errno
import sys
from pathlib import Path

import pytest

from skin_host.cli import main
from skin_host.errors import RequestError, SkinError
from skin_host.files import Draft, check_output, write_together

ROOT = Path(__file__).parents[2]
DEMO = str(ROOT / "config/demo.toml")


@pytest.fixture
def log(tmp_path: Path) -> str:
    """A recording whose damage is found by whoever reads it."""
    path = tmp_path / "a.log"
    path.write_text("damage\n")
    return str(path)


@pytest.mark.parametrize(
    ("command", "output", "why"),
    [
        (["export", "LOG", "OUTPUT", "--config", DEMO], "a.docx", "wanted a name that ends in"),
        (["export", "LOG", "OUTPUT", "--config", DEMO], "folder.npz", "it is a folder"),
        (["export", "LOG", "OUTPUT", "--config", DEMO], "file", "is a file; wanted a folder"),
        (["export", "LOG", "OUTPUT", "--config", DEMO], "file/a.npz", "Not a directory"),
        (
            ["export", "LOG", "OUTPUT", "--lerobot", "--config", DEMO],
            "a.npz",
            "a data set of LeRobot is a folder",
        ),
        (["plot", "pressure", "LOG", "OUTPUT", "--config", DEMO], "a.docx", "wanted a name that"),
        (["plot", "map", "LOG", "OUTPUT", "--config", DEMO], "folder.png", "it is a folder"),
        (["replay", "LOG", "--config", DEMO, "--output", "OUTPUT"], "folder", "it is a folder"),
        (["report", "--quick", "--output", "OUTPUT"], "file", "is a file; wanted a folder"),
        (["report", "--rig", "--output", "OUTPUT"], "file/a", "Not a directory"),
        (["calibrate", DEMO, "--output", "OUTPUT"], "folder", "it is a folder"),
        (
            ["calibrate", DEMO, "--relaxation", "LOG", "--output", "OUTPUT"],
            "folder",
            "it is a folder",
        ),
        (["emulate", DEMO, "--interface", "virtual", "--state", "OUTPUT"], "folder", "a folder"),
    ],
)
def test_a_wrong_output_is_refused_before_anything_is_read(
    command: list[str],
    output: str,
    why: str,
    log: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    for folder in ("folder", "folder.npz", "folder.png"):
        (tmp_path / folder).mkdir()
    (tmp_path / "file").write_text("kept")
    named = {"LOG": log, "OUTPUT": str(tmp_path / output)}

    status = main([named.get(word, word) for word in command])

    told = capsys.readouterr()
    line = told.err.splitlines()[-1]
    assert f"{tmp_path / output}: " in line
    assert why in line
    assert status == (1 if why == "Not a directory" else 2)
    assert "damage" not in told.err
    assert (tmp_path / "file").read_text() == "kept"


@pytest.mark.parametrize(
    ("command", "package"),
    [
        (["export", "LOG", "a.parquet", "--config", DEMO], "pyarrow"),
        (["export", "LOG", "a", "--lerobot", "--config", DEMO], "pyarrow"),
        (["export", "LOG", "a.rrd", "--config", DEMO], "rerun"),
        (["export", "LOG", "a.mcap", "--config", DEMO], "mcap_protobuf"),
        (["plot", "pressure", "LOG", "a.png", "--config", DEMO], "matplotlib"),
    ],
)
def test_a_package_that_is_not_installed_is_asked_for_before_anything_is_read(
    command: list[str],
    package: str,
    log: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setitem(sys.modules, package, None)
    assert main([log if word == "LOG" else word for word in command]) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert f"need the package {package}, which is not installed; mend it with: pip" in line


@pytest.mark.parametrize("recording", [[], ["--pressure", "LOG", "--levels", "3"]])
def test_where_no_calibration_can_be_kept_none_is_taken(
    tmp_path: Path, log: str, capsys: pytest.CaptureFixture[str], recording: list[str]
) -> None:
    """It would zero the boards, which a daemon of another state directory may use."""
    (tmp_path / "state").write_text("a file where a folder is wanted")
    config = tmp_path / "robot.toml"
    service = f'[service]\nstate_directory = "{tmp_path / "state"}"\n'
    config.write_text(Path(DEMO).read_text() + service)
    words = [log if word == "LOG" else word for word in recording]
    assert main(["calibrate", str(config), *words]) == 1
    path = tmp_path / "state/demo-main.calibration.json"
    line = f"skin calibrate: {path}: cannot be written: Not a directory"
    assert capsys.readouterr().err.splitlines()[-1] == line


def test_what_can_be_written_is_not_touched_by_the_check(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("kept")
    (tmp_path / "link").symlink_to(tmp_path / "elsewhere" / "file")
    before = sorted(tmp_path.iterdir())
    for name in ("file", "new", "a/b/new", "link"):
        check_output(tmp_path / name)
    for name in (".", "new", "a/b/new"):
        check_output(tmp_path / name, folder=True)
    check_output(Path("/dev/stdout"))
    check_output(Path("/dev/null"))
    assert sorted(tmp_path.iterdir()) == before
    assert (tmp_path / "file").read_text() == "kept"


@pytest.mark.parametrize("place", ["/proc", "/proc/new", "/sys"])
@pytest.mark.parametrize("folder", [False, True])
def test_a_place_where_nothing_can_be_written_is_refused(place: str, folder: bool) -> None:
    """Whoever is root may write there by its permissions."""
    output = Path(place) if folder else Path(place, "new")
    with pytest.raises(SkinError, match=f"^{output}: cannot be written: ") as refused:
        check_output(output, folder=folder)
    assert not isinstance(refused.value, RequestError)


@pytest.mark.parametrize("there", [False, True])
def test_files_that_cannot_be_written_leave_no_folder(
    there: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "there").mkdir()
    folder = tmp_path / "there" if there else tmp_path / "a" / "b"
    tables = [(folder / f"{name}.csv", b"") for name in ("hand", "arm", "touches")]
    write_together(tables[:1] if there else [])

    def fill(draft: Draft) -> None:
        if "touches" in draft.path.name:
            raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(Draft, "sync", fill)
    with pytest.raises(SkinError, match=r"touches.csv: cannot be written: No space left"):
        write_together(tables)
    left = [path.name for path in sorted(tmp_path.rglob("*"))]
    assert left == ["there", *(["hand.csv"] if there else [])]
