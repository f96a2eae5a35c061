"""Official DUSt3R, MASt3R and CroCo v2 checkpoints as a source of weights."""

import argparse
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from torch import Tensor

from l3r.config import ModelConfig
from l3r.errors import CheckpointError
from l3r.model.official_args import CROCO, describe_network, guess_class, parse_constructor
from l3r.model.transfer import Row, WeightSource, build_rows, require_weights
from l3r.model.weights import IGNORED_FAMILIES, translate_official

LICENCE = (
    "they have a licence of their own: DUSt3R, MASt3R and CroCo weights are released under "
    "CC BY-NC-SA 4.0, non-commercial"
)
"""What a checkpoint made of them says to whoever uses it."""


def is_official(content: Mapping[str, Any]) -> bool:
    """Tell whether what was read has the outer form of an official file."""
    return "model" in content


def official_source(path: Path, content: Mapping[str, Any]) -> WeightSource:
    """Sort out the content of an official file.

    Args:
        path: For messages.
        content: What :func:`~l3r.model.weight_files.read_weight_file` gave: ``model`` and either
            ``args``, ``croco_kwargs`` or ``config``.

    Raises:
        CheckpointError: Not a supported network, or its weights contradict its settings.
    """
    weights = require_weights(content.get("model"), str(path))
    try:
        kind, config, has_heads = describe_network(*_settings(content))
        translation = translate_official(weights)
        _check_depths(translation.weights, config)
    except CheckpointError as error:
        raise CheckpointError(f"{path}: {error}") from error
    leftover: list[Row] = []
    for family, held in translation.ignored.items():
        leftover += build_rows(family, "ignored", held, IGNORED_FAMILIES[family][1])
    if translation.aliases:
        leftover.append(
            Row(
                part="scratch.layer_rn",
                fate="second name",
                num_entries=len(translation.aliases),
                num_parameters=0,
                remark="of scratch.layer*_rn",
            )
        )
    heads = {"parent_head", "child_head"} if has_heads else set()
    return WeightSource(
        where=str(path),
        kind=kind,
        config=config,
        rooms=frozenset({"encoder", "decoder"} | heads),
        weights=translation.weights,
        copied=translation.copied,
        leftover=tuple(leftover),
        is_official=True,
        note=LICENCE,
    )


def _settings(content: Mapping[str, Any]) -> tuple[str, Mapping[str, Any]]:
    """Find the class and the arguments of the network."""
    if isinstance(content.get("config"), dict):
        return guess_class(content["config"]), content["config"]
    if isinstance(content.get("croco_kwargs"), dict):
        return CROCO, content["croco_kwargs"]
    args = content.get("args")
    if not isinstance(args, argparse.Namespace):
        raise CheckpointError(
            "neither args nor croco_kwargs inside, so its sizes are unknown (CroCo v1 is like "
            "that); expected a DUSt3R, MASt3R or CroCo v2 checkpoint"
        )
    return parse_constructor(getattr(args, "model", None))


def _check_depths(weights: Mapping[str, Tensor], config: ModelConfig) -> None:
    """Compare sizes with the weights before anything of these sizes is built."""
    for part, blocks, sizes in (
        ("enc", "encoder.blocks", config.encoder),
        ("dec", "decoder.parent_blocks", config.decoder),
    ):
        depth = len({key.split(".")[2] for key in weights if key.startswith(blocks + ".")})
        norm = weights.get(f"{blocks.split('.')[0]}.norm.weight")
        width = None if norm is None else norm.numel()
        if (depth, width) != (sizes.depth, sizes.width):
            raise CheckpointError(
                f"its settings say {part}_depth {sizes.depth} and {part}_embed_dim {sizes.width}, "
                f"its weights have {depth} blocks and width {width}; fetch the file again"
            )
