"""TensorBoard and Weights & Biases, which a run's figures can go to beside the CSV files."""

import secrets
from abc import ABC, abstractmethod
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import cv2

from l3r.config import RunConfig, to_plain
from l3r.errors import ConfigError
from l3r.files import write_atomic


class Sink(ABC):
    """A place that keeps figures beside the CSV files."""

    @abstractmethod
    def start(self, step: int) -> None:
        """Open; the run goes on from ``step``."""

    @abstractmethod
    def write(self, step: int, row: Mapping[str, float]) -> None:
        """Keep figures under names like ``train/loss``."""

    @abstractmethod
    def add_picture(self, step: int, path: Path) -> None:
        """Keep a PNG file."""

    @abstractmethod
    def close(self) -> None:
        """Flush; nothing to do where it was never started."""

    def state_dict(self) -> dict[str, str]:
        """Give what a checkpoint keeps."""
        return {}

    def load_state_dict(self, state: Mapping[str, str]) -> None:  # noqa: B027
        """Take up what a checkpoint kept, before the start."""


class TensorBoardSink(Sink):
    """Event files in a folder; those of steps that a resumed run repeats are hidden.

    Args:
        folder: Where they go.

    Raises:
        ConfigError: The package ``tensorboard`` is not installed.
    """

    def __init__(self, folder: Path) -> None:
        try:
            from torch.utils.tensorboard import SummaryWriter
        except ImportError as error:
            raise ConfigError(
                "logs.to names tensorboard, which is not installed; pip install 'light3r[log]'"
            ) from error
        self.open_writer = SummaryWriter
        self.folder = folder
        self.writer: Any = None

    def start(self, step: int) -> None:
        """Open an event file."""
        self.writer = self.open_writer(str(self.folder), purge_step=step + 1)

    def write(self, step: int, row: Mapping[str, float]) -> None:
        """Add scalars."""
        for name, value in row.items():
            self.writer.add_scalar(name, value, step)

    def add_picture(self, step: int, path: Path) -> None:
        """Add an image."""
        pixels = cv2.cvtColor(cv2.imread(str(path)), cv2.COLOR_BGR2RGB)
        self.writer.add_image("val/first_graph", pixels, step, dataformats="HWC")

    def close(self) -> None:
        """Flush."""
        if self.writer is not None:
            self.writer.close()


class WandbSink(Sink):
    """One run of Weights & Biases, which a resumed training goes on with.

    The curves' axis is the optimisation step. Rows between the last checkpoint and a kill are sent
    again by the resumed run, under the same steps.

    The run's name is kept in the folder, where it may be changed to send elsewhere, and in
    checkpoints, for a folder that lost it.

    Args:
        config: Mode and project; the whole configuration is shown beside the curves.
        folder: The run's folder, which keeps the run's name in ``wandb_id.txt``.
    """

    def __init__(self, config: RunConfig, folder: Path) -> None:
        self.config = config
        self.folder = folder
        self.name = ""
        self.run: Any = None

    def start(self, step: int) -> None:
        """Open the run, or go on with it."""
        import wandb  # only here: it takes a second to import

        place = self.folder / "wandb_id.txt"
        if not place.exists():
            write_atomic(place, (self.name or secrets.token_hex(4)) + "\n")
        self.name = place.read_text().strip()
        self.run = wandb.init(
            project=self.config.logs.wandb_project,
            id=self.name,
            name=self.folder.name,
            dir=self.folder,
            config=to_plain(self.config),
            mode=self.config.logs.wandb_mode,
            resume="allow",
            settings=wandb.Settings(silent=True, console="off"),
        )
        self.run.define_metric("step")
        self.run.define_metric("*", step_metric="step")

    def write(self, step: int, row: Mapping[str, float]) -> None:
        """Send figures."""
        self.run.log({"step": step, **row})

    def add_picture(self, step: int, path: Path) -> None:
        """Send an image."""
        import wandb

        self.run.log({"step": step, "val/first_graph": wandb.Image(str(path))})

    def close(self) -> None:
        """Finish the run."""
        if self.run is not None:
            self.run.finish()

    def state_dict(self) -> dict[str, str]:
        """Give the run's name."""
        return {"name": self.name}

    def load_state_dict(self, state: Mapping[str, str]) -> None:
        """Take up the run's name."""
        self.name = state.get("name", "")


def build_sinks(config: RunConfig, folder: Path) -> list[Sink]:
    """Build what ``logs.to`` names.

    Raises:
        ConfigError: A package is not installed.
    """
    sinks: list[Sink] = []
    if "tensorboard" in config.logs.to:
        sinks.append(TensorBoardSink(folder / "tensorboard"))
    if "wandb" in config.logs.to:
        sinks.append(WandbSink(config, folder))
    return sinks
