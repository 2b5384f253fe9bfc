"""What a user names as an output: a device, a pipe or a link stays what it is, and a folder is
refused by the name that the user gave.
"""

import os
import socket
import stat
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from skin_host.bus.wire import FrameBatch
from skin_host.cli import main
from skin_host.demo import configuration
from skin_host.errors import RequestError, SkinError
from skin_host.files import becomes_file, whole_file, write_atomic, write_document
from skin_host.recording.capture import CanLog
from tests.support.broker import Mosquitto
from tests.support.world import World

DEMO = str(configuration("demo.toml"))
FRAMES = FrameBatch.of([(0x4E0, bytes(8), 1_700_000_000_000_000_000)])
SPECIFICATION = """<params robot="r"><group name="patches">
<param name="skinCanAddrsPatch1"> 9 </param></group></params>"""


#: Commands that write a file, without its name.
WRITERS = {
    "urdf": ["urdf", DEMO, "--output"],
    "dbc": ["dbc", DEMO, "--output"],
    "import": ["import", "skinspec", "arm-skinSpec.xml", "--output"],
    "replay": ["replay", "grasp.log", "--config", "robot.toml", "--output"],
}


@pytest.fixture(scope="module")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with what the commands read."""
    folder = tmp_path_factory.mktemp("inputs")
    world = World(folder, folder, Mosquitto("never started", folder))
    world.write_recordings()
    assert world.robot == folder / "robot.toml"
    (folder / "arm-skinSpec.xml").write_text(SPECIFICATION)
    return folder


def command(name: str, output: Path, inputs: Path) -> list[str]:
    words = [str(inputs / word) if (inputs / word).is_file() else word for word in WRITERS[name]]
    return [*words, str(output)]


def device(path: Path) -> Path:
    try:
        os.mknod(path, 0o666 | stat.S_IFCHR, os.makedev(1, 3))
        path.open("wb").close()
    except OSError:
        pytest.skip("this user may not make devices")
    return path


@pytest.mark.parametrize("name", WRITERS)
def test_a_device_takes_the_output_and_stays_a_device(
    name: str, tmp_path: Path, inputs: Path
) -> None:
    """`sudo skin urdf robot.toml --output /dev/null` made /dev/null a regular file."""
    null = device(tmp_path / "null")
    assert main(command(name, null, inputs)) == 0
    assert stat.S_ISCHR(null.lstat().st_mode)
    assert [file.name for file in tmp_path.iterdir()] == ["null"]


@pytest.mark.timeout(60)
@pytest.mark.parametrize("name", WRITERS)
def test_who_reads_a_pipe_receives_the_output(
    name: str, tmp_path: Path, inputs: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pipe, file = tmp_path / "pipe", tmp_path / "file"
    os.mkfifo(pipe)
    read: list[bytes] = []
    reader = threading.Thread(target=lambda: read.append(pipe.read_bytes()), daemon=True)
    reader.start()
    assert main(command(name, pipe, inputs)) == 0
    assert str(pipe) not in capsys.readouterr().out
    reader.join()
    assert main(command(name, file, inputs)) == 0
    assert read == [file.read_bytes()]
    assert stat.S_ISFIFO(pipe.lstat().st_mode)


@pytest.mark.parametrize("name", WRITERS)
def test_a_link_stays_and_its_file_is_replaced(name: str, tmp_path: Path, inputs: Path) -> None:
    folder = tmp_path / "elsewhere"
    folder.mkdir()
    target = folder / "target"
    target.write_text("old")
    before = target.stat().st_ino
    (tmp_path / "link").symlink_to("elsewhere/target")
    (tmp_path / "second").symlink_to("link")
    assert main(command(name, tmp_path / "second", inputs)) == 0
    assert (tmp_path / "second").is_symlink()
    assert (tmp_path / "link").is_symlink()
    assert target.stat().st_ino != before
    assert target.read_text() not in ("", "old")
    assert [file.name for file in folder.iterdir()] == ["target"]


@pytest.mark.parametrize("name", WRITERS)
def test_a_folder_is_refused_by_its_own_name(
    name: str, tmp_path: Path, inputs: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "folder"
    folder.mkdir()
    assert main(command(name, folder, inputs)) == 2
    (line,) = capsys.readouterr().err.splitlines()[-1:]
    assert line.endswith(f"{folder}: cannot be written: it is a folder; wanted a file")
    assert not list(folder.iterdir())
    assert not list(tmp_path.glob(".folder*"))


def test_a_link_to_a_file_that_does_not_exist_yet_makes_it(tmp_path: Path) -> None:
    (tmp_path / "link").symlink_to("new")
    write_atomic(tmp_path / "link", b"whole")
    assert (tmp_path / "link").is_symlink()
    assert (tmp_path / "new").read_bytes() == b"whole"


def test_links_in_a_circle_are_refused_by_the_users_name(tmp_path: Path) -> None:
    (tmp_path / "one").symlink_to("other")
    (tmp_path / "other").symlink_to("one")
    with pytest.raises(SkinError, match=r"one: cannot be written: Too many levels"):
        with whole_file(tmp_path / "one"):
            pass


@pytest.mark.timeout(60)
@pytest.mark.parametrize("name", ["/proc/self/fd/1", "/dev/fd/1", "link"])
def test_standard_output_is_written_to_whatever_it_is(name: str, tmp_path: Path) -> None:
    """A file behind it keeps what it holds, as with a redirection by the shell."""
    # Not /dev/stdout itself, which is such a link: a failure would replace that of the computer.
    (tmp_path / "stdout").symlink_to("/proc/self/fd/1")
    (tmp_path / "link").symlink_to("stdout")
    arguments = [sys.executable, "-m", "skin_host", "urdf", DEMO, "--output", name]
    wanted = subprocess.run(arguments[:-2], check=True, capture_output=True).stdout
    piped = subprocess.run(arguments, cwd=tmp_path, check=True, capture_output=True)
    assert piped.stdout == wanted
    with (tmp_path / "x").open("ab") as file:
        file.write(b"kept\n")
        file.flush()
        subprocess.run(arguments, cwd=tmp_path, check=True, stdout=file)
    assert (tmp_path / "x").read_bytes() == b"kept\n" + wanted
    ours, theirs = socket.socketpair()
    with ours, theirs:
        subprocess.run(arguments, cwd=tmp_path, check=True, stdout=theirs.fileno())
        theirs.close()
        assert ours.makefile("rb").read() == wanted
    assert (tmp_path / "stdout").is_symlink()


def test_a_descriptor_that_is_not_open_is_refused_in_a_line(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert main(["urdf", DEMO, "--output", "/dev/fd/987"]) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert "/dev/fd/987: cannot be written: " in line


def test_positions_files_need_a_folder_beside_a_configuration_that_is_a_file(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    null = device(tmp_path / "null")
    places = tmp_path / "palm.txt"
    places.write_text("0.1 0.1 0.1 0 0 1\n" * 192)
    assert main(["import", "positions", str(places), "--output", str(null)]) == 2
    line = capsys.readouterr().err.splitlines()[-1]
    assert f"{null}: positions files go to a folder beside it; wanted a file" in line
    assert not (tmp_path / "null-positions").exists()


def test_a_recording_of_frames_into_a_link_replaces_the_linked_file(tmp_path: Path) -> None:
    """The link's suffix chooses the format."""
    (tmp_path / "data").mkdir()
    (tmp_path / "x.log").symlink_to("data/frames")
    with CanLog(tmp_path / "x.log") as log:
        log.put("can0", FRAMES)
    assert (tmp_path / "x.log").is_symlink()
    assert (tmp_path / "data" / "frames").read_text().endswith(" can0 4E0#0000000000000000\n")
    assert [file.name for file in (tmp_path / "data").iterdir()] == ["frames"]


