"""Share of training time that goes by waiting for data: the loader should hide behind the step.

python -m benchmarks.data_wait [LAYERS...] [--steps 200]

A real ``l3r train`` in a process of its own, with the layers, shards and single device of
``benchmarks.train_step``; figures are those of its ``metrics.csv``. On a GPU less than 2% is right.
"""

import argparse
import csv
import subprocess
import sys
from pathlib import Path

from benchmarks.train_step import prepared
from l3r.config import RunConfig, to_yaml

EVERY = 10
"""Steps between rows; the first row, in which loader processes start, is shown by itself."""


def main(argv: list[str]) -> int:
    """Train and print."""
    formatter = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=formatter)
    parser.add_argument("layers", nargs="*", metavar="LAYER", help="of l3r train")
    parser.add_argument("--steps", type=int, default=200, help="steps to train (200)")
    args = parser.parse_intermixed_args(argv)
    if args.steps < 2 * EVERY:
        parser.error(f"--steps {args.steps}: expected {2 * EVERY} or more")
    with prepared(args.layers) as config:
        first, others = measure_wait(config, args.steps)
    print(f"{args.steps} steps, {config.data.num_workers} loader processes")
    print(f"data wait, steps 1 to {EVERY}, start of the processes included: {first:.2%}")
    print(f"data wait, steps {EVERY + 1} to {args.steps}: {others:.2%}")
    return 0


def measure_wait(config: RunConfig, steps: int) -> tuple[float, float]:
    """Train and read the share of time spent waiting for data.

    Args:
        config: From :func:`benchmarks.train_step.prepared`; its folder is written.
        steps: Optimisation steps, at least two rows.

    Returns:
        That of the first row of the log, and the mean of the others, by their time.
    """
    config.train.max_steps, config.train.log_every = steps, EVERY
    folder = Path(config.train.output_dir)
    layer = folder.with_name("run.yaml")
    layer.write_text(to_yaml(config))
    subprocess.run([sys.executable, "-m", "l3r", "train", str(layer)], check=True)
    with (folder / "metrics.csv").open(newline="") as stream:
        rows = [
            (1 / float(row["graphs_per_second"]), float(row["data_wait"]))
            for row in csv.DictReader(stream)
        ]
    time = sum(seconds for seconds, _ in rows[1:])
    return rows[0][1], sum(seconds * wait for seconds, wait in rows[1:]) / time


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
