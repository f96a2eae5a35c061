"""A training run small enough for a test, and its log."""

import csv

TINY = [
    "configs/base.yaml",
    "model.image_size=[16,16]",
    "model.encoder.patch_size=8",
    "model.encoder.width=16",
    "model.encoder.depth=1",
    "model.encoder.num_heads=2",
    "model.decoder.width=16",
    "model.decoder.depth=1",
    "model.decoder.num_heads=2",
    "model.alignment.num_blocks=1",
    "model.alignment.num_heads=2",
    "data.num_views=3",
    "data.graphs_per_step=2",
    "data.num_workers=0",
    "data.color_jitter=[0,0,0,0]",
    "train.accelerator=cpu",
    "train.lr=1e-2",
    "train.log_every=1",
    "train.checkpoint_every=5",
    "train.validate_every=5",
    "train.validation_graphs=2",
]


def layers(shards, folder, **train):
    sources = [f"data.sources.hand.shards={shards}", f"data.validation.hand.shards={shards}"]
    changes = [f"train.{key}={value}" for key, value in train.items()]
    return [*TINY, *sources, f"train.output_dir={folder}", *changes]


def read_log(folder, name="metrics.csv"):
    with (folder / name).open(newline="") as stream:
        return list(csv.DictReader(stream))


def losses(folder):
    return {int(row["step"]): (row["loss"], row["grad_norm"]) for row in read_log(folder)}
