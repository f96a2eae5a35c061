#!/usr/bin/env bash
# The paper's ablations on synthetic rooms, on a CPU: rooms, shards, then every tiny sweep, one
# after the other. Interrupted, it goes on where it stopped. The tables are printed and stay in
# runs/sweep/tiny_*/table.md and report.html; JOBS=K runs K trainings at a time (2).
set -euo pipefail
cd "$(dirname "$0")/.."

ROOMS=runs/sweep/rooms
for seed in 0 1; do
    l3r-prep render --raw "$ROOMS/raw" --scene-seed "$seed" --size 32x32 \
        --views 1500 --held-out-views 150 --walk-views 0
done
# Through the TartanAir converter, which reads all rooms at once; 10 images serve every N.
l3r-prep build tartanair --raw "$ROOMS/raw" --split all --scenes '*/P000' --out "$ROOMS/train" \
    --num-graphs 1500
l3r-prep build tartanair --raw "$ROOMS/raw" --split all --scenes '*/P001' --out "$ROOMS/val" \
    --num-graphs 50

status=0
for name in num_layers global_weight graph_size alignment_supervision graph; do
    l3r sweep "configs/sweep/tiny_$name.yaml" --jobs "${JOBS:-2}" || status=$?
    ((status < 128)) || exit "$status" # interrupted
done
exit "$status"
