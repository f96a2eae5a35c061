"""How long a user waits for ``l3r --help`` and ``l3r config``."""

import subprocess
import sys

from benchmarks.timing import seconds, shown


def run() -> list[tuple[str, str]]:
    """Time whole processes, beside a bare Python."""

    def process(*arguments: str) -> tuple[float, float]:
        command = [sys.executable, *arguments]
        return seconds(lambda: subprocess.run(command, check=True, capture_output=True))

    bare = process("-c", "pass")
    helped = process("-m", "l3r", "--help")
    config = process("-m", "l3r", "config", "configs/base.yaml")
    return [
        ("python -c pass (least / median)", shown(bare)),
        ("l3r --help", shown(helped)),
        ("l3r config configs/base.yaml", shown(config)),
        ("l3r --help against bare python", f"{helped[0] / bare[0]:.1f} x"),
    ]
