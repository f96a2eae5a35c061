"""The jobs behind ``l3r weights`` and ``train.init``: files of weights in, checkpoints out."""

import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import torch

from l3r.config import ModelConfig, RunConfig, from_plain, override_config
from l3r.config.check import require
from l3r.errors import CheckpointError, ConfigError
from l3r.inference.checkpoint import write_model
from l3r.model.light3r import Light3R
from l3r.model.official import is_official, official_source
from l3r.model.transfer import (
    ROOMS,
    Transfer,
    WeightSource,
    count_parameters,
    fill_network,
    plan_transfer,
    require_weights,
)
from l3r.model.weight_files import is_own, network_weights, read_weight_file
from l3r.model.weights import printable

FREE_SETTINGS = ("model.alignment.", "model.image_size=", "graph.", "inference.")
"""What the file does not settle: everything else of the network is what its weights are."""


def open_weights(path: Path) -> WeightSource:
    """Open any file of weights: ours or official, file or folder.

    Raises:
        CheckpointError: Missing, damaged, or of another kind.
    """
    content = read_weight_file(path, mapped=True)
    if is_own(content):
        return _own_source(path, content)
    if is_official(content):
        return official_source(path, content)
    raise CheckpointError(
        f"{path}: neither a Light3R checkpoint nor an official DUSt3R, MASt3R or CroCo v2 file; it "
        f"holds {', '.join(map(printable, sorted(content)[:3]))}"
    )


def import_official(
    path: Path,
    out: Path,
    settings: Sequence[str] = (),
    *,
    head: Literal["linear", "dpt"] | None = None,
    seed: int = 0,
    overwrite: bool = False,
) -> str:
    """Turn an official file into a Light3R checkpoint.

    DUSt3R's and MASt3R's answer for pairs as the original where the alignment starts as the
    identity (``output: zero_linear``).

    Args:
        path: The official file or folder.
        out: The checkpoint to write.
        settings: ``key=value`` of ``FREE_SETTINGS``.
        head: Heads to make for a file that has none; ``linear`` by default.
        seed: Of the parts that the file lacks.
        overwrite: Whether an existing ``out`` is replaced.

    Returns:
        What was loaded, created and ignored, to print.

    Raises:
        CheckpointError: The file cannot be used; nothing is written then.
        ConfigError: A setting cannot be used, or ``out`` exists.
    """
    if out.is_dir() or (out.exists() and not overwrite):
        hint = "give a file name" if out.is_dir() else "take another name, or --force to replace it"
        raise ConfigError(f"--out {out}: exists already; {hint}")
    require(0 <= seed < 2**63, "--seed", seed, "0 to 2^63 - 1")
    source = open_weights(path)
    if not source.is_official:
        raise CheckpointError(
            f"{path}: this is already a {source.kind}, which is read as it is; expected an "
            "official DUSt3R, MASt3R or CroCo v2 file"
        )
    config = _import_config(source, settings, head)
    # Names and shapes are compared before anything of the configured size takes memory.
    transfer = _plan(source, config)
    config.train.note = _import_note(source, transfer, config.model)
    torch.manual_seed(seed)
    model = Light3R(config.model, config.graph)
    fill_network(model, transfer, source)
    write_model(out, model, config)
    return f"{source.kind}\n\n{transfer.to_table()}\n{_wrap(config.train.note)}\n"


def initialise(model: Light3R, path: Path) -> str:
    """Fill a network that is about to be trained.

    Parts that the file lacks, or has in another form (heads, alignment), stay fresh.

    Args:
        model: The network.
        path: Any file of weights.

    Returns:
        What was loaded, stayed fresh and was ignored, to print.

    Raises:
        CheckpointError: The file cannot be used.
    """
    source = open_weights(path)
    transfer = plan_transfer(source, model, model.config)
    fill_network(model, transfer, source)
    note = f"\n{_wrap(source.note)}\n" if source.note else ""
    return f"train.init={path}: {source.kind}\n\n{transfer.to_table()}{note}"


