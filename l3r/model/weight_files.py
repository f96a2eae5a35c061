"""Files of weights: read without executing anything in them, written whole or not at all."""

import argparse
import json
import pickle
import re
import struct
import zipfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file, save_file
from torch import Tensor

from l3r.errors import CheckpointError
from l3r.files import atomic_path, write_atomic
from l3r.model.weights import printable

MODEL_PREFIX = "model."
"""Where the network's weights stand in a Light3R checkpoint."""
AVERAGE_KEY = "average"
"""Where the moving average of the weights stands, if the training kept one."""
CONFIG_NAME, WEIGHTS_NAME = "config.json", "model.safetensors"
"""What a folder of the Hugging Face form holds."""

_UNREADABLE = (
    pickle.UnpicklingError,
    struct.error,
    zipfile.BadZipFile,
    SafetensorError,
    ArithmeticError,
    AssertionError,
    AttributeError,
    EOFError,
    LookupError,
    MemoryError,
    OSError,
    RuntimeError,
    TypeError,
    ValueError,
)
"""What the readers raise on bytes that are something else."""


def read_weight_file(path: Path, *, mapped: bool = False) -> dict[str, Any]:
    """Read any file or folder of weights; nothing in it is executed.

    Args:
        path: A checkpoint (a zip archive of torch), or a folder of ``config.json`` and
            ``model.safetensors``.
        mapped: Leave the weights of a checkpoint on the disk until they are used.

    Returns:
        What a checkpoint holds. A folder of ours comes in the form of our checkpoints
        (``l3r_config``, ``state_dict``, ``l3r_version``), another one as ``config`` and ``model``.

    Raises:
        CheckpointError: Missing, damaged, or of another kind.
    """
    if path.is_dir():
        return _read_folder(path)
    if not path.is_file():
        raise CheckpointError(
            f"{path}: no such file or folder; expected a checkpoint, or a folder of {CONFIG_NAME} "
            f"and {WEIGHTS_NAME}"
        )
    with _refuse_unreadable(path, "a checkpoint of torch"):
        _check_archive(path)
        # A Namespace is a plain holder of values; official checkpoints keep their arguments in one.
        with torch.serialization.safe_globals([argparse.Namespace]):
            content = torch.load(path, map_location="cpu", weights_only=True, mmap=mapped)
        if not isinstance(content, dict) or not all(isinstance(key, str) for key in content):
            raise TypeError(f"holds a {type(content).__name__}")
        return content


def is_own(content: Mapping[str, Any]) -> bool:
    """Tell whether what was read is a checkpoint, or a folder, of ours."""
    return not _missing_of_own(content)


def require_own(content: Mapping[str, Any], where: str) -> None:
    """Refuse what was read if it is not ours.

    Args:
        content: What :func:`read_weight_file` gave.
        where: The file, for the message.

    Raises:
        CheckpointError: It is another file; an official one can be imported.
    """
    if is_own(content):
        return
    if "model" in content:
        raise CheckpointError(
            f"{where}: this looks like an official DUSt3R, MASt3R or CroCo file; make it a Light3R "
            f"checkpoint: l3r weights import {where} --out init.ckpt"
        )
    missing = " and no ".join(_missing_of_own(content))
    raise CheckpointError(f"{where}: no {missing} inside; expected a checkpoint of 'l3r train'")


def network_weights(content: Mapping[str, Any]) -> dict[str, Any]:
    """Take the network's state dict out of what :func:`require_own` let through.

    Where the training kept a moving average of the weights, that is the network.
    """
    average = content.get(AVERAGE_KEY)
    state = content["state_dict"] | (average if isinstance(average, dict) else {})
    return {
        key.removeprefix(MODEL_PREFIX): value
        for key, value in state.items()
        if isinstance(key, str) and key.startswith(MODEL_PREFIX)
    }


def write_checkpoint(path: Path, content: Mapping[str, Any]) -> None:
    """Write a checkpoint straight to the disk: it is not held in memory a second time."""
    path.parent.mkdir(parents=True, exist_ok=True)
    # A stream, since torch would put the temporary name inside the archive.
    with atomic_path(path) as temporary, temporary.open("wb") as stream:
        torch.save(dict(content), stream)


def write_folder(
    folder: Path, config: Mapping[str, Any], weights: Mapping[str, Tensor], version: str
) -> None:
    """Write a folder of ours in the Hugging Face form.

    Args:
        folder: Made if need be; other files in it stay.
        config: Sections of the configuration, as builtins.
        weights: The network's state dict.
        version: Of this package.
    """
    folder.mkdir(parents=True, exist_ok=True)
    plain = json.dumps({"l3r_version": version, **config}, indent=2, allow_nan=False) + "\n"
    with atomic_path(folder / WEIGHTS_NAME) as temporary:
        # Safetensors knows one memory layout; convolutions may be stored in another.
        save_file({key: value.detach().contiguous() for key, value in weights.items()}, temporary)
    write_atomic(folder / CONFIG_NAME, plain)


def _missing_of_own(content: Mapping[str, Any]) -> list[str]:
    return [key for key in ("l3r_config", "state_dict") if not isinstance(content.get(key), dict)]


def _read_folder(folder: Path) -> dict[str, Any]:
    for name in (CONFIG_NAME, WEIGHTS_NAME):
        if not (folder / name).is_file():
            raise CheckpointError(
                f"{folder}: no {name} inside; expected a folder of {CONFIG_NAME} and {WEIGHTS_NAME}"
            )
    with _refuse_unreadable(folder / CONFIG_NAME, "a JSON object of settings"):
        config = json.loads((folder / CONFIG_NAME).read_text(encoding="utf-8"))
        if not isinstance(config, dict):
            raise TypeError(f"holds a {type(config).__name__}")
    with _refuse_unreadable(folder / WEIGHTS_NAME, "weights in the safetensors format"):
        weights = load_file(folder / WEIGHTS_NAME)
    if "l3r_version" not in config:
        return {"config": config, "model": weights}
    version = config.pop("l3r_version")
    prefixed = {MODEL_PREFIX + key: value for key, value in weights.items()}
    return {"l3r_config": config, "state_dict": prefixed, "l3r_version": version}


def _check_archive(path: Path) -> None:
    """Refuse what torch would not notice: bare pickles, compressed entries, flipped bits."""
    if not zipfile.is_zipfile(path):
        raise ValueError("no zip archive, or cut off")
    with zipfile.ZipFile(path) as archive:
        if any(entry.compress_type != zipfile.ZIP_STORED for entry in archive.infolist()):
            raise ValueError("a compressed archive, torch's are not")
        if (damaged := archive.testzip()) is not None:
            raise ValueError(f"its entry {printable(damaged)} does not match its checksum")


@contextmanager
def _refuse_unreadable(path: Path, expected: str) -> Iterator[None]:
    try:
        yield
    except _UNREADABLE as error:
        # Of torch's refusal of a pickle, what it found matters; the advice to trust it does not.
        found = re.search(r"GLOBAL ([\w.]+)", str(error))
        first = str(error).split("\n")[0].split(". ")[0]
        reason = f"it holds {found[1]}, which is no weight" if found else first
        raise CheckpointError(
            f"{path}: cannot be read safely ({reason}); expected {expected}; fetch or write it "
            "again"
        ) from error
