"""The whole job behind ``l3r reconstruct``: photos and a checkpoint in, a folder out."""

import sys
import time
from collections.abc import Sequence
from pathlib import Path

import torch

from l3r.config import to_plain
from l3r.errors import ConfigError
from l3r.export.write import check_output, write_reconstruction
from l3r.graph.diagnostics import diagnose_tree
from l3r.inference.checkpoint import load_model_and_config
from l3r.inference.clock import StageClock
from l3r.inference.photos import find_photos, load_photos
from l3r.inference.reconstruct import reconstruct_photos
from l3r.types import Reconstruction


def choose_device(name: str) -> torch.device:
    """Choose where to compute.

    Args:
        name: ``auto``, or a device as torch names it.

    Raises:
        ConfigError: There is no such device here.
    """
    if name == "auto":
        name = "cuda" if torch.cuda.is_available() else "cpu"
    try:
        device = torch.device(name)
        torch.empty(0, device=device)
    except (RuntimeError, AssertionError) as error:
        reason = str(error).split("\n")[0]
        raise ConfigError(f"--device {name}: {reason}; expected auto, cpu or cuda") from error
    return device


def reconstruct_folder(
    photos: Path,
    checkpoint: Path,
    out: Path,
    *,
    device: str = "auto",
    settings: Sequence[str] = (),
) -> str:
    """Reconstruct a folder of photos and write everything a reconstruction leaves behind.

    Args:
        photos: Folder of images, searched with its sub-folders.
        checkpoint: Weights and configuration.
        out: Folder to write; an older reconstruction there is replaced.
        device: ``auto``, ``cpu`` or ``cuda``.
        settings: ``inference.key=value`` and ``graph.key=value`` over the checkpoint's.

    Returns:
        A summary to print.

    Raises:
        L3RError: See the parts; nothing is written then.
    """
    began = time.perf_counter()
    check_output(out)
    files = find_photos(photos, besides=out)
    clock = StageClock(choose_device(device))
    with clock.stage("model"):
        model, config = load_model_and_config(checkpoint, clock.device, settings)
    with clock.stage("load"):
        loaded = load_photos(files, model.config, photos, crop=config.inference.crop)
    scene = reconstruct_photos(model, loaded.photos, config.inference, clock)
    diagnostics = diagnose_tree(scene.tree, scene.scores, scene.residual)
    warnings = [*diagnostics.warnings(), *_scene_warnings(scene, config.train.note)]
    write_reconstruction(
        out,
        scene,
        diagnostics=diagnostics.to_plain(),
        config=to_plain(config),
        command=sys.argv,
        skipped=loaded.skipped,
        warnings=warnings,
        upright=loaded.upright,
        device=str(clock.device),
    )
    return _summary(scene, out, warnings, time.perf_counter() - began)


def _scene_warnings(scene: Reconstruction, note: str) -> list[str]:
    """Say what a user should not overlook."""
    shown = "".join(character for character in note if character.isprintable())
    warnings = [f"about these weights: {shown}"] if shown else []
    cut_off = [
        1 - window.width * window.height / (height * width)
        for window, (height, width) in zip(scene.window, scene.cameras.image_size, strict=True)
    ]
    if (largest := max(cut_off)) > 0:
        warnings.append(
            f"inference.crop=official cut off up to {largest:.1%} of a photo "
            f"({scene.cameras.file[cut_off.index(largest)]})"
        )
    if missing := int((~scene.cameras.registered).sum()):
        warnings.append(f"{missing} of {len(scene.image)} images could not be registered")
    if weak := scene.point_rule.count("quantile"):
        warnings.append(
            f"{weak} of {len(scene.image)} images have too few confident points; their most "
            "confident ones were used"
        )
    if parts := int(scene.cameras.component.max()):
        warnings.append(f"the scene falls into {parts + 1} parts whose relation is uncertain")
    return warnings


def _summary(scene: Reconstruction, out: Path, warnings: Sequence[str], seconds: float) -> str:
    """Lay out the closing message."""
    registered = int(scene.cameras.registered.sum())
    lines = [f"{registered} of {len(scene.image)} images registered in {seconds:.1f} s"]
    lines += [f"warning: {line}" for line in warnings]
    lines.append(f"look at {out / 'report.html'}")
    return "\n".join(lines) + "\n"
