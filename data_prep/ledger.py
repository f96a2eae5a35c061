"""What of a folder of shards is finished, so that an interrupted build goes on where it stopped."""

import hashlib
import json
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from data_prep.problems import Problem
from data_prep.scene import Scene
from l3r.data.schema import MANIFEST_NAME, ShardEntry, index_path, read_manifest
from l3r.errors import DataError
from l3r.files import write_atomic

FOLDER = ".build"
"""Folder of the records, inside the folder of shards."""
PROBLEMS = "problems"
"""Key of the manifest's request that holds what was met, not what was asked."""


@dataclass(frozen=True, kw_only=True)
class ShardRecord:
    """A finished shard."""

    entry: ShardEntry
    """What the manifest says of it; without graphs it is not listed there."""
    skipped: dict[str, str] = field(default_factory=dict)
    """Graphs left out because a frame could no longer be read, by key, and why."""


@dataclass(frozen=True, kw_only=True)
class SceneRecord:
    """A planned scene."""

    num_graphs: int
    """Graphs planned."""
    dropped: dict[str, Problem]
    """What is wrong with the frames left out, by name."""


class Ledger:
    """Records of one folder of shards; a folder serves one request.

    Args:
        out: The folder of shards.
        request: Options of the build, builtins only.

    Raises:
        DataError: The folder was begun with other options, or a record cannot be read.
    """

    def __init__(self, out: Path, request: dict[str, Any]) -> None:
        self.out = out
        self.folder = out / FOLDER
        self.folder.mkdir(parents=True, exist_ok=True)
        path = self.folder / "request.json"
        if any(other != path for other in self.folder.glob("*.json")):
            self._compare(_read(path), request)
        elif (out / MANIFEST_NAME).is_file():
            self._adopt(request)
        elif any(out.glob("*.tar")) and not path.is_file():
            raise DataError(
                f"{out}: holds tars and no record of a build, expected an empty folder; name"
                " another --out"
            )
        _write(path, request)

    def _compare(self, old: dict[str, Any], new: dict[str, Any]) -> None:
        for key in sorted(old.keys() | new.keys()):
            if old.get(key) != new.get(key):
                raise DataError(
                    f"{self.out}: begun with {key} {old.get(key)}, asked now with {new.get(key)};"
                    " give the same options to go on, or name another --out"
                )

    def _adopt(self, request: dict[str, Any]) -> None:
        """Take the records of a folder that was copied without its hidden files."""
        manifest = read_manifest(self.out)
        asked = {key: value for key, value in manifest.request.items() if key != PROBLEMS}
        self._compare(asked, request)
        for entry in manifest.shards:
            self.finish_shard(ShardRecord(entry=entry))

    def find_shard(self, name: str) -> ShardRecord | None:
        """Give the record of a shard if the tar and its index are there as recorded."""
        path, shard = self.folder / f"{name}.json", self.out / name
        if not (path.is_file() and shard.is_file() and index_path(shard).is_file()):
            return None
        plain = _read(path)
        skipped = plain.pop("skipped", {})
        record = ShardRecord(entry=ShardEntry(**plain), skipped=skipped)
        return record if shard.stat().st_size == record.entry.bytes else None

    def finish_shard(self, record: ShardRecord) -> None:
        """Record a finished shard."""
        entry = record.entry
        _write(self.folder / f"{entry.name}.json", {**asdict(entry), "skipped": record.skipped})

    def find_scene(self, scene: Scene) -> SceneRecord | None:
        """Give what was planned for a scene, None where it was not planned.

        Raises:
            DataError: The scene's frames or cameras are not those it was planned with.
        """
        path = self.folder / f"{scene.slug}.scene.json"
        if not path.is_file():
            return None
        record = _read(path)
        if record["fingerprint"] != _fingerprint(scene):
            raise DataError(
                f"{self.out}: the frames or cameras of {scene.name} have changed since the build"
                " began; restore the source, or name another --out"
            )
        dropped = {name: Problem(**plain) for name, plain in record.get("dropped", {}).items()}
        return SceneRecord(num_graphs=int(record["num_graphs"]), dropped=dropped)

    def plan_scene(self, scene: Scene, record: SceneRecord) -> None:
        """Record what was planned for a scene, the frames left out among its frames."""
        plain = {"fingerprint": _fingerprint(scene), **asdict(record)}
        _write(self.folder / f"{scene.slug}.scene.json", plain)


def _fingerprint(scene: Scene) -> str:
    """Digest of a scene's frame names, sizes and cameras."""
    digest = hashlib.sha256()
    for frame in scene.frames:
        digest.update(f"{frame.name} {frame.image_size}".encode())
        digest.update(frame.K.tobytes() + frame.world_from_cam.tobytes())
    return digest.hexdigest()


def _read(path: Path) -> dict[str, Any]:
    try:
        record: dict[str, Any] = json.loads(path.read_bytes())
    except (OSError, ValueError) as error:
        raise DataError(
            f"{path}: no record ({error}); remove it to build that part again"
        ) from error
    return record


def _write(path: Path, record: dict[str, Any]) -> None:
    write_atomic(path, (json.dumps(record, indent=1) + "\n").encode())
