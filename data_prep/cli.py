"""The ``l3r-prep`` command: parse, run, turn errors into one line."""

import argparse
import importlib
import logging
import sys
from collections.abc import Sequence

from l3r.errors import L3RError
from l3r.files import explain_failure
from l3r.version import __version__

COMMANDS = {
    "inspect": "say what a folder of raw data holds, in seconds",
    "build": "turn a raw data set into shards of graphs",
    "render": "render a synthetic room into TartanAir's raw layout",
    "cameras": "write the true cameras of one raw scene",
    "check": "measure whether shards hold what they claim",
    "show": "draw one graph of a folder of shards",
}
"""Summary of each command; it lives in ``data_prep.commands`` under its name."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command; exit code 2 and one line on standard error if the user must act."""
    words = list(sys.argv[1:] if argv is None else argv)
    name = words[0] if words else "--help"
    if name not in COMMANDS:
        return _explain(name)
    # Only the command asked for is imported, and torch only when it runs.
    command = importlib.import_module(f"data_prep.commands.{name}")
    summary, _, text = (command.__doc__ or "").partition("\n")
    parser = argparse.ArgumentParser(
        prog=f"l3r-prep {name}",
        description=text.strip() or summary,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    command.add_arguments(parser)
    args = parser.parse_args(words[1:])
    logging.basicConfig(level=logging.WARNING, format="%(levelname)s: %(message)s")
    try:
        return int(command.run(args))
    except L3RError as error:
        sys.stderr.write(f"l3r-prep {name}: {error}\n")
        return 2
    except OSError as error:
        sys.stderr.write(f"l3r-prep {name}: {explain_failure(error)}\n")
        return 2
    except KeyboardInterrupt:
        sys.stderr.write(f"l3r-prep {name}: interrupted; run it again to go on\n")
        return 130


def _explain(name: str) -> int:
    if name == "--version":
        sys.stdout.write(f"l3r-prep {__version__}\n")
        return 0
    if name not in ("-h", "--help"):
        known = ", ".join(COMMANDS)
        sys.stderr.write(f"l3r-prep: no command '{name}'; expected one of: {known}\n")
        return 2
    rows = [f"  {command:<9} {summary}" for command, summary in COMMANDS.items()]
    sys.stdout.write(
        "usage: l3r-prep COMMAND ...\n\nRaw data sets become shards of graphs.\n\n"
        + "\n".join(rows)
        + "\n\nexample: l3r-prep build tartanair --raw TartanAir/ --out shards/tartanair\n"
        "\n'l3r-prep COMMAND --help' explains one; 'l3r-prep --version' says which this is.\n"
    )
    return 0
