"""Join what the demo measured: a table on standard output, and ``metrics.json``."""

import json
import sys
from pathlib import Path

from l3r.files import write_atomic

SHOWN = ("rra_5", "rra_15", "rta_5", "rta_15", "ate", "reg")


def main(folder: Path) -> None:
    """Read the parts in the demo's folder, print, write."""
    trained = json.loads((folder / "trained.json").read_text())
    untrained = json.loads((folder / "untrained.json").read_text())
    rows = {
        "untrained": untrained["network"],
        "identity": trained["identity"],
        "trained": trained["network"],
    }
    seconds: dict[str, int] = {}
    for line in (folder / "seconds.txt").read_text().splitlines():
        name, value = line.split()
        seconds[name] = seconds.get(name, 0) + int(value)
    metrics = {name: {key: values[key] for key in SHOWN} for name, values in rows.items()}
    content = {**metrics, "num_graphs": trained["num_graphs"], "seconds": seconds}
    write_atomic(folder / "metrics.json", json.dumps(content, indent=2) + "\n")

    out = sys.stdout.write
    out(f"\n{trained['num_graphs']} held-out graphs of 8 images, cameras never seen in training\n")
    out(f"{'':<12}" + "".join(f"{key:>9}" for key in SHOWN) + "\n")
    for name, values in metrics.items():
        out(f"{name:<12}" + "".join(_cell(key, values[key]) for key in SHOWN) + "\n")
    out("percent, but for ate (lower is better)\n\n")
    out("seconds: " + ", ".join(f"{name} {value}" for name, value in seconds.items()) + "\n")
    out(f"metrics: {folder / 'metrics.json'}   look at {folder / 'reconstruction/report.html'}\n")


def _cell(key: str, value: float | None) -> str:
    if value is None:
        return f"{'-':>9}"
    return f"{value:>9.{3 if key == 'ate' else 1}f}"


if __name__ == "__main__":
    main(Path(sys.argv[1]))
