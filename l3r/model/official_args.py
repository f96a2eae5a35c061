"""What an official checkpoint says of its network: parsed, never evaluated."""

import ast
import math
import re
from collections.abc import Mapping
from typing import Any, Literal

from l3r.config import DecoderConfig, EncoderConfig, ModelConfig
from l3r.errors import CheckpointError, ConfigError
from l3r.model.weights import printable

CROCO = "CroCoNet"
KINDS: dict[tuple[str, str | None], tuple[str, Literal["linear", "dpt"] | None]] = {
    ("AsymmetricCroCo3DStereo", "linear"): ("DUSt3R, linear heads", "linear"),
    ("AsymmetricCroCo3DStereo", "dpt"): ("DUSt3R, DPT heads", "dpt"),
    ("AsymmetricMASt3R", "catmlp+dpt"): ("MASt3R, DPT heads and descriptors", "dpt"),
    (CROCO, None): ("CroCo v2, no heads", None),
}
"""What a class with a ``head_type`` is, and its heads."""

SIZES = (
    "enc_embed_dim",
    "enc_depth",
    "enc_num_heads",
    "dec_embed_dim",
    "dec_depth",
    "dec_num_heads",
)
ALWAYS = {"mlp_ratio": 4, "patch_size": 16, "norm_im2_in_dec": True, "pos_embed": "RoPE100"}
"""What all supported networks have; CroCo v1 has other positions."""
ALWAYS_OF_HEADS = {
    "depth_mode": ("exp", -math.inf, math.inf),
    "conf_mode": ("exp", 1, math.inf),
}
"""The output activations of all released networks."""
WITHOUT_EFFECT = {
    "patch_embed_cls": ("PatchEmbedDust3R", "ManyAR_PatchEmbed"),
    "landscape_only": (True, False),
    "freeze": ("none", "mask", "encoder"),
    "two_confs": (True, False),
    "desc_mode": None,
    "desc_conf_mode": None,
    "mask_ratio": None,
}
"""What the point maps of an image in its own orientation do not depend on; None: any value."""
HEIGHT_OF_512 = 384
"""An ``img_size`` of 512 x 512 stands for landscapes of 512 x 384 at most."""
MAX_LENGTH = 10_000
MAX_BITS = 64
"""Of a whole number; Python refuses to print those of thousands of digits."""


def parse_constructor(text: object) -> tuple[str, dict[str, Any]]:
    """Read ``Name(key=value, ..)`` without evaluating it.

    Args:
        text: ``args.model`` of a checkpoint. A bare ``inf`` stands for infinity.

    Returns:
        The name and the arguments, in any order.

    Raises:
        CheckpointError: It is no such text, or a value is no literal.
    """
    if not isinstance(text, str) or len(text) > MAX_LENGTH:
        found = _shorten(text) if isinstance(text, str) else f"a {type(text).__name__}"
        raise CheckpointError(f"args.model is {found}, expected a constructor call")
    try:
        call = ast.parse(re.sub(r"\binf\b", "1e999", text.strip()), mode="eval").body
        if not isinstance(call, ast.Call) or not isinstance(call.func, ast.Name) or call.args:
            raise ValueError
        if any(keyword.arg is None for keyword in call.keywords):
            raise ValueError
        values = {str(word.arg): ast.literal_eval(word.value) for word in call.keywords}
    except (SyntaxError, ValueError, TypeError, MemoryError, RecursionError) as error:
        raise CheckpointError(
            f"args.model is {_shorten(text)}, expected a constructor call with literal keyword "
            "arguments; nothing of it was evaluated"
        ) from error
    return call.func.id, values


def guess_class(settings: Mapping[str, Any]) -> str:
    """Name the class that a ``config.json`` belongs to, which does not say so itself."""
    match settings.get("head_type"):
        case None:
            return CROCO
        case "catmlp+dpt":
            return "AsymmetricMASt3R"
        case _:
            return "AsymmetricCroCo3DStereo"


