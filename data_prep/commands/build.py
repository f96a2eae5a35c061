"""``l3r-prep build``: a raw data set becomes shards of graphs.

Relates all frames of each scene, draws graphs by the greedy rule and writes tars, indices and
manifest.json. Interrupted, the same command goes on where it stopped; finished shards are left
alone. What cannot be read is left out, logged with its file and counted at the end and in the
manifest. 'l3r-prep inspect' says in seconds what a folder of raw data holds.

The work can be shared out: K tasks, on any machines that see both folders, each run the same
command with --tasks K and their own --task-index. The last to finish writes manifest.json. Neither
the number of tasks nor of workers changes a byte. slurm/build_shards.sh does this as a job array.

example, of a raw data set, of half of its work, and of rendered rooms:
  l3r-prep build tartanair --raw TartanAir/ --out shards/tartanair --frame-step 4
  l3r-prep build waymo --raw waymo/ --out shards/waymo --workers 8 --tasks 2 --task-index 0
  l3r-prep build synthetic --raw raw/room --out shards/room --num-graphs 4000 --max-views 8
"""

import argparse
import sys
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING, Any

from data_prep.commands.graph_options import add_graph_arguments, graph_counts
from data_prep.commands.room_options import ROOM_DEFAULTS, add_room_arguments, room_request
from data_prep.converters import CONVERTERS
from data_prep.problems import Problems
from l3r.errors import DataError

if TYPE_CHECKING:
    from data_prep.source import SceneSource

