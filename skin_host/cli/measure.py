"""Commands that measure and try out: bench, report, simulate."""

import argparse
import logging
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from skin_host.cli.common import Commands, Progress, add_command, load_skin, print_json
from skin_host.errors import RequestError

BENCHMARKS = {
    "receive": "reading a bus: python-can's ways and ours, on the same stream",
    "latency": "from the last CAN frame of a sweep to the touch in a subscriber's hands",
    "daemon": "CPU and latency of the whole daemon, 192 to 10 000 taxels",
    "scale": "a body of 100 000 taxels in as many processes as there are cores",
    "processing": "bytes to kPa, every model, against a copy of memory",
    "publish": "what messages cost the daemon and the broker",
    "fleet": "1000 robots over three brokers, one of them killed, one frozen",
    "emulator": "simulated seconds per second",
}


HOUR_S = 3600.0


def add_commands(commands: Commands) -> None:
    """Add the commands of this module to the parser."""
    bench = add_command(commands, "bench", "measure what things cost here", "skin bench receive")
    about = "; ".join(f"{name}: {text}" for name, text in BENCHMARKS.items())
    bench.add_argument("name", choices=list(BENCHMARKS), metavar="NAME", help=about)
    bench.add_argument("--quick", action="store_true", help="shorter and less certain")
    bench.add_argument("--robots", type=int, metavar="N", help="of bench fleet; 1000 otherwise")
    bench.add_argument("--full", action="store_true", help="bench fleet: 7 messages/s a robot")
    bench.add_argument("--json", action="store_true", help="one JSON document")
    bench.set_defaults(run=_bench)

    report = add_command(
        commands,
        "report",
        "build the table of speed against error, with plots",
        "skin report --quick --output report",
    )
    kind = report.add_mutually_exclusive_group()
    kind.add_argument("--contacts", action="store_true", help="localisation, fingertips, slip")
    kind.add_argument("--rig", action="store_true", help="the experiments of the paper")
    kind.add_argument("--real", action="store_true", help="only the recordings of real skin")
    report.add_argument(
        "--recordings",
        type=Path,
        metavar="DIR",
        help="folder of recordings of real skin (.npz); ../shared/data/insole if it is there",
    )
    report.add_argument("--quick", action="store_true", help="within a minute")
    report.add_argument("--output", type=Path, metavar="DIR", help="folder for page and plots")
    report.add_argument("--json", action="store_true", help="one JSON document")
    report.set_defaults(run=_report)

    simulate = add_command(
        commands,
        "simulate",
        "let a robot and its daemon live through faults in stepped time, all from one seed",
        "skin simulate --seed 1 --hours 0.01",
    )
    simulate.add_argument(
        "config",
        metavar="CONFIG",
        type=Path,
        nargs="?",
        help="configuration file (TOML); the demo's if not given",
    )
    simulate.add_argument("--seed", type=int, default=1, help="decides everything that happens")
    simulate.add_argument("--seeds", type=int, default=1, metavar="N", help="so many, from --seed")
    simulate.add_argument("--hours", type=float, default=1.0, metavar="H", help="of each seed")
    simulate.add_argument(
        "--until",
        type=float,
        metavar="S",
        help="end the run at this simulated time, with the daemon's log on stderr",
    )
    simulate.add_argument("--json", action="store_true", help="one JSON document")
    simulate.set_defaults(run=_simulate)


def _bench(arguments: argparse.Namespace) -> int:
    module = import_module(f"skin_host.evaluation.bench_{arguments.name}")
    more: dict[str, int] = {}
    if arguments.robots is not None:
        if arguments.name != "fleet" or arguments.robots < 1:
            raise RequestError("--robots is a number of 1 or more, of bench fleet")
        more["robots"] = arguments.robots
    if arguments.full:
        if arguments.name != "fleet":
            raise RequestError("--full is of bench fleet")
        more["full"] = True
    document = module.run(quick=arguments.quick, **more)
    if arguments.json:
        print_json(document)
    else:
        print(module.describe(document))
    return 0


def _report(arguments: argparse.Namespace) -> int:
    if arguments.recordings is not None and (arguments.contacts or arguments.rig):
        raise RequestError("--recordings goes with --real, or with the whole report")
    kinds = {"papers.contacts_report": arguments.contacts, "rig_report": arguments.rig}
    kinds |= {"real": arguments.real, "report": True}
    name = next(name for name, chosen in kinds.items() if chosen)
    module = import_module(f"skin_host.evaluation.{name}")
    output = arguments.output
    if output is None and not arguments.json and not arguments.real:
        output = Path("report")
    on_recordings = {"recordings": arguments.recordings} if name in ("real", "report") else {}
    document = module.run(quick=arguments.quick, output=output, **on_recordings)
    if arguments.json:
        print_json(document)
        return 0
    print(module.describe(document))
    if output is not None:
        print(f"written to {output}")
    return 0


