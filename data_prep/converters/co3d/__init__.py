"""CO3D, version 2: phone videos that circle an object, with cameras and depth of COLMAP.

``ROOT/CATEGORY/{frame_annotations.jgz, sequence_annotations.jgz, set_lists/}`` and, under each
sequence, ``images``, ``depths``, ``depth_masks`` and ``masks``. A scene is a sequence, named
``CATEGORY/SEQUENCE``. Every sequence has its own unit of length. docs/datasets/co3d.md says what
is translated, left out and held out.
"""

import os
from collections.abc import Callable, Collection, Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from fnmatch import fnmatchcase
from pathlib import Path

from data_prep.converters.co3d.annotations import (
    FrameRecord,
    SequenceRecord,
    group_frames,
    read_sequences,
)
from data_prep.converters.co3d.cameras import MAX_TRANSLATION, is_corrupt
from data_prep.converters.co3d.frames import Needs, build_frame
from data_prep.converters.co3d.splits import (
    MIN_VIEWPOINT_QUALITY,
    SetLists,
    Split,
    find_fault,
    read_set_lists,
)
from data_prep.converters.photos import photo_size
from data_prep.problems import Problems
from data_prep.scene import Scene
from data_prep.survey import SceneSurvey
from l3r.errors import DataError


@dataclass(frozen=True, kw_only=True)
class Options:
    """What is asked of sequences and frames."""

    min_viewpoint_quality: float = MIN_VIEWPOINT_QUALITY
    """Cameras of a training sequence must score more; null passes no threshold."""
    min_pointcloud_quality: float | None = None
    """Point clouds of a training sequence must score more; None: need not be judged."""
    needs: Needs = field(default_factory=Needs)
    """What a frame must have."""

    def find_fault(self, record: SequenceRecord | None) -> tuple[str, str] | None:
        """Say why a sequence is not good enough to be trained on: ``(problem, detail)``."""
        return find_fault(
            record,
            min_viewpoint_quality=self.min_viewpoint_quality,
            min_pointcloud_quality=self.min_pointcloud_quality,
        )


_DEFAULTS = Options()


@dataclass(frozen=True, kw_only=True)
class _Request:
    root: Path
    split: Split
    scenes: str
    frame_step: int
    options: Options


def read(
    root: Path,
    split: Split = "train",
    *,
    scenes: str = "*",
    frame_step: int = 1,
    problems: Problems,
    names: Collection[str] | None = None,
    options: Options = _DEFAULTS,
) -> Iterator[Scene]:
    """Find sequences and read their annotations; pixels follow when asked for.

    Args:
        root: Folder that holds the categories.
        split: ``train``, ``val``, ``test`` by the rule of :mod:`.splits`, or ``all`` frames.
        scenes: Pattern on ``CATEGORY/SEQUENCE``.
        frame_step: Take every so many frames of a sequence's frames in the split, by frame number.
        problems: Told about what cannot be used.
        names: Only scenes of these names; where given, that none of them can be read is no error.
        options: Thresholds of quality, which apply to ``train`` alone, and what a frame must have.

    Yields:
        One scene per sequence, categories by name, sequences in the order of their annotations,
        frames by frame number. Not metric.

    Raises:
        DataError: There is no category, or no scene can be used.
    """
    folders = find_categories(root)
    request = _Request(
        root=root, split=split, scenes=scenes, frame_step=frame_step, options=options
    )
    number = 0
    for folder in folders:
        if names is not None and not any(name.startswith(f"{folder.name}/") for name in names):
            continue
        for scene in _read_category(folder, request, problems, names):
            number += 1
            yield scene
    if not number and names is None:
        raise DataError(
            f"{root}: no sequence of {len(folders)} categories ({folders[0].name}, ...) in split"
            f" '{split}' that matches '{scenes}' can be used (problems: {problems.summary()});"
            " change --split or --scenes, or unpack the archives again"
        )