_RAW_DEFAULTS: dict[str, Any] = {"scenes": "*", "split": "train", "frame_step": 1, "held_out": 0.0}
_RAW_SWITCH = "include_excluded"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments; an option of one source alone has no default here."""
    add = parser.add_argument
    add("dataset", choices=[*sorted(CONVERTERS), "synthetic"], help="what to read")
    add(
        "--raw",
        type=Path,
        required=True,
        metavar="DIR",
        help="folder of the raw data; for synthetic it is rendered there where absent",
    )
    add("--out", type=Path, required=True, metavar="DIR", help="folder to write to")
    add_graph_arguments(parser)
    add("--max-uses", type=int, metavar="N", help="most graphs an image stands in")
    add("--graphs-per-shard", type=int, default=128, metavar="N", help="graphs of each tar (128)")
    add("--seed", type=int, default=0, metavar="N", help="seed of the draw (0)")
    add("--workers", type=int, default=0, metavar="N", help="processes that work (0: this one)")
    add("--tasks", type=int, default=1, metavar="K", help="tasks that share the work (1)")
    add("--task-index", type=int, default=0, metavar="I", help="which of them this is, from 0")
    raw = parser.add_argument_group("raw data sets")
    raw.add_argument("--scenes", metavar="GLOB", help="pattern on names as inspect lists them (*)")
    raw.add_argument(
        "--split",
        choices=["train", "test", "all"],
        help="train leaves out what is kept for testing (train)",
    )
    raw.add_argument("--frame-step", type=int, metavar="N", help="take every so many frames (1)")
    raw.add_argument(
        "--held-out",
        type=float,
        metavar="SHARE",
        help="write OUT/train and OUT/val, the last SHARE of each scene's frames (0)",
    )
    raw.add_argument(
        "--include-excluded",
        action="store_true",
        default=None,
        help="also MegaDepth's scenes that evaluation sets are made of",
    )
    add_room_arguments(
        parser.add_argument_group(
            "synthetic", "with held-out views it writes OUT/train and OUT/val"
        )
    )


def run(args: argparse.Namespace) -> int:
    """Build every part and print a line for each."""
    from data_prep.commands.threads import use_one_thread

    use_one_thread()
    _refuse_foreign(args)
    parts = _synthetic_parts(args) if args.dataset == "synthetic" else _raw_parts(args)
    for folder, source, num_graphs, recorded in parts:
        sys.stdout.write(_build(args, folder, source, num_graphs, recorded))
    return 0


def _refuse_foreign(args: argparse.Namespace) -> None:
    foreign = [*_RAW_DEFAULTS, _RAW_SWITCH] if args.dataset == "synthetic" else list(ROOM_DEFAULTS)
    for key in foreign:
        if getattr(args, key) is not None:
            raise DataError(
                f"--{key.replace('_', '-')} has no effect on {args.dataset}; leave it out"
            )


Part = tuple[Path, "SceneSource", int, dict[str, Any]]
"""Folder of shards, what its scenes come from, graphs of each scene, options to record."""


def _raw_parts(args: argparse.Namespace) -> list[Part]:
    from data_prep.plan import hold_out
    from data_prep.source import PartSource, RawSource

    recorded = {
        key: default if getattr(args, key) is None else getattr(args, key)
        for key, default in _RAW_DEFAULTS.items()
    }
    if args.include_excluded:
        recorded[_RAW_SWITCH] = True
    share = recorded["held_out"]
    if not 0 <= share < 1 or recorded["frame_step"] < 1:
        raise DataError(
            f"--held-out is {share} and --frame-step {recorded['frame_step']}, expected a share"
            " from 0 to less than 1 and 1 or more"
        )
    source = RawSource(
        converter=args.dataset,
        root=args.raw,
        split=recorded["split"],
        scenes=recorded["scenes"],
        frame_step=recorded["frame_step"],
        include_excluded=bool(args.include_excluded),
    )
    if not share:
        return [(args.out, source, args.num_graphs, recorded)]
    num_held = max(1, round(share * args.num_graphs))
    kept = PartSource(source, lambda scene: hold_out(scene, share)[0])
    held = PartSource(source, lambda scene: hold_out(scene, share)[1])
    return [
        (args.out / "train", kept, args.num_graphs, recorded),
        (args.out / "val", held, num_held, recorded),
    ]


def _synthetic_parts(args: argparse.Namespace) -> list[Part]:
    from data_prep.commands.progress import show_progress
    from data_prep.converters import synthetic
    from data_prep.source import RawSource

    request = room_request(args)
    if args.tasks > 1 and not synthetic.is_complete(args.raw, request):
        raise DataError(
            f"{args.raw}: no finished room of this request, and several tasks would render it at"
            " once; run 'l3r-prep render' with the same options first"
        )
    with show_progress() as report:
        synthetic.write_room(args.raw, request, report=report)

    def trajectory(name: str) -> RawSource:
        pattern = f"{request.environment}/Easy/{name}"
        return RawSource(
            converter="tartanair", root=args.raw, split="all", scenes=pattern, label="synthetic"
        )

    recorded = {"scene_seed": request.scene_seed, "size": list(request.image_size)}
    if not request.num_held_out:
        return [(args.out, trajectory("P000"), args.num_graphs, recorded)]
    num_held = max(1, round(args.num_graphs * request.num_held_out / request.num_views))
    return [
        (args.out / "train", trajectory("P000"), args.num_graphs, recorded),
        (args.out / "val", trajectory("P001"), num_held, recorded),
    ]


def _build(
    args: argparse.Namespace,
    folder: Path,
    source: "SceneSource",
    num_graphs: int,
    recorded: dict[str, Any],
) -> str:
    from data_prep.build import build_shards
    from data_prep.commands.progress import show_progress
    from data_prep.graph_sampling import SamplingOptions
    from data_prep.ledger import PROBLEMS
    from data_prep.units import BuildRequest, TaskShare

    counts = graph_counts(args)
    request = BuildRequest(
        num_graphs=num_graphs,
        graphs_per_image=counts.graphs_per_image,
        graphs_per_shard=args.graphs_per_shard,
        seed=args.seed,
        sampling=SamplingOptions(
            min_views=counts.min_views, max_views=counts.max_views, max_uses=args.max_uses
        ),
        source=recorded,
    )
    with show_progress() as report:
        manifest = build_shards(
            source,
            folder,
            request,
            share=TaskShare(index=args.task_index, count=args.tasks),
            num_workers=args.workers,
            report=report,
        )
    if manifest is None:
        return (
            f"{folder}: task {args.task_index} of {args.tasks} has written its shards; others have"
            " not, and the last of them writes manifest.json\n"
        )
    left_out = Problems(counts=Counter(manifest.request.get(PROBLEMS, {}))).summary()
    return (
        f"{folder}: {manifest.num_graphs} graphs in {len(manifest.shards)} shards,"
        f" {manifest.num_bytes / 1e6:.1f} MB; left out: {left_out}\n"
    )
