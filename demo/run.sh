#!/usr/bin/env bash
# The whole way on a synthetic room, as command lines: raw frames, shards, training, evaluation on
# cameras it never saw, reconstruction. Interrupted, it goes on where it stopped; delete runs/demo
# to start over. What it shows and what it does not: README.md, "Demo".
set -euo pipefail
cd "$(dirname "$0")/.."

OUT=runs/demo
ROOM=$OUT/raw/room000/Easy
mkdir -p "$OUT"

stage() { # name, command...: show it, run it, note its seconds (a resumed stage adds up)
    local name=$1 began=$SECONDS
    shift
    printf '\n\033[1m%s\033[0m: %s\n' "$name" "$*"
    "$@"
    echo "$name $((SECONDS - began))" >>"$OUT/seconds.txt"
}

# 1. Raw frames in TartanAir's layout: P000 to train on, P001 held out, P002 a walk to reconstruct.
stage render l3r-prep render --raw "$OUT/raw" --views 3000 --held-out-views 300 --walk-views 200 \
    --size 40x40

# 2. Shards of 8-image graphs, through the TartanAir converter.
stage shards l3r-prep build synthetic --raw "$OUT/raw" --out "$OUT/shards" \
    --num-graphs 4000 --graphs-per-image 2 --max-views 8 --size 40x40
stage check l3r-prep check "$OUT/shards/train"

# 3. Training from scratch, a fixed number of steps.
stage train l3r train configs/base.yaml configs/model/tiny.yaml demo/room.yaml
cp "$OUT/train/model.ckpt" "$OUT/tiny.ckpt"

# 4. Held-out graphs, by the full inference path; fresh weights beside it.
stage evaluate l3r eval graphs "$OUT/shards/val" --checkpoint "$OUT/tiny.ckpt" \
    --max-graphs 64 --json "$OUT/trained.json"
stage untrained l3r eval graphs "$OUT/shards/val" --max-graphs 64 --json "$OUT/untrained.json" \
    --untrained configs/base.yaml configs/model/tiny.yaml demo/room.yaml

# 5. Every tenth frame of the walk becomes a reconstruction, scored against the true cameras.
mkdir -p "$OUT/photos"
cp "$ROOM"/P002/image_left/000??0_left.png "$OUT/photos"
stage reconstruct l3r reconstruct "$OUT/photos" --checkpoint "$OUT/tiny.ckpt" \
    --out "$OUT/reconstruction"
l3r-prep cameras tartanair --raw "$OUT/raw" --scenes '*/P002' --frame-step 10 \
    --out "$OUT/walk.json"
stage score l3r eval poses --pred "$OUT/reconstruction" --gt "$OUT/walk.json"

python demo/summary.py "$OUT"
