"""What of a folder of shards is finished, so that an interrupted build goes on where it stopped.

Several tasks may keep records in one folder: each file has one content, whoever writes it, and
appears whole or not at all.
"""

import json
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from data_prep.draw import GraphPlan
from data_prep.plan import ScenePlan, fingerprint
from data_prep.plan_file import read_plan, write_plan
from data_prep.scene import Scene, slug_of
from l3r.data.schema import MANIFEST_NAME, Manifest, ShardEntry, index_path, read_manifest
from l3r.errors import DataError
from l3r.files import write_atomic, write_first

FOLDER = ".build"
"""Folder of the records, inside the folder of shards."""
_DAY = 86_400.0
PROBLEMS = "problems"
"""Key of the manifest's request that holds what was met, not what was asked."""


@dataclass(frozen=True, kw_only=True)
class ShardRecord:
    """A finished shard."""

    entry: ShardEntry
    """What the manifest says of it; without graphs there is no file, and it is not listed."""
    skipped: dict[str, str] = field(default_factory=dict)
    """Graphs left out because a frame could no longer be read, by key, and why."""


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
        if path.is_file():
            self._compare(_read(path), request)
        elif (manifest := self.find_manifest()) is not None:
            # The folder was copied without its hidden files.
            self._compare(_asked(manifest), request)
            for entry in manifest.shards:
                self.finish_shard(ShardRecord(entry=entry))
        elif any(out.glob("*.tar")):
            raise DataError(
                f"{out}: holds tars and no record of a build, expected an empty folder; name"
                " another --out"
            )
        write_first(path, _encode(request))

    def _compare(self, old: dict[str, Any], new: dict[str, Any]) -> None:
        for key in sorted(old.keys() | new.keys()):
            if old.get(key) != new.get(key):
                raise DataError(
                    f"{self.out}: begun with {key} {old.get(key)}, asked now with {new.get(key)};"
                    " give the same options to go on, or name another --out"
                )

    def keep_names(self, names: Sequence[str]) -> None:
        """Record the scenes of the build.

        Raises:
            DataError: They are not those the build began with.
        """
        path = self.folder / "scenes.json"
        write_first(path, _encode({"names": list(names)}))
        old = _read(path)["names"]
        if old != list(names):
            changed = sorted(set(old) ^ set(names))[:1] or ["their order"]
            raise DataError(
                f"{self.out}: begun with {len(old)} scenes, now there are {len(names)}"
                f" ({changed[0]} differs); restore the source, or name another --out"
            )

    def find_manifest(self) -> Manifest | None:
        """Give the manifest of an earlier build, if there is one."""
        return read_manifest(self.out) if (self.out / MANIFEST_NAME).is_file() else None

    def find_finished(self) -> Manifest | None:
        """Give the manifest if every tar that it lists, and its index, is there at its size."""
        manifest = self.find_manifest()
        return manifest if manifest and all(map(self._is_there, manifest.shards)) else None

    def find_shard(self, name: str) -> ShardRecord | None:
        """Give the record of a shard if the tar and its index are there as recorded."""
        path = self.folder / f"{name}.json"
        if not path.is_file():
            return None
        plain = _read(path)
        skipped = plain.pop("skipped", {})
        record = ShardRecord(entry=ShardEntry(**plain), skipped=skipped)
        return record if self._is_there(record.entry) else None

    def _is_there(self, entry: ShardEntry) -> bool:
        shard = self.out / entry.name
        if entry.num_graphs == 0:
            return True
        whole = shard.is_file() and shard.stat().st_size == entry.bytes
        return whole and index_path(shard).is_file()

    def finish_shard(self, record: ShardRecord) -> None:
        """Record a finished shard."""
        entry = record.entry
        _write(self.folder / f"{entry.name}.json", {**asdict(entry), "skipped": record.skipped})

    def has_plan(self, scene: Scene) -> bool:
        """Whether a scene was planned; one that could not be read then stays left out.

        Raises:
            DataError: It was, with other frames or cameras.
        """
        plan = self.read_plan(scene.name)
        if plan is None:
            return False
        if plan.fingerprint not in ("", fingerprint(scene)):
            raise DataError(
                f"{self.out}: the frames or cameras of {scene.name} have changed since the build"
                " began; restore the source, or name another --out"
            )
        return True

    def read_plan(self, scene: str) -> ScenePlan | None:
        """Give what was planned for a scene, None where it was not.

        Raises:
            DataError: The record is damaged.
        """
        path = self._plan_path(scene)
        return read_plan(path) if path.is_file() else None

    def graphs_of(self, scene: str) -> list[GraphPlan]:
        """Give the graphs planned for a scene; none where it was not planned."""
        plan = self.read_plan(scene)
        return plan.graphs if plan else []

    def keep_plan(self, scene: str, plan: ScenePlan) -> None:
        """Record what was planned for a scene, unless another task has done so."""
        write_plan(self._plan_path(scene), plan)

    def remove_remains(self) -> None:
        """Remove what processes that were killed a day ago or more left among the records."""
        for path in self.folder.glob(".*.tmp"):
            # Younger ones may belong to a task that has just begun.
            with suppress(FileNotFoundError):
                if time.time() - path.stat().st_mtime > _DAY:
                    path.unlink()

    def _plan_path(self, scene: str) -> Path:
        return self.folder / f"{slug_of(scene)}.plan.npz"


def _asked(manifest: Manifest) -> dict[str, Any]:
    return {key: value for key, value in manifest.request.items() if key != PROBLEMS}


def _read(path: Path) -> dict[str, Any]:
    try:
        record: dict[str, Any] = json.loads(path.read_bytes())
    except (OSError, ValueError) as error:
        raise DataError(
            f"{path}: no record ({error}); remove it to build that part again"
        ) from error
    return record


def _write(path: Path, record: dict[str, Any]) -> None:
    write_atomic(path, _encode(record))


def _encode(record: dict[str, Any]) -> bytes:
    return (json.dumps(record, indent=1) + "\n").encode()