if TYPE_CHECKING:
    from skin_host.evaluation.simulate.run import RunResult


def _simulate(arguments: argparse.Namespace) -> int:
    from skin_host.demo import configuration
    from skin_host.evaluation.simulate.run import coverage, simulate

    if arguments.seeds < 1 or arguments.hours <= 0 or arguments.seed < 0:
        raise RequestError("wanted --seed of 0 or more, --seeds of 1 or more and --hours above 0")
    if arguments.until is not None and arguments.seeds != 1:
        raise RequestError("--until goes with one seed")
    config: Path = arguments.config or configuration("demo.toml")
    settings, layout = load_skin(config)
    if arguments.until is None:
        logging.disable(logging.CRITICAL)
    else:
        logging.basicConfig(level=logging.DEBUG, format="%(levelname)-7s %(name)s: %(message)s")
    progress = Progress("simulating")
    results: list[RunResult] = []
    try:
        for number in range(arguments.seeds):
            progress.update(number / arguments.seeds, f"seed {arguments.seed + number}")
            result = simulate(
                settings,
                layout,
                config,
                arguments.seed + number,
                arguments.hours * HOUR_S,
                until_s=arguments.until,
            )
            results.append(result)
            if not arguments.json:
                progress.close()
                print(_line(result), flush=True)
                if result.broken:
                    print(_story(result, arguments, config), flush=True)
    finally:
        progress.close()
        logging.disable(logging.NOTSET)
    broken = [result for result in results if result.broken]
    if arguments.json:
        print_json(_document(results))
    elif arguments.seeds > 1:
        print(f"{len(results) - len(broken)} of {len(results)} seeds kept every promise")
        print(_covered(coverage(results)))
    return 1 if broken else 0


def _line(result: "RunResult") -> str:
    speed = result.simulated_s / max(result.cpu_s, 1e-9)
    outcome = "a promise was broken" if result.broken else "every promise held"
    return (
        f"seed {result.seed}: {outcome}; {result.simulated_s:.0f} s in {result.cpu_s:.1f} s of CPU "
        f"({speed:.0f} x), {sum(result.troubles.values())} troubles, {result.touches} touch "
        f"events, {result.deaths} ends of the daemon; {result.events} events, hash {result.digest}"
    )


def _story(result: "RunResult", arguments: argparse.Namespace, config: Path) -> str:
    """Return the events before a broken promise, and the command that repeats it."""
    command = f"skin simulate {config} --seed {result.seed} --hours {arguments.hours:g}"
    again = max(0.0, result.simulated_s - 1.0)
    return "\n".join(
        [
            *(f"  {line}" for line in result.last),
            f"  broken at {result.simulated_s:.3f} s: {result.broken}",
            f"  with logs: {command} --until {again:.1f}",
        ]
    )


def _covered(kinds: dict[str, list[str]]) -> str:
    """Return how much of the catalogue came, and was named."""
    n_injected, n_named = len(kinds["injected"]), len(kinds["named"])
    came = f"{n_injected} of {n_injected + len(kinds['never_injected'])} kinds of trouble came"
    named = f"{n_named} of {n_named + len(kinds['never_named'])} that must be named were"
    return "; ".join(
        f"{what} (not {', '.join(kinds[missing])})" if kinds[missing] else what
        for what, missing in ((came, "never_injected"), (named, "never_named"))
    )


def _document(results: "list[RunResult]") -> dict[str, Any]:
    from skin_host.evaluation.simulate.run import coverage

    return {
        "seeds": len(results),
        "kept": sum(result.broken is None for result in results),
        "simulated_s": round(sum(result.simulated_s for result in results), 3),
        "cpu_s": round(sum(result.cpu_s for result in results), 3),
        "coverage": coverage(results),
        "runs": [
            {
                "seed": result.seed,
                "broken": result.broken,
                "simulated_s": round(result.simulated_s, 6),
                "events": result.events,
                "hash": result.digest,
                "troubles": result.troubles,
                "named": result.named,
                "touches": result.touches,
                "deaths": result.deaths,
            }
            for result in results
        ],
    }
