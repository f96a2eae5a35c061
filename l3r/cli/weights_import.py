r"""``l3r weights import``.

Make a Light3R checkpoint of an official DUSt3R, MASt3R or CroCo v2 file: the
.pth, or the Hugging Face folder of config.json and model.safetensors. A
DUSt3R or MASt3R answers for pairs of images as the original; the latent
alignment is untrained. CroCo has no heads: they are fresh.
The released weights have a licence of their own: CC BY-NC-SA 4.0,
non-commercial.

Examples::

  l3r weights import mast3r.pth --out l3r_512_init.ckpt
  l3r weights import croco.pth --out init.ckpt --head dpt \
      model.image_size=[384,512] model.alignment.num_blocks=2
"""

import argparse
import sys
from pathlib import Path


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.add_argument("file", type=Path, metavar="FILE", help="official file or folder")
    parser.add_argument("--out", type=Path, required=True, help="checkpoint to write")
    parser.add_argument(
        "--head",
        choices=("linear", "dpt"),
        help="fresh heads for a file without any, such as CroCo's (linear)",
    )
    parser.add_argument("--seed", type=int, default=0, help="of the fresh parts (0)")
    parser.add_argument("--force", action="store_true", help="replace an existing --out")
    parser.add_argument(
        "settings",
        nargs="*",
        metavar="key=value",
        help="of model.alignment, model.image_size, graph and inference",
    )


def run(args: argparse.Namespace) -> int:
    """Import and print what became of every weight."""
    from l3r.inference.weights import import_official

    report = import_official(
        args.file,
        args.out,
        args.settings,
        head=args.head,
        seed=args.seed,
        overwrite=args.force,
    )
    sys.stdout.write(f"{report}\nwrote {args.out}\n")
    return 0