@pytest.mark.timeout(60)
def test_a_recording_in_a_format_with_a_head_goes_into_a_pipe(tmp_path: Path) -> None:
    """Its writer returns to the head at the end, which a pipe does not allow."""
    pipe = tmp_path / "x.blf"
    os.mkfifo(pipe)
    read: list[bytes] = []
    reader = threading.Thread(target=lambda: read.append(pipe.read_bytes()), daemon=True)
    reader.start()
    with CanLog(pipe) as log:
        log.put("can0", FRAMES)
    assert stat.S_ISFIFO(pipe.lstat().st_mode)
    reader.join()
    assert read[0].startswith(b"LOGG")


def test_a_recording_of_frames_into_a_folder_is_refused_before_it_begins(tmp_path: Path) -> None:
    (tmp_path / "x.log").mkdir()
    with pytest.raises(RequestError, match=r"x\.log: cannot be written: it is a folder"):
        CanLog(tmp_path / "x.log")


def test_a_link_that_another_user_laid_in_a_folder_of_all_is_not_followed(tmp_path: Path) -> None:
    if os.geteuid() != 0:
        pytest.skip("only root may give a link to another user")
    victim, shared = tmp_path / "victim", tmp_path / "shared"
    victim.write_text("mine")
    shared.mkdir()
    shared.chmod(0o1777)
    (shared / "x").symlink_to(victim)
    os.chown(shared / "x", 12345, 12345, follow_symlinks=False)
    with pytest.raises(PermissionError, match="a link of another user") as refused:
        write_atomic(shared / "x", b"theirs")
    assert refused.value.filename == str(shared / "x")
    assert victim.read_text() == "mine"
    os.chown(shared / "x", 0, 0, follow_symlinks=False)
    write_atomic(shared / "x", b"by my own link")
    assert victim.read_text() == "by my own link"


@pytest.mark.timeout(60)
def test_what_the_daemon_keeps_neither_follows_a_link_nor_waits_for_a_pipe(tmp_path: Path) -> None:
    """Others may be able to write to the state directory."""
    victim = tmp_path / "victim"
    victim.write_text("mine")
    for name in ("link", "pipe"):
        path = tmp_path / name
        if name == "link":
            path.symlink_to(victim)
        else:
            os.mkfifo(path)
        write_document(path, {"a": 1})
        assert stat.S_ISREG(path.lstat().st_mode)
    assert victim.read_text() == "mine"
    (tmp_path / "folder").mkdir()
    with pytest.raises(OSError, match="Is a directory") as refused:
        write_document(tmp_path / "folder", {"a": 1})
    assert refused.value.filename == str(tmp_path / "folder")


def test_what_becomes_a_file_is_known_beforehand(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    (tmp_path / "link").symlink_to("file")
    os.mkfifo(tmp_path / "pipe")
    assert becomes_file(tmp_path / "file")
    assert becomes_file(tmp_path / "link")
    assert becomes_file(tmp_path / "new")
    assert not becomes_file(tmp_path / "pipe")
    assert not becomes_file(Path("/dev/null"))
    assert not becomes_file(Path("/dev/stdout"))


@pytest.mark.timeout(60)
def test_a_failed_output_leaves_a_pipes_reader_without_half_of_it(tmp_path: Path) -> None:
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    with pytest.raises(ZeroDivisionError), whole_file(pipe) as growing:
        growing.write_text("half")
        raise ZeroDivisionError
    assert stat.S_ISFIFO(pipe.lstat().st_mode)
    assert not growing.exists()
