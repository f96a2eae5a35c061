"""Networks in folders and on the Hugging Face hub: ``config.json`` and ``model.safetensors``."""

from collections.abc import Callable, Mapping
from dataclasses import asdict
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, TypeVar, cast

import torch
from torch import nn

from l3r.config import GraphConfig, ModelConfig, from_plain
from l3r.errors import CheckpointError
from l3r.model.hub import HUB_ID, fetch_folder, publish_folder
from l3r.model.weight_files import network_weights, read_weight_file, require_own, write_folder
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
        build = cast(Callable[[ModelConfig, GraphConfig], Network], cls)
        network = build(config.model, config.graph)
        load_exactly(network, network_weights(content), str(source))
        return network.to(device).eval()

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


def load_exactly(network: nn.Module, weights: Mapping[str, Any], where: str) -> None:
    """Load a whole state dict.

    Raises:
        CheckpointError: It does not fit.
    """
    try:
        network.load_state_dict(weights)
    except RuntimeError as error:
        first = " ".join(str(error).split("\n")[1:2]).strip()
        raise CheckpointError(
            f"{where}: weights do not fit the configuration in the file: {first}"
        ) from error
