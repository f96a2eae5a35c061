"""Names of the weights in official DUSt3R, MASt3R and CroCo v2 checkpoints."""

import re
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from l3r.errors import CheckpointError

DPT_PREFIX = {
    **{f"stages.{i}.project.": f"act_postprocess.{i}.0." for i in range(4)},
    **{f"stages.{i}.resample.": f"act_postprocess.{i}.1." for i in range(4)},
    **{f"stages.{i}.reduce.": f"scratch.layer{i + 1}_rn." for i in range(4)},
    **{f"fusions.{i}.skip.": f"scratch.refinenet{i + 1}.resConfUnit1." for i in range(3)},
    **{f"fusions.{i}.refine.": f"scratch.refinenet{i + 1}.resConfUnit2." for i in range(4)},
    **{f"fusions.{i}.project.": f"scratch.refinenet{i + 1}.out_conv." for i in range(4)},
    "reduce.": "head.0.",
    "refine.": "head.2.",
    "out.": "head.4.",
}
"""Official name of every part of our DPT head."""

OFFICIAL_PREFIX = {
    "encoder.patch_embed.": "patch_embed.proj.",
    "encoder.blocks.": "enc_blocks.",
    "encoder.norm.": "enc_norm.",
    "decoder.embed.": "decoder_embed.",
    "decoder.parent_blocks.": "dec_blocks.",
    "decoder.child_blocks.": "dec_blocks2.",
    "decoder.norm.": "dec_norm.",
    "parent_head.proj.": "downstream_head1.proj.",
    "child_head.proj.": "downstream_head2.proj.",
    **{f"parent_head.{ours}": f"downstream_head1.dpt.{dpt}" for ours, dpt in DPT_PREFIX.items()},
    **{f"child_head.{ours}": f"downstream_head2.dpt.{dpt}" for ours, dpt in DPT_PREFIX.items()},
}
"""Official name of every part of ours; inside a part the names agree."""

IGNORED_FAMILIES = {
    "mask_token": (re.compile(r"mask_token"), "CroCo's pre-training"),
    "prediction_head": (re.compile(r"prediction_head\.(weight|bias)"), "CroCo's pre-training"),
    "refinenet4.resConfUnit1": (
        re.compile(
            r"downstream_head[12]\.dpt\.scratch\.refinenet4\.resConfUnit1\.conv[12]\.(weight|bias)"
        ),
        "no step reads it",
    ),
    "head_local_features": (
        re.compile(r"downstream_head[12]\.head_local_features\.fc[12]\.(weight|bias)"),
        "MASt3R's descriptors",
    ),
}
"""What point maps do not depend on: the keys of each family, and what it is for."""

ALIAS = re.compile(r"(downstream_head[12]\.dpt\.scratch\.)layer_rn\.([0-3])\.weight")
"""A second name that the official DPT head has for its ``scratch.layer{1..4}_rn.weight``."""

MAX_LISTED_KEYS = 3


@dataclass(frozen=True, kw_only=True)
class Translation:
    """An official state dict sorted out."""

    weights: dict[str, Tensor]
    """All that is ours, under our names."""
    copied: frozenset[str]
    """Of these names, those that the file lacks: the child's stream, equal to the parent's."""
    aliases: tuple[str, ...]
    """Official keys that name a tensor a second time."""
    ignored: dict[str, dict[str, Tensor]]
    """By family, under their official names."""


def official_key(key: str) -> str | None:
    """Translate a key of our state dict; None for the latent alignment, which theirs lacks."""
    return _with_other_prefix(key, OFFICIAL_PREFIX)


def own_key(key: str) -> str | None:
    """Translate a key of an official state dict; None for one that belongs to no part of ours."""
    return _with_other_prefix(key, {theirs: ours for ours, theirs in OFFICIAL_PREFIX.items()})


def translate_official(official: Mapping[str, Tensor]) -> Translation:
    """Sort an official state dict into what is ours and what is not.

    The child's decoder blocks are the parent's where the file has none, as in CroCo's.

    Args:
        official: The state dict of a DUSt3R, MASt3R or CroCo v2 network.

    Raises:
        CheckpointError: A key is of no known family, or two names of one tensor disagree.
    """
    merged, aliases = _merge_aliases(official)
    weights: dict[str, Tensor] = {}
    ignored: dict[str, dict[str, Tensor]] = {}
    unknown = []
    for key, value in merged.items():
        ours, family = own_key(key), _family(key)
        if ours is not None:
            weights[ours] = value
        elif family is not None:
            ignored.setdefault(family, {})[key] = value
        else:
            unknown.append(key)
    _refuse(unknown, "has {} unknown weights")
    copied = {}
    if not any(key.startswith("decoder.child_blocks.") for key in weights):
        copied = {
            key.replace("parent_blocks", "child_blocks", 1): value
            for key, value in weights.items()
            if key.startswith("decoder.parent_blocks.")
        }
    return Translation(
        weights={**weights, **copied},
        copied=frozenset(copied),
        aliases=tuple(aliases),
        ignored=ignored,
    )


def take_weights(
    weights: Mapping[str, Tensor], expected: Collection[str], spell: Callable[[str], str | None]
) -> dict[str, Tensor]:
    """Take the weights of some rooms of a network: all of them, and no others.

    Args:
        weights: Under our names; those of rooms of which nothing is expected stay out.
        expected: Our names.
        spell: From our name to the file's, for messages.

    Raises:
        CheckpointError: Weights are missing, or these rooms have others.
    """
    rooms = {room_of(key) for key in expected}
    found = {key for key in weights if room_of(key) in rooms}
    _refuse([spell(key) or key for key in set(expected) - found], "lacks {} weights")
    _refuse([spell(key) or key for key in found - set(expected)], "has {} unknown weights")
    return {key: weights[key] for key in expected}


def room_of(key: str) -> str:
    """Name the part of the network that a weight belongs to: ``encoder``, ``parent_head``, .."""
    return key.split(".", 1)[0]


def printable(name: object) -> str:
    """Fit a name from a file into one line of a message, whatever is in it."""
    return str(name).encode("unicode_escape").decode()[:80]


def _merge_aliases(official: Mapping[str, Tensor]) -> tuple[dict[str, Tensor], list[str]]:
    """Bring every tensor under one name; also list the names that were one too many."""
    merged: dict[str, Tensor] = {}
    aliases = []
    for key, value in official.items():
        match = ALIAS.fullmatch(key)
        name = f"{match[1]}layer{int(match[2]) + 1}_rn.weight" if match else key
        other = merged.setdefault(name, value)
        if other is not value and not torch.equal(other, value):
            raise CheckpointError(
                f"{name} and its second name, scratch.layer_rn.*, hold different weights, expected "
                "one tensor; fetch the file again"
            )
        if name != key and name in official:
            aliases.append(key)
    return merged, aliases


def _family(key: str) -> str | None:
    for family, (pattern, _) in IGNORED_FAMILIES.items():
        if pattern.fullmatch(key):
            return family
    return None


def _with_other_prefix(key: str, prefixes: Mapping[str, str]) -> str | None:
    for prefix, other in prefixes.items():
        if key.startswith(prefix):
            return other + key.removeprefix(prefix)
    return None


def _refuse(keys: Collection[str], finding: str) -> None:
    if keys:
        listed = ", ".join(printable(key) for key in sorted(keys)[:MAX_LISTED_KEYS])
        more = ", .." if len(keys) > MAX_LISTED_KEYS else ""
        raise CheckpointError(
            f"{finding.format(len(keys))} ({listed}{more}), expected exactly those of the network "
            "that its configuration describes; is the file whole, and of a supported kind?"
        )
