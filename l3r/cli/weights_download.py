"""``l3r weights download``.

Fetch weights from the Hugging Face hub: config.json and model.safetensors.
NAME is mast3r-512, dust3r-512-dpt, dust3r-512-linear, dust3r-224-linear, or
any repository as owner/name. Needs the extra: pip install 'light3r[hub]'.

Examples::

  l3r weights download mast3r-512 --out mast3r/
"""

import argparse
import sys
from pathlib import Path


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.add_argument("name", metavar="NAME", help="short name, or owner/name on the hub")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder to fill")


def run(args: argparse.Namespace) -> int:
    """Print the licence, fetch, and print what to do next."""
    from l3r.model.hub import RELEASED, fetch_folder

    hub_id = RELEASED.get(args.name, args.name)
    is_released = args.name in RELEASED
    licence = "CC BY-NC-SA 4.0, non-commercial" if is_released else "see the repository's README"
    sys.stdout.write(f"from: https://huggingface.co/{hub_id}\nlicence of the weights: {licence}\n")
    sys.stdout.flush()  # before the first byte is fetched
    folder = fetch_folder(hub_id, args.out)
    from l3r.model.weight_files import is_own, read_weight_file

    if is_own(read_weight_file(folder)):
        following = f"l3r reconstruct photos/ --checkpoint {folder} --out out/"
    else:
        following = f"l3r weights import {folder} --out {args.name.split('/')[-1]}.ckpt"
    sys.stdout.write(f"next: {following}\n")
    return 0
