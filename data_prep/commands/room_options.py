"""Options of the synthetic room, shared by ``render`` and ``build synthetic``."""

import argparse
from typing import TYPE_CHECKING

from l3r.errors import DataError

if TYPE_CHECKING:
    from data_prep.converters.synthetic import RoomRequest

ROOM_DEFAULTS = {
    "scene_seed": 0,
    "views": 3000,
    "held_out_views": 300,
    "walk_views": 200,
    "size": "48x48",
}
"""What an option is where it was not given."""


def add_room_arguments(parser: argparse._ActionsContainer) -> None:
    """Declare the options of a room; one that is not given is None."""
    add = parser.add_argument
    add("--scene-seed", type=int, metavar="N", help="which room (0)")
    add("--views", type=int, metavar="N", help="training cameras, P000 (3000)")
    add("--held-out-views", type=int, metavar="N", help="held-out cameras, P001 (300; 0: none)")
    add("--walk-views", type=int, metavar="N", help="cameras of a smooth walk, P002 (200; 0: none)")
    add("--size", metavar="HxW", help="height and width of the images (48x48)")


def room_request(args: argparse.Namespace) -> "RoomRequest":
    """Read the options of a room.

    Raises:
        DataError: The size is malformed, or a number too small.
    """
    from data_prep.converters.synthetic import RoomRequest

    given = {key: getattr(args, key) for key in ROOM_DEFAULTS if getattr(args, key) is not None}
    options = {**ROOM_DEFAULTS, **given}
    height, _, width = str(options["size"]).lower().partition("x")
    if not (height.isdecimal() and width.isdecimal()):
        raise DataError(f"--size is '{options['size']}', expected HEIGHTxWIDTH such as 48x48")
    return RoomRequest(
        scene_seed=int(options["scene_seed"]),
        num_views=int(options["views"]),
        num_held_out=int(options["held_out_views"]),
        num_walk=int(options["walk_views"]),
        image_size=(int(height), int(width)),
    )
