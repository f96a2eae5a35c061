"""Where the scenes of a build come from: named first, then read, all or some of them."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from data_prep.converters import list_scenes, read_scenes
from data_prep.problems import Problems
from data_prep.scene import Scene


class SceneSource(ABC):
    """Scenes of one data set, known by name before any is opened."""

    @property
    @abstractmethod
    def dataset(self) -> str:
        """Name of the data set."""

    @abstractmethod
    def list_names(self, problems: Problems) -> list[str]:
        """Name the scenes, always in one order; some may turn out to have no usable frame.

        Args:
            problems: Told about what is left out before any scene is opened.

        Raises:
            DataError: There is none.
        """

    @abstractmethod
    def read(self, names: Collection[str], problems: Problems) -> Iterator[Scene]:
        """Read the scenes of these names that can be read, in any order.

        Args:
            names: What to read.
            problems: Told about what is left out.
        """


@dataclass(frozen=True, kw_only=True)
class RawSource(SceneSource):
    """A raw data set, read by its converter."""

    converter: str
    """A key of :data:`data_prep.converters.CONVERTERS`."""
    root: Path
    """Folder of the raw data."""
    split: str
    """``train``, ``test`` or ``all``."""
    scenes: str = "*"
    """Pattern on scene names."""
    frame_step: int = 1
    """Take every so many frames."""
    include_excluded: bool = False
    """Also scenes that hold evaluation sets (MegaDepth alone)."""
    label: str = ""
    """Name that the scenes carry; the converter's where empty."""

    @property
    def dataset(self) -> str:
        """Name of the data set."""
        return self.label or self.converter

    def list_names(self, problems: Problems) -> list[str]:
        """See :class:`SceneSource`."""
        return list_scenes(
            self.converter,
            self.root,
            self.split,
            scenes=self.scenes,
            problems=problems,
            include_excluded=self.include_excluded,
        )

    def read(self, names: Collection[str], problems: Problems) -> Iterator[Scene]:
        """See :class:`SceneSource`."""
        for scene in read_scenes(
            self.converter,
            self.root,
            self.split,
            scenes=self.scenes,
            frame_step=self.frame_step,
            problems=problems,
            names=names,
            include_excluded=self.include_excluded,
        ):
            yield replace(scene, dataset=self.dataset)


@dataclass(frozen=True)
class HeldSource(SceneSource):
    """Scenes that are in memory already."""

    scenes: Sequence[Scene]
    """All of one data set."""

    @property
    def dataset(self) -> str:
        """Name of the data set."""
        return self.scenes[0].dataset

    def list_names(self, problems: Problems) -> list[str]:
        """See :class:`SceneSource`."""
        del problems  # none comes up
        return [scene.name for scene in self.scenes]

    def read(self, names: Collection[str], problems: Problems) -> Iterator[Scene]:
        """See :class:`SceneSource`."""
        del problems
        return (scene for scene in self.scenes if scene.name in names)


@dataclass(frozen=True)
class PartSource(SceneSource):
    """The same part of every scene of a source."""

    whole: SceneSource
    """The source."""
    take: Callable[[Scene], Scene]
    """Gives the part of a scene."""

    @property
    def dataset(self) -> str:
        """Name of the data set."""
        return self.whole.dataset

    def list_names(self, problems: Problems) -> list[str]:
        """See :class:`SceneSource`."""
        return self.whole.list_names(problems)

    def read(self, names: Collection[str], problems: Problems) -> Iterator[Scene]:
        """See :class:`SceneSource`."""
        return map(self.take, self.whole.read(names, problems))
