"""Folders of weights on the Hugging Face hub; needs the extra ``hub``."""

import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import cast

from l3r.errors import CheckpointError

RELEASED = {
    "mast3r-512": "naver/MASt3R_ViTLarge_BaseDecoder_512_catmlpdpt_metric",
    "dust3r-512-dpt": "naver/DUSt3R_ViTLarge_BaseDecoder_512_dpt",
    "dust3r-512-linear": "naver/DUSt3R_ViTLarge_BaseDecoder_512_linear",
    "dust3r-224-linear": "naver/DUSt3R_ViTLarge_BaseDecoder_224_linear",
}
"""Short names of what ``l3r weights import`` reads."""
WANTED = ("config.json", "model.safetensors", "README*", "LICENSE*")
"""Nothing else of a repository is fetched."""
HUB_ID = re.compile(r"[\w.-]+/[\w.-]+")
"""``owner/name``."""


def fetch_folder(hub_id: str, folder: Path | None = None) -> Path:
    """Fetch the weights of a repository.

    Args:
        hub_id: ``owner/name``.
        folder: Where to; by default the hub's own cache.

    Returns:
        A folder of ``config.json`` and ``model.safetensors``.

    Raises:
        CheckpointError: No such name, no network, or huggingface_hub is not installed.
    """
    if not HUB_ID.fullmatch(hub_id):
        raise CheckpointError(f"{hub_id}: expected owner/name, as the hub calls a repository")
    with _hub_errors(hub_id, "fetched"):
        from huggingface_hub import snapshot_download

        return Path(snapshot_download(hub_id, local_dir=folder, allow_patterns=list(WANTED)))


def publish_folder(folder: Path, hub_id: str, *, private: bool) -> str:
    """Put a folder on the hub, in a repository that is made if need be.

    Args:
        folder: What to upload.
        hub_id: ``owner/name``.
        private: Whether a new repository is visible to its owner alone.

    Returns:
        Its address.

    Raises:
        CheckpointError: Not signed in, no network, or huggingface_hub is not installed.
    """
    with _hub_errors(hub_id, "written"):
        from huggingface_hub import HfApi

        api = HfApi()
        address = str(api.create_repo(hub_id, private=private, exist_ok=True))
        api.upload_folder(repo_id=hub_id, folder_path=folder)
        return address


@contextmanager
def _hub_errors(hub_id: str, done: str) -> Iterator[None]:
    """Turn whatever goes wrong on the way into one line."""
    try:
        from huggingface_hub.errors import HfHubHTTPError
    except ImportError as error:
        raise CheckpointError(
            f"{hub_id}: needs huggingface_hub: pip install 'light3r[hub]'"
        ) from error
    # The hub's library has changed the HTTP library below it twice; what its own error derives
    # from is the base of the errors of the one in use.
    bases = cast(tuple[type[Exception], ...], HfHubHTTPError.__bases__)
    caught: tuple[type[Exception], ...] = (*bases, OSError, ValueError, RuntimeError)
    try:
        yield
    except caught as error:
        reason = " ".join(str(error).split("\n")[0].split())
        raise CheckpointError(
            f"{hub_id}: could not be {done} ({type(error).__name__}: {reason}); check the name, "
            "the network and 'hf auth login'"
        ) from error
