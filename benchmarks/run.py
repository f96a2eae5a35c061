"""Run all benchmarks, or those named: ``python -m benchmarks.run accumulate loader``.

Timings on shared machines are noisy: look at the ratios, which were measured in one run.
"""

import importlib
import platform
import sys

import torch

ALL = ("startup", "accumulate", "model", "train_step", "loader", "sampling", "street", "data_prep")


def main(names: list[str]) -> int:
    """Print a table of figures."""
    unknown = set(names) - set(ALL)
    if unknown:
        sys.stderr.write(f"no benchmark {', '.join(sorted(unknown))}; expected: {', '.join(ALL)}\n")
        return 2
    device = torch.cuda.get_device_name() if torch.cuda.is_available() else "CPU"
    threads = torch.get_num_threads()
    print(f"{device}, {threads} threads, torch {torch.__version__}, {platform.platform()}")
    for name in names or ALL:
        print(f"\n{name}")
        for label, value in importlib.import_module(f"benchmarks.{name}").run():
            print(f"  {label:<58}{value:>18}")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
