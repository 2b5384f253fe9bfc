"""What all tests share: which CAN bus they run on, and a real broker."""

import itertools
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing
from pathlib import Path

import hypothesis
import pytest

from skin_host.config.settings import Bus
from tests.support import programs
from tests.support.branch import branch
from tests.support.broker import Mosquitto
from tests.support.fault_bench import FaultBench
from tests.support.stack import configuration, stack, subscriber  # noqa: F401  (fixtures for all)
from tests.support.vcan import Vcan
from tests.support.watchdog import watchdog  # noqa: F401  (fixture for all)

_numbers = itertools.count()

#: Fixtures that start a broker: for one test, and for all pages of the documentation.
BROKERS = {"mosquitto", "world"}
#: Files that take longest, by the clock or by the processor.
LONGEST_FIRST = (
    "tests/evaluation/simulate/test_simulate.py",
    "tests/processing/test_long_contact.py",
    "tests/attacks/test_hostile_bus.py",
    "tests/cli/test_running_commands.py",
    "tests/recording/fitting/test_holds_and_levels.py",
    "tests/evaluation/simulate/test_truth.py",
    "tests/mqtt/test_rejected.py",
    "tests/docs/test_pages.py",
    "tests/daemon/test_daemon_contact.py",
    "tests/daemon/test_lasting_touches.py",
    "tests/evaluation/simulate/test_found.py",
    "tests/processing/test_pipeline.py",
    "tests/daemon/test_stepped_daemon.py",
    "tests/stack/test_three_presses.py",
    "tests/stack/test_fingertips.py",
    "tests/attacks/test_files_that_change.py",
    "tests/attacks/test_daemon_under_attack.py",
    "tests/examples/test_gripper.py",
    "tests/cli/test_demo.py",
    "tests/client/test_client.py",
    "tests/client/test_fleet.py",
    "tests/evaluation/test_accuracy_report.py",
    "tests/daemon/test_slow_disk.py",
    "tests/daemon/test_daemon_boards.py",
    "tests/emulator/boards/test_fingertips.py",
    "tests/evaluation/test_rig_report.py",
    "tests/mqtt/test_publisher.py",
    "tests/daemon/test_daemon_pitfalls.py",
    "tests/fingertip/test_boards.py",
    "tests/emulator/test_robot.py",
    "tests/evaluation/test_force_trials.py",
    "tests/attacks/test_hostile_surroundings.py",
    "tests/evaluation/papers/test_contacts_report.py",
)

#: Of a failure after which a test is run again.
LAST_LINES = 30

# A slow machine is no failure.
hypothesis.settings.register_profile("project", deadline=None, max_examples=40)
# `make test-system` looks further: --hypothesis-profile=far.
hypothesis.settings.register_profile("far", deadline=None, max_examples=120)
# support/mutation.py: the same few examples in every run, and none is made smaller.
hypothesis.settings.register_profile(
    "mutation",
    deadline=None,
    derandomize=True,
    max_examples=30,
    phases=[hypothesis.Phase.explicit, hypothesis.Phase.generate],
)
hypothesis.settings.load_profile("project")


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add the options that choose between a quick and a real environment."""
    group = parser.getgroup("skin-host")
    group.addoption(
        "--bus",
        choices=["virtual", "vcan"],
        default="virtual",
        help="CAN bus of the stack tests: within the process, or the kernel's (root)",
    )
    group.addoption(
        "--require-mosquitto",
        action="store_true",
        help="fail instead of skip where mosquitto is not installed",
    )


def pytest_configure(config: pytest.Config) -> None:
    """Declare what `make test` leaves to `make test-system`."""
    config.addinivalue_line("markers", "mosquitto: uses a real mosquitto (set by its fixtures)")
    config.addinivalue_line(
        "markers",
        "long: the whole system over hours of its time, and what no robot runs, in seconds of ours:"
        " storms of the simulation, holds of hours, reports, benchmarks, reproductions of papers",
    )


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark the tests that use a broker, and begin with the files that take longest.

    A process gets a whole file at a time: a long one that came last would run alone.
    """
    for item in items:
        if BROKERS & set(getattr(item, "fixturenames", ())):
            item.add_marker("mosquitto")
    items.sort(key=lambda item: _place(item.nodeid.partition("::")[0]))


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """Show why tests were run again: one that passes then shows nothing else of it."""
    for report in terminalreporter.stats.get("rerun", ()):
        terminalreporter.section(f"run again: {report.nodeid}", "_")
        terminalreporter.write_line("\n".join(report.longreprtext.splitlines()[-LAST_LINES:]))


def _place(file: str) -> int:
    return LONGEST_FIRST.index(file) if file in LONGEST_FIRST else len(LONGEST_FIRST)


@pytest.fixture(scope="session", autouse=True)
def kept_elsewhere(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """What is kept where no configuration names a folder is neither the user's nor that of tests
    that run at the same time: one node of a name runs in a folder.
    """
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_STATE_HOME", str(tmp_path_factory.mktemp("state")))
        yield


@pytest.fixture
def bus_kind(request: pytest.FixtureRequest) -> str:
    """The kind of CAN bus: `virtual` (one process) or `vcan` (any number of processes)."""
    return str(request.config.getoption("--bus"))


@pytest.fixture
def vcan() -> Iterator[Vcan]:
    """A fresh vcan interface of the kernel, up."""
    with closing(Vcan()) as interface:
        yield interface


@pytest.fixture
def new_can_bus(bus_kind: str) -> Iterator[Callable[[], Bus]]:
    """Make settings of one more fresh and empty CAN bus of the chosen kind."""
    with ExitStack() as interfaces:

        def new() -> Bus:
            if bus_kind == "virtual":
                return Bus(interface="virtual", channel=f"test-{next(_numbers)}")
            interface = interfaces.enter_context(closing(Vcan()))
            return Bus(interface="socketcan", channel=interface.name)

        yield new


@pytest.fixture
def can_bus_settings(new_can_bus: Callable[[], Bus]) -> Bus:
    """Settings of a fresh and empty CAN bus of the chosen kind."""
    return new_can_bus()


@pytest.fixture
def mosquitto(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Mosquitto]:
    """A real broker that runs already."""
    if request.config.getoption("--require-mosquitto"):
        program = programs.require("mosquitto")
    else:
        found = programs.find("mosquitto")
        if found is None:
            pytest.skip("mosquitto is not installed")
        program = found
    with Mosquitto(program, tmp_path) as broker:
        yield broker


@pytest.fixture(scope="session")
def calibrated() -> FaultBench:
    """A calibrated robot in simulated time that is only copied; its calibration takes a while."""
    return FaultBench()


@pytest.fixture
def bench(calibrated: FaultBench) -> FaultBench:
    """One to break."""
    return branch(calibrated)