def list_names(
    root: Path,
    split: Split,
    *,
    scenes: str,
    problems: Problems,
    options: Options = _DEFAULTS,
) -> list[str]:
    """List the names of what :func:`read` reads; arguments and errors are its own.

    Frame annotations are not opened: some of these scenes may turn out to have no usable frame.
    """
    request = _Request(root=root, split=split, scenes=scenes, frame_step=1, options=options)
    found: list[str] = []
    for folder in find_categories(root):
        category = _open_category(folder, request, problems)
        if category is not None:
            found += [f"{folder.name}/{name}" for name in category.list_sequences(split)]
    return found


def find_categories(root: Path) -> list[Path]:
    """List the categories' folders, sorted by name.

    Args:
        root: Folder that holds them.

    Raises:
        DataError: There is none.
    """
    if not root.is_dir():
        raise DataError(f"{root}: no such folder; name the folder that holds the categories")
    found = [
        path
        for path in sorted(root.iterdir())
        if path.is_dir() and not path.name.startswith(".") and _is_category(path)
    ]
    if not found:
        inside = (root / "frame_annotations.jgz").exists()
        hint = f"name {root.parent}" if inside else "check the folder"
        raise DataError(
            f"{root}: no CATEGORY/frame_annotations.jgz below it, expected the archives unpacked"
            f" side by side; {hint}"
        )
    return found


def _is_category(path: Path) -> bool:
    return any(path.glob("*_annotations.jgz")) or any(path.glob("*/images"))


@dataclass(frozen=True, kw_only=True)
class _Category:
    """What is known of a category before its frames are read."""

    folder: Path
    sequences: dict[str, SequenceRecord]
    lists: SetLists
    is_wanted: Callable[[str], bool]

    def list_sequences(self, split: Split) -> list[str]:
        """Name the sequences asked for, sorted."""
        members = self.lists.members(split)
        if members is None:
            folders = {path.parent.name for path in self.folder.glob("*/images")}
            members = folders | self.sequences.keys()
        return sorted(filter(self.is_wanted, members))


def _open_category(folder: Path, request: _Request, problems: Problems) -> _Category | None:
    """Read what says which sequences to take; None where no frame need be parsed."""
    sequences = _read_sequences(folder, problems)
    lists = SetLists()
    if request.split != "all":
        try:
            lists = read_set_lists(folder / "set_lists")
        except DataError as error:
            _report(problems, "bad_set_lists", folder / "set_lists", error)
            return None
    is_wanted = _choose(folder.name, sequences, lists, request, problems)
    if is_wanted is None:
        return None
    return _Category(folder=folder, sequences=sequences, lists=lists, is_wanted=is_wanted)


def _read_category(
    folder: Path, request: _Request, problems: Problems, names: Collection[str] | None
) -> Iterator[Scene]:
    category = _open_category(folder, request, problems)
    if category is None:
        return

    def is_wanted(name: str) -> bool:
        return category.is_wanted(name) and (names is None or f"{folder.name}/{name}" in names)

    path = folder / "frame_annotations.jgz"
    try:
        for sequence, records in group_frames(path, is_wanted, problems):
            name = f"{folder.name}/{sequence}"
            with problems.about(name):
                scene = _build_scene(name, records, category.lists, request, problems)
            if scene is not None:
                yield scene
    except DataError as error:
        _report(problems, "bad_annotations", path, error)


def _read_sequences(folder: Path, problems: Problems) -> dict[str, SequenceRecord]:
    path = folder / "sequence_annotations.jgz"
    try:
        return read_sequences(path, problems)
    except DataError as error:
        _report(problems, "bad_annotations", path, error)
        return {}


def _report(problems: Problems, kind: str, path: Path, error: DataError) -> None:
    problems.add(kind, path, str(error).removeprefix(f"{path}: "))


def _choose(
    category: str,
    sequences: dict[str, SequenceRecord],
    lists: SetLists,
    request: _Request,
    problems: Problems,
) -> Callable[[str], bool] | None:
    """Tell which sequences to read; None where no frame of the category need be parsed."""

    def matches(name: str) -> bool:
        return fnmatchcase(f"{category}/{name}", request.scenes)

    members = lists.members(request.split)
    if members is None:
        return matches if not sequences or any(map(matches, sequences)) else None
    chosen = {name for name in members if matches(name)}
    if request.split == "train":
        for name in sorted(chosen):
            fault = request.options.find_fault(sequences.get(name))
            if fault is not None:
                problems.add(fault[0], f"{category}/{name}", fault[1])
                chosen.discard(name)
    return chosen.__contains__ if chosen else None