def describe_weights(path: Path) -> str:
    """Say what a file of weights is, and what of an official one an import would take.

    Raises:
        CheckpointError: It is none.
    """
    source = open_weights(path)
    config = source.config
    stored = [value for key, value in source.weights.items() if key not in source.copied]
    entries = len(stored) + sum(row.num_entries for row in source.leftover)
    parameters = count_parameters(stored) + sum(row.num_parameters for row in source.leftover)
    facts = {
        "kind": source.kind,
        "form": "folder of config.json, model.safetensors" if path.is_dir() else "one file",
        "encoder": _blocks(config.encoder),
        "decoder": _blocks(config.decoder),
        "heads": config.head if "parent_head" in source.rooms else "none",
        "image size": "{} x {} (height x width)".format(*config.image_size),
        "weights": f"{entries:,} entries, {parameters:,} parameters",
        "stored as": ", ".join(sorted({str(v.dtype).removeprefix("torch.") for v in stored})),
    }
    if not source.is_official:
        form = config.alignment
        facts["alignment"] = f"{form.num_blocks} blocks, {form.num_heads} heads, {form.output}"
    if source.step is not None:
        facts["step"] = f"{source.step:,}"
    lines = [str(path), *(f"  {name:<10}  {value}" for name, value in facts.items())]
    if source.is_official:
        transfer = _plan(source, _import_config(source, (), None))
        lines += ["", "'l3r weights import' would do this:", "", transfer.to_table().rstrip("\n")]
    if source.note:
        lines += ["", _wrap(source.note)]
    return "\n".join(lines).rstrip("\n") + "\n"


def _own_source(path: Path, content: Mapping[str, Any]) -> WeightSource:
    """Sort out a checkpoint or a folder of ours."""
    config = from_plain(content["l3r_config"], str(path))
    has_alignment = config.model.alignment.num_blocks > 0
    step = content.get("global_step")
    kind = "Light3R folder" if path.is_dir() else "Light3R checkpoint"
    return WeightSource(
        where=str(path),
        kind="Light3R training checkpoint" if isinstance(step, int) else kind,
        config=config.model,
        rooms=frozenset(room for room in ROOMS if room != "alignment" or has_alignment),
        weights=require_weights(network_weights(content), str(path)),
        step=step if isinstance(step, int) else None,
        note=config.train.note,
    )


def _import_config(
    source: WeightSource, settings: Sequence[str], head: Literal["linear", "dpt"] | None
) -> RunConfig:
    """Make the configuration of the checkpoint to write."""
    model = source.config
    if head is not None:
        if "parent_head" in source.rooms and head != model.head:
            raise ConfigError(
                f"--head {head}: {source.where} holds {model.head} heads; to start {head} heads "
                f"from its other weights, train with model.head={head} train.init={source.where}"
            )
        model = replace(model, head=head)
    for setting in settings:
        if not setting.startswith(FREE_SETTINGS):
            raise ConfigError(
                f"override '{setting}': expected key=value of model.alignment, model.image_size, "
                "graph or inference; the rest is in the file"
            )
    return override_config(RunConfig(model=model), settings, ("model", "graph", "inference"))


def _plan(source: WeightSource, config: RunConfig) -> Transfer:
    with torch.device("meta"):
        outline = Light3R(config.model, config.graph)
    return plan_transfer(source, outline, config.model)


def _import_note(source: WeightSource, transfer: Transfer, config: ModelConfig) -> str:
    fresh = [row for row in transfer.rows if row.fate == "fresh"]
    parts = ", ".join(f"{row.part.replace('_', ' ')} ({row.remark})" for row in fresh)
    untrained = f"; untrained: {parts}" if parts else ""
    name = Path(source.where).name.replace("${", "$ {")  # which would stand for a variable
    return f"imported from {name}, {source.kind}{untrained}; {source.note}"


def _wrap(note: str) -> str:
    shown = "".join(character for character in note if character.isprintable())
    return textwrap.fill(f"about these weights: {shown}", 80, break_on_hyphens=False)


def _blocks(config: Any) -> str:
    return f"width {config.width}, {config.depth} blocks, {config.num_heads} heads"
