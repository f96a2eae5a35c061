"""Stands in for ``python -m l3r`` where the runner is tested: leaves files, learns nothing.

What a run does is said in the folder of the sweep: ``ROW-SEED.txt`` holds ``die``, ``diverge``,
``explode`` or ``wait``. Every call is written down in ``calls.txt``.
"""

import signal
import sys
import time
from pathlib import Path

from l3r.launch.expand import expand
from l3r.launch.score_file import scoring_request
from tests.launch.sweeps import note_bad_steps, score_by_hand, train_by_hand


def main(words):
    file, out, extra = Path(words[0]), Path(words[1]), words[2].split()
    sweep = expand(file, extra, out)
    command, rest = words[3], words[4:]
    if command == "train":
        folder = next(w for w in rest if w.startswith("train.output_dir=")).partition("=")[2]
        run = next(run for run in sweep.runs if str(run.folder) == folder)
    else:
        run = sweep.find(rest[rest.index("--score") + 1])
    with (out / "calls.txt").open("a") as stream:
        stream.write(f"{command} {run.name}\n")
    told = out / f"{run.row}-{run.seed}.txt"
    what = told.read_text() if told.exists() else ""
    if command != "train":
        score_by_hand(run, scoring_request(sweep))
        return 0
    train_by_hand(run, steps=7)
    if what == "wait":
        signal.signal(signal.SIGTERM, lambda *_: sys.exit(2))
        (out / "waiting").touch()
        time.sleep(60)
    if what == "die":
        sys.stderr.write("out of luck\n")
        return 1
    if what == "explode":
        note_bad_steps(run, [8], problem="scores are not finite")
        return 2
    if what == "diverge":
        note_bad_steps(run, [7, 8, 9])
        return 2
    train_by_hand(run)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
