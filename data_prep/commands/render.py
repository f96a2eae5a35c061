"""``l3r-prep render``: a synthetic room in TartanAir's raw layout.

Renders a closed room with textured boxes and spheres: images, exact depth and cameras, as
ROOT/roomNNN/Easy/{P000 training, P001 held out, P002 a walk}. The same options give the same
files; trajectories already there are left alone.

example: l3r-prep render --raw raw/room --views 3000 --size 48x48
"""

import argparse
import sys
from pathlib import Path

from data_prep.commands.room_options import add_room_arguments, room_request


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.add_argument("--raw", type=Path, required=True, metavar="DIR", help="folder to write to")
    add_room_arguments(parser)


def run(args: argparse.Namespace) -> int:
    """Render what is missing and print the folder."""
    from data_prep.commands.progress import show_progress
    from data_prep.commands.threads import use_one_thread
    from data_prep.converters.synthetic import write_room

    use_one_thread()
    request = room_request(args)
    with show_progress() as report:
        folder = write_room(args.raw, request, report=report)
    sys.stdout.write(f"{folder}\n")
    return 0
