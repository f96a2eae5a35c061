"""``l3r-prep cameras``: the true cameras of one raw scene.

Writes what 'l3r eval poses' compares a reconstruction of the scene's images with.

example: l3r-prep cameras tartanair --raw raw/room --scenes '*/P002' --out walk.json
"""

import argparse
import sys
from itertools import islice
from pathlib import Path

from data_prep.converters import CONVERTERS, read_scenes
from data_prep.problems import Problems
from l3r.errors import DataError


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    add = parser.add_argument
    add("dataset", choices=sorted(CONVERTERS), help="layout of the source")
    add("--raw", type=Path, required=True, metavar="DIR", help="folder of the raw data")
    add("--scenes", default="*", metavar="GLOB", help="pattern that names one scene")
    add("--frame-step", type=int, default=1, metavar="N", help="take every so many frames (1)")
    add("--out", type=Path, required=True, metavar="FILE", help="cameras.json to write")


def run(args: argparse.Namespace) -> int:
    """Write the cameras and print how many."""
    import torch

    from l3r.export.cameras_json import write_cameras
    from l3r.geometry.rigid import invert_rigid
    from l3r.types import Cameras

    problems = Problems()
    found = read_scenes(
        args.dataset,
        args.raw,
        "all",
        scenes=args.scenes,
        frame_step=args.frame_step,
        problems=problems,
    )
    # No more than it takes to tell: a data set may have thousands.
    scenes = list(islice(found, 2))
    if len(scenes) != 1:
        names = "".join(f"{scene.name}, " for scene in scenes)
        raise DataError(
            f"{args.raw}: {len(scenes) or 'no'} scenes match '{args.scenes}' ({names}...), expected"
            " one; change --scenes"
        )
    scene = scenes[0]
    number = len(scene.frames)
    cameras = Cameras(
        file=[frame.name for frame in scene.frames],
        image_size=[frame.image_size for frame in scene.frames],
        K=torch.from_numpy(scene.intrinsics),
        cam_from_world=invert_rigid(torch.from_numpy(scene.world_from_cam)),
        registered=torch.ones(number, dtype=torch.bool),
        component=torch.zeros(number, dtype=torch.long),
    )
    args.out.parent.mkdir(parents=True, exist_ok=True)
    write_cameras(args.out, cameras)
    left_out = f"; left out: {problems.summary()}" if problems.counts else ""
    sys.stdout.write(f"{args.out}: {number} cameras of {scene.name}{left_out}\n")
    return 0