def describe_network(name: str, settings: Mapping[str, Any]) -> tuple[str, ModelConfig, bool]:
    """Turn official settings into ours.

    Args:
        name: Class of the network.
        settings: Its arguments; lists and tuples are alike.

    Returns:
        What it is in words, its sizes, and whether it has heads: if not, ``head`` is ``linear``.

    Raises:
        CheckpointError: A setting is missing, unknown, no plain value, or not that of the released
            networks.
    """
    given = {key: _plain(key, value) for key, value in settings.items()}
    head_type = given.pop("head_type", None)
    found = KINDS.get((name, head_type if isinstance(head_type, str) else None))
    if found is None or (head_type is not None and not isinstance(head_type, str)):
        known = ", ".join(f"{cls} with {head}" if head else cls for cls, head in KINDS)
        raise CheckpointError(
            f"is a network of class {name:.40} with head_type {_shorten(head_type)}, expected one "
            f"of: {known}"
        )
    kind, head = found
    _check_settings(given, with_heads=head is not None, is_mast3r="MASt3R" in name)
    sizes = {key: _positive(key, given[key]) for key in SIZES}
    try:
        config = ModelConfig(
            encoder=EncoderConfig(
                width=sizes["enc_embed_dim"],
                depth=sizes["enc_depth"],
                num_heads=sizes["enc_num_heads"],
            ),
            decoder=DecoderConfig(
                width=sizes["dec_embed_dim"],
                depth=sizes["dec_depth"],
                num_heads=sizes["dec_num_heads"],
            ),
            head=head or "linear",
            image_size=_image_size(given.get("img_size", 224)),
        )
    except ConfigError as error:
        raise CheckpointError(str(error)) from error
    return kind, config, head is not None


def _check_settings(given: Mapping[str, Any], *, with_heads: bool, is_mast3r: bool) -> None:
    """Refuse settings under which the weights mean something else, or may."""
    expected = {**ALWAYS, **(ALWAYS_OF_HEADS if with_heads else {})}
    required = {*SIZES, "pos_embed"}
    if with_heads:
        required |= {"img_size", "output_mode", *ALWAYS_OF_HEADS}
    if missing := sorted(required - given.keys()):
        raise CheckpointError(
            f"its settings lack {', '.join(missing)}, expected those of a released DUSt3R, MASt3R "
            "or CroCo v2 network"
        )
    known = required | expected.keys() | WITHOUT_EFFECT.keys() | {"img_size"}
    if unknown := sorted(str(key) for key in given.keys() - known):
        raise CheckpointError(
            f"its settings have an unknown {printable(unknown[0])}, expected those of a released "
            "network"
        )
    for key, value in expected.items():
        if key in given and given[key] != value:
            raise CheckpointError(
                f"{key} is {_shorten(given[key])}, expected {value!r} as all supported networks "
                "have (CroCo v1 has not)"
            )
    for key, values in WITHOUT_EFFECT.items():
        if values is not None and key in given and given[key] not in values:
            raise CheckpointError(f"{key} is {_shorten(given[key])}, expected one of {values}")
    mode = re.compile(r"pts3d\+desc\d+" if is_mast3r else "pts3d")
    if with_heads and not mode.fullmatch(str(given["output_mode"])):
        shown = "pts3d+desc24" if is_mast3r else "pts3d"
        raise CheckpointError(
            f"output_mode is {_shorten(given['output_mode'])}, expected '{shown}'"
        )


def _image_size(value: object) -> list[int]:
    """[height, width] to train and reconstruct at."""
    sides = list(value) if isinstance(value, tuple) else [value, value]
    if len(sides) != 2:
        raise CheckpointError(f"img_size is {_shorten(value)}, expected two numbers")
    height, width = (_positive("img_size", side) for side in sides)
    return [HEIGHT_OF_512, 512] if (height, width) == (512, 512) else [height, width]


def _positive(key: str, value: object) -> int:
    if type(value) is not int or value < 1:
        raise CheckpointError(f"{key} is {_shorten(value)}, expected a positive whole number")
    return value


def _plain(key: object, value: Any) -> Any:
    """Let through what can be compared and shown: single values, and flat lists as tuples."""
    is_list = isinstance(value, list | tuple)
    items = tuple(value) if is_list else (value,)
    for item in items:
        if isinstance(item, int) and item.bit_length() > MAX_BITS:
            found = f"a number of {item.bit_length()} bits"
        elif item is not None and not isinstance(item, int | float | str):
            found = f"a {type(item).__name__}"
        else:
            continue
        held = f"a {type(value).__name__} that holds {found}" if is_list else found
        raise CheckpointError(
            f"{printable(key)} is {held}, expected a number, a text or a list of them"
        )
    return items if is_list else value


def _shorten(value: object) -> str:
    shown = " ".join(repr(value).split())
    return shown if len(shown) <= 80 else shown[:77] + ".."
