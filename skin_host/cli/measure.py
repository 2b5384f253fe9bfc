"""Commands that measure: bench, report."""

import argparse
from importlib import import_module
from pathlib import Path

from skin_host.cli.common import Commands, add_command, print_json
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


def add_commands(commands: Commands) -> None:
    """Add the commands of this module to the parser."""
    bench = add_command(commands, "bench", "measure what things cost here", "skin bench receive")
    about = "; ".join(f"{name}: {text}" for name, text in BENCHMARKS.items())
    bench.add_argument("name", choices=list(BENCHMARKS), metavar="NAME", help=about)
    bench.add_argument("--quick", action="store_true", help="shorter and less certain")
    bench.add_argument("--robots", type=int, metavar="N", help="of bench fleet; 1000 otherwise")
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


def _bench(arguments: argparse.Namespace) -> int:
    module = import_module(f"skin_host.evaluation.bench_{arguments.name}")
    more = {}
    if arguments.robots is not None:
        if arguments.name != "fleet" or arguments.robots < 1:
            raise RequestError("--robots is a number of 1 or more, of bench fleet")
        more = {"robots": arguments.robots}
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
