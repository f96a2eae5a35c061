"""Names of the weights in official DUSt3R checkpoints with linear heads."""

from collections.abc import Collection, Mapping

from torch import Tensor

from l3r.errors import CheckpointError

OFFICIAL_PREFIX = {
    "encoder.patch_embed.": "patch_embed.proj.",
    "encoder.blocks.": "enc_blocks.",
    "encoder.norm.": "enc_norm.",
    "decoder.embed.": "decoder_embed.",
    "decoder.parent_blocks.": "dec_blocks.",
    "decoder.child_blocks.": "dec_blocks2.",
    "decoder.norm.": "dec_norm.",
    "parent_head.": "downstream_head1.",
    "child_head.": "downstream_head2.",
}
"""Official name of every part of ours; inside a part the names agree."""

UNUSED_OFFICIAL_KEYS = frozenset({"mask_token"})
"""In the official files, but read by no step of theirs: ours has none."""

MAX_LISTED_KEYS = 3


def official_key(key: str) -> str | None:
    """Translate a key of our state dict; None for the latent alignment, which theirs lacks."""
    return _with_other_prefix(key, OFFICIAL_PREFIX)


def own_key(key: str) -> str | None:
    """Translate a key of an official state dict; None for one that belongs to no part of ours."""
    return _with_other_prefix(key, {theirs: ours for ours, theirs in OFFICIAL_PREFIX.items()})


def state_dict_from_official(
    official: Mapping[str, Tensor], expected: Collection[str]
) -> dict[str, Tensor]:
    """Rename the weights of an official checkpoint.

    Args:
        official: Its state dict.
        expected: Keys of the model to fill; those of the latent alignment stay out of the result.

    Returns:
        The same tensors under our names: all of ``expected`` that an official file can have.

    Raises:
        CheckpointError: Weights are missing, or there are some that the model has no place for.
    """
    wanted = {theirs: ours for ours in expected if (theirs := official_key(ours)) is not None}
    found = set(official) - UNUSED_OFFICIAL_KEYS
    _refuse(wanted.keys() - found, "lacks")
    _refuse(found - wanted.keys(), "has unknown")
    return {ours: official[theirs] for theirs, ours in wanted.items()}


def _with_other_prefix(key: str, prefixes: Mapping[str, str]) -> str | None:
    for prefix, other in prefixes.items():
        if key.startswith(prefix):
            return other + key.removeprefix(prefix)
    return None


def _refuse(keys: Collection[str], verb: str) -> None:
    if keys:
        listed = ", ".join(sorted(keys)[:MAX_LISTED_KEYS])
        more = ", .." if len(keys) > MAX_LISTED_KEYS else ""
        raise CheckpointError(
            f"the official checkpoint {verb} {len(keys)} weights ({listed}{more}), expected those "
            "of a model of the configured depths with linear heads; check the model's configuration"
        )
