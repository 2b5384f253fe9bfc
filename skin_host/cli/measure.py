"""Commands that measure: bench, report."""

import argparse
from importlib import import_module
from pathlib import Path

from skin_host.cli.common import Commands, add_command, print_json

BENCHMARKS = {
    "receive": "reading a bus: python-can's ways and ours, on the same stream",
    "latency": "from the last CAN frame of a sweep to the touch in a subscriber's hands",
    "processing": "bytes to kPa, every model, against a copy of memory",
    "publish": "what messages cost the daemon and the broker",
    "emulator": "simulated seconds per second",
}


def add_commands(commands: Commands) -> None:
    """Add this room's commands to the parser."""
    bench = add_command(commands, "bench", "measure what things cost here", "skin bench receive")
    about = "; ".join(f"{name}: {text}" for name, text in BENCHMARKS.items())
    bench.add_argument("name", choices=list(BENCHMARKS), metavar="NAME", help=about)
    bench.add_argument("--quick", action="store_true", help="shorter and less certain")
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
    report.add_argument("--quick", action="store_true", help="within a minute")
    report.add_argument("--output", type=Path, metavar="DIR", help="folder for page and plots")
    report.add_argument("--json", action="store_true", help="one JSON document")
    report.set_defaults(run=_report)


def _bench(arguments: argparse.Namespace) -> int:
    module = import_module(f"skin_host.evaluation.bench_{arguments.name}")
    document = module.run(quick=arguments.quick)
    if arguments.json:
        print_json(document)
    else:
        print(module.describe(document))
    return 0


def _report(arguments: argparse.Namespace) -> int:
    name = "contacts_report" if arguments.contacts else "rig_report" if arguments.rig else "report"
    module = import_module(f"skin_host.evaluation.{name}")
    output = arguments.output
    if output is None and not arguments.json:
        output = Path("report")
    document = module.run(quick=arguments.quick, output=output)
    if arguments.json:
        print_json(document)
    else:
        print(module.describe(document))
        print(f"written to {output}")
    return 0
