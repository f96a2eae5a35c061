"""The ``l3r`` command: parse, run, turn errors into one line."""

import argparse
import importlib
import logging
import sys
from collections.abc import Sequence

from l3r.errors import L3RError
from l3r.files import explain_failure
from l3r.version import __version__

COMMANDS = {
    "config": "show exactly what a run would use",
    "train": "train a network, or go on where a run stopped",
    "sweep": "train and score many runs, and print the paper's table",
    "report": "draw how a training run or a sweep goes",
    "reconstruct": "reconstruct a folder of photos",
    "eval poses": "score cameras against trusted ones",
    "eval graphs": "score a checkpoint on validation shards",
    "weights import": "make a checkpoint of an official DUSt3R, MASt3R or CroCo",
    "weights inspect": "say what a file of weights is",
    "weights download": "fetch official weights from the Hugging Face hub",
}
"""Summary of each command; it lives in ``l3r.cli`` under its name with ``_`` for spaces."""
GROUPS = {name.split()[0] for name in COMMANDS if " " in name}
"""First words of commands of two."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command; exit code 2 and one line on standard error if the user must act."""
    words = list(sys.argv[1:] if argv is None else argv)
    name = " ".join(words[: 2 if words and words[0] in GROUPS else 1])
    if name not in COMMANDS:
        return _explain(words)
    # Only the command asked for is imported: the others would bring torch.
    command = importlib.import_module(f"l3r.cli.{name.replace(' ', '_')}")
    parser = argparse.ArgumentParser(
        prog=f"l3r {name}",
        description=str(command.__doc__).split("\n", 1)[1].strip().replace("::", ":"),
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    command.add_arguments(parser)
    # Intermixed: settings may follow options.
    args = parser.parse_intermixed_args(words[len(name.split()) :])
    logging.basicConfig(level=logging.WARNING, format="%(levelname)s: %(message)s")
    try:
        return int(command.run(args))
    except L3RError as error:
        sys.stderr.write(f"l3r {name}: {error}\n")
        return 2
    except OSError as error:
        sys.stderr.write(f"l3r {name}: {explain_failure(error)}\n")
        return 2
    except KeyboardInterrupt:
        sys.stderr.write(f"l3r {name}: interrupted\n")
        return 130


def _explain(words: Sequence[str]) -> int:
    if words[:1] == ["--version"]:
        sys.stdout.write(f"l3r {__version__}\n")
        return 0
    last = words[1:2] if words[:1] and words[0] in GROUPS else words[:1]
    if words and last not in (["-h"], ["--help"]):
        shown = " ".join(words[:2])
        sys.stderr.write(f"l3r: no command '{shown}'; expected one of: {', '.join(COMMANDS)}\n")
        return 2
    width = max(map(len, COMMANDS))
    rows = [f"  {name:<{width}}  {summary}" for name, summary in COMMANDS.items()]
    sys.stdout.write(
        "usage: l3r COMMAND ...\n\nFeed-forward Structure-from-Motion.\n\n"
        + "\n".join(rows)
        + "\n\nexample: l3r reconstruct photos/ --checkpoint light3r.ckpt --out out/\n"
        "\n'l3r COMMAND --help' explains one; 'l3r --version' says which this is.\n"
    )
    return 0
