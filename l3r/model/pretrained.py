"""Networks in folders and on the Hugging Face hub: ``config.json`` and ``model.safetensors``."""

from collections.abc import Callable, Mapping
from dataclasses import asdict
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, TypeVar, cast

import torch
from torch import Tensor, nn

from l3r.config import GraphConfig, ModelConfig, RunConfig, from_plain
from l3r.errors import CheckpointError
from l3r.model.hub import HUB_ID, fetch_folder, publish_folder
from l3r.model.transfer import require_finite, require_weights
from l3r.model.weight_files import network_weights, read_weight_file, require_own, write_folder
from l3r.model.weights import printable
from l3r.version import __version__

# Not Self: the checker of shapes in tests cannot read it.
Network = TypeVar("Network", bound="Pretrained")


class Pretrained(nn.Module):
    """Reading and writing of a network that a model and a graph configuration describe."""

    config: ModelConfig
    graph: GraphConfig

    @classmethod
    def from_pretrained(
        cls: type[Network], source: str | Path, device: str | torch.device = "cpu"
    ) -> Network:
        """Load a network, ready for inference.

        Args:
            source: A folder that :meth:`save_pretrained` wrote, a Light3R checkpoint, or the name
                of a repository on the hub (``owner/name``; needs the extra ``hub``).
            device: Where the network goes.

        Raises:
            CheckpointError: There is none, it cannot be read, or it is none of ours.
        """
        path = Path(source)
        is_local = path.suffix in (".ckpt", ".pth") or path.parent.is_dir()
        if not is_local and HUB_ID.fullmatch(str(source)):
            path = fetch_folder(str(source))
        content = read_weight_file(path, mapped=True)
        require_own(content, str(source))
        config = from_plain(content["l3r_config"], str(source))
        return build_network(cls, config, content, str(source)).to(device).eval()

    def save_pretrained(self, folder: str | Path, *, note: str = "") -> None:
        """Write ``config.json`` and ``model.safetensors`` into a folder.

        Args:
            folder: Made if need be.
            note: What whoever uses the weights should know, such as their licence; it becomes
                ``train.note`` when they are loaded.
        """
        sections = {"model": asdict(self.config), "graph": asdict(self.graph)}
        if note:
            sections["train"] = {"note": note}
        write_folder(Path(folder), sections, self.state_dict(), __version__)

    def push_to_hub(self, hub_id: str, *, note: str = "", private: bool = True) -> str:
        """Put the network on the hub; needs the extra ``hub`` and ``hf auth login``.

        Args:
            hub_id: ``owner/name``.
            note: See :meth:`save_pretrained`.
            private: Whether a new repository is visible to its owner alone.

        Returns:
            The repository's address.

        Raises:
            CheckpointError: It could not be written.
        """
        with TemporaryDirectory() as folder:
            self.save_pretrained(folder, note=note)
            return publish_folder(Path(folder), hub_id, private=private)


def build_network(
    cls: type[Network], config: RunConfig, content: Mapping[str, Any], where: str
) -> Network:
    """Build the network that a file describes, and fill it with the weights in the file.

    Args:
        cls: Class of the network.
        config: What the file says of it.
        content: What :func:`~l3r.model.weight_files.require_own` let through.
        where: The file, for messages.

    Raises:
        CheckpointError: The weights are no finite numbers, or do not fit the configuration.
    """
    weights = require_weights(network_weights(content), where)
    build = partial(
        cast(Callable[[ModelConfig, GraphConfig], Network], cls), config.model, config.graph
    )
    # A file may ask for more memory than there is: what is built must be as large as its weights.
    if misfit := _find_misfit(weights, build, config.model):
        raise CheckpointError(
            f"{where}: weights do not fit the configuration in the file: {misfit}"
        )
    for key, value in weights.items():
        require_finite(value, key, where)
    network = build()
    network.load_state_dict(weights)
    return network


def _find_misfit(
    weights: Mapping[str, Tensor], build: Callable[[], nn.Module], config: ModelConfig
) -> str | None:
    """Say what first differs in names and shapes; None if nothing does. Takes no memory."""
    depth = config.encoder.depth + config.decoder.depth + config.alignment.num_blocks
    # Blocks without values take time and memory, too.
    if depth > len(weights):
        return f"it has {len(weights)} weights, expected those of {depth} blocks"
    try:
        with torch.device("meta"):
            outline = build()
    except (RuntimeError, TypeError, OverflowError) as error:  # a size beyond 64 bits
        return f"no network can be built of it ({printable(error)})"
    found, wanted = (
        {key: list(value.shape) for key, value in state.items()}
        for state in (weights, outline.state_dict())
    )
    for key in sorted(found.keys() | wanted.keys()):
        if found.get(key) != wanted.get(key):
            shapes = found.get(key, "missing"), wanted.get(key, "none of that name")
            return f"{printable(key)} is {shapes[0]}, expected {shapes[1]}"
    return None
