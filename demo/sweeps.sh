#!/usr/bin/env bash
# The paper's ablations on synthetic rooms, on a CPU: rooms, shards, the start that all trainings
# share, then every tiny sweep, one after the other. Interrupted, it goes on where it stopped. The
# tables are printed and stay in runs/sweep/tiny_*/table.md and report.html; JOBS=K runs K trainings
# at a time (2).
set -euo pipefail
cd "$(dirname "$0")/.."

ROOMS=runs/sweep/rooms
for seed in 0 1 2 3; do
    l3r-prep render --raw "$ROOMS/raw" --scene-seed "$seed" --size 32x32 \
        --views 1500 --held-out-views 150 --walk-views 0
done
# Through the TartanAir converter, which reads all rooms at once; 10 images serve every N.
l3r-prep build tartanair --raw "$ROOMS/raw" --split all --scenes '*/P000' --out "$ROOMS/train" \
    --num-graphs 1500
l3r-prep build tartanair --raw "$ROOMS/raw" --split all --scenes '*/P001' --out "$ROOMS/val" \
    --num-graphs 50

# What DUSt3R is to the paper's ablations: pairs alone, from scratch, and longer than any row.
l3r train configs/base.yaml configs/model/tiny.yaml configs/train/ablation_tiny.yaml \
    configs/ablation/no_alignment.yaml configs/ablation/no_global_loss.yaml \
    "train.init=''" train.seed=100 train.lr=3e-3 train.max_steps=6000 train.validate_every=1000 \
    train.output_dir=runs/sweep/start

status=0
for name in num_layers alignment_supervision global_weight graph_size graph init; do
    l3r sweep "configs/sweep/tiny_$name.yaml" --jobs "${JOBS:-2}" || status=$?
    ((status < 128)) || exit "$status" # interrupted
done
exit "$status"