def _build_scene(
    name: str, records: list[FrameRecord], lists: SetLists, request: _Request, problems: Problems
) -> Scene | None:
    if any(record.viewpoint and is_corrupt(record.viewpoint) for record in records):
        problems.add(
            "corrupt_sequence", name, f"a translation above {MAX_TRANSLATION:.0e}: SfM went astray"
        )
        return None
    chosen = _select(name, records, lists, request, problems)[:: request.frame_step]
    built = (
        build_frame(request.root, record, request.options.needs, problems) for record in chosen
    )
    frames = [frame for frame in built if frame is not None]
    if not frames:
        problems.add("empty_scene", name, f"none of {len(chosen)} frames can be used")
        return None
    return Scene(dataset="co3d", name=name, is_metric=False, frames=frames)


def _select(
    name: str, records: list[FrameRecord], lists: SetLists, request: _Request, problems: Problems
) -> list[FrameRecord]:
    """Take the frames of the split, by number, each number and each file name once."""
    chosen: list[FrameRecord] = []
    numbers: set[int] = set()
    files: set[str] = set()
    for record in sorted(records, key=lambda record: record.number):
        try:
            if not lists.holds(request.split, record):
                continue
        except DataError as error:
            problems.add("set_list_disagrees", name, str(error))
            continue
        file = Path(record.image_path).name
        if record.number in numbers or file in files:
            problems.add("duplicate_frame", name, f"frame {record.number}, {file}: named before")
            continue
        numbers.add(record.number)
        files.add(file)
        chosen.append(record)
    return chosen


def survey(root: Path) -> Iterator[SceneSurvey]:
    """List the sequences by folder, without frame annotations and pixels.

    An image counts if a depth map and a depth mask lie beside it under the data set's usual names.

    Args:
        root: Folder that holds the categories.

    Yields:
        One line per sequence, sorted by name; ``excluded`` says why ``train`` leaves it out.

    Raises:
        DataError: There is no category.
    """
    for folder in find_categories(root):
        problems = Problems()
        sequences = _read_sequences(folder, problems)
        try:
            lists, fault = read_set_lists(folder / "set_lists"), ""
        except DataError as error:
            lists, fault = SetLists(), "no set lists that can be read"
            _report(problems, "bad_set_lists", folder / "set_lists", error)
        if not (folder / "frame_annotations.jgz").is_file():
            fault = "no frame annotations"
        there = {path.parent.name for path in folder.glob("*/images")}
        for name in sorted(there | set(sequences)):
            excluded = fault or _excluded(name, lists, sequences.get(name))
            yield _survey_sequence(folder / name, f"{folder.name}/{name}", excluded)


def _excluded(name: str, lists: SetLists, record: SequenceRecord | None) -> str:
    if name in lists.held_out:
        return "held out for testing"
    if name not in lists.train:
        return "in no training list"
    fault = _DEFAULTS.find_fault(record)
    return fault[1] if fault is not None else ""


def _survey_sequence(folder: Path, name: str, excluded: str) -> SceneSurvey:
    images, depths, masks = (
        _list_files(folder / kind) for kind in ("images", "depths", "depth_masks")
    )
    images = {file for file in images if file.endswith(".jpg")}
    whole = {
        file
        for file in images
        if f"{file}.geometric.png" in depths and f"{file.removesuffix('.jpg')}.png" in masks
    }
    size = None
    if images:
        with suppress(DataError):
            size = photo_size(folder / "images" / min(images))
    return SceneSurvey(
        name=name,
        num_images=len(whole),
        image_size=size,
        num_missing=len(images) - len(whole),
        excluded=excluded,
    )


def _list_files(folder: Path) -> set[str]:
    try:
        with os.scandir(folder) as entries:
            return {entry.name for entry in entries if not entry.name.startswith(".")}
    except OSError:
        return set()
