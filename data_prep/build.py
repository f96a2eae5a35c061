"""Scenes become a folder of shards: tars, their indices and a manifest.

Every task does its share: it plans the scenes of its tars that nobody has planned yet, writes the
tars, and records both. The task that finds all tars there writes the manifest. Two tasks that need
the same scene may both plan it: they come to the same plan.
"""

from collections import Counter, deque
from collections.abc import Callable, Iterable
from concurrent.futures import FIRST_COMPLETED, Executor, Future, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

from data_prep.ledger import PROBLEMS, Ledger, ShardRecord
from data_prep.plan import ScenePlan, plan_scene
from data_prep.problems import Problems
from data_prep.scene import Scene, slug_of
from data_prep.shards import write_shard
from data_prep.source import SceneSource
from data_prep.units import BuildRequest, TaskShare, Unit, list_units
from data_prep.workers import open_pool
from l3r.data.schema import Manifest, write_manifest
from l3r.errors import DataError

Report = Callable[[str, int, int], None]
"""Called with what is counted, how many are done and how many there are."""


def build_shards(
    source: SceneSource,
    out: Path,
    request: BuildRequest,
    *,
    share: TaskShare | None = None,
    num_workers: int = 0,
    report: Report = lambda name, done, total: None,
    problems: Problems | None = None,
) -> Manifest | None:
    """Write this task's shards, or what is missing of them; the last task writes the manifest.

    A frame that breaks after its scene was planned takes its graphs with it: they are skipped, the
    others keep their shard and their key.

    Args:
        source: Scenes of one data set.
        out: Folder that gets the shards.
        request: What they shall hold.
        share: Which of several tasks this is; they may run at the same time or one by one.
        num_workers: Processes that plan and encode; 0 does both in this one. Neither this nor the
            number of tasks changes a byte.
        report: Told about the progress.
        problems: Told about what is left out by this run; the manifest counts all.

    Returns:
        The manifest, or None where other tasks have shards to write.

    Raises:
        DataError: The folder belongs to another request, the source has changed since an
            interrupted build, or no scene yields a graph.
    """
    problems = Problems() if problems is None else problems
    share = share or TaskShare()
    listed = Problems(quiet=True)
    names = _unique_names(source.list_names(listed), listed)
    ledger = Ledger(out, asdict(request))
    ledger.keep_names(names)
    finished = ledger.find_finished()
    if finished is not None:
        return finished
    units = list_units(source.dataset, names, request)
    build = _Build(ledger=ledger, request=request, units=units, names=names, listed=listed)
    mine = share.take(units)
    missing = [unit for unit in mine if ledger.find_shard(unit.name) is None]
    if missing:
        with open_pool(num_workers) as pool:
            # Enough to keep workers busy while the next scene is read, and no more in memory.
            at_once = 2 * num_workers + 1
            _Run(build, pool, missing, report, problems, at_once=at_once).write(source)
    gone = [unit.name for unit in mine if ledger.find_shard(unit.name) is None]
    if gone:
        raise DataError(
            f"{out / gone[0]}: was finished and is gone or changed ({len(gone)} such shards); leave"
            " the folder alone while it is built, and run the same command again"
        )
    return _merge(build, source.dataset)


def _unique_names(names: Iterable[str], problems: Problems) -> list[str]:
    """Leave out a scene whose shards and keys would be another's."""
    slugs: dict[str, str] = {}
    for name in names:
        if slugs.setdefault(slug_of(name), name) != name:
            problems.add("name_clash", name, f"its keys would be {slugs[slug_of(name)]}'s")
    return list(slugs.values())


@dataclass(frozen=True, kw_only=True)
class _Build:
    """What a build is about."""

    ledger: Ledger
    request: BuildRequest
    units: list[Unit]
    names: list[str]
    listed: Problems
    """What was left out before any scene was opened."""


class _Run:
    """One task's work: scenes come in one by one, and each tar is written once its scenes are."""

    def __init__(
        self,
        build: _Build,
        pool: Executor,
        units: list[Unit],
        report: Report,
        problems: Problems,
        *,
        at_once: int,
    ) -> None:
        self.ledger = build.ledger
        self.request = build.request
        self.pool = pool
        self.report = report
        self.problems = problems
        self.at_once = at_once
        self.users: dict[str, list[Unit]] = {}
        for unit in units:
            for part in unit.parts:
                self.users.setdefault(part.scene, []).append(unit)
        self.seen: set[str] = set()
        self.planned: set[str] = set()
        self.scenes: dict[str, Scene] = {}
        self.ready: deque[Unit] = deque()
        self.work: dict[Future[Any], Callable[[Any], None]] = {}
        self.graphs = [0, sum(unit.room for unit in units)]

    def write(self, source: SceneSource) -> None:
        """Plan what is not planned and write every unit."""
        self._tell()
        try:
            for scene in source.read(self.users.keys(), self.problems):
                if scene.name in self.users and scene.name not in self.seen:
                    self._take(scene)
                    self._collect(self.at_once - 1)
            missing = [name for name in self.users if name not in self.seen]
            lost = [name for name in missing if not self._miss(name)]
            self._collect(0)
        except BrokenProcessPool as error:
            raise DataError(
                f"{self.ledger.out}: a worker was killed, most often for want of memory; run the"
                " same command again with fewer --workers"
            ) from error
        if lost:
            raise DataError(
                f"{self.ledger.out}: {lost[0]} has graphs to be written and cannot be read any more"
                f" ({len(lost)} such scenes); restore the source and run the same command again"
            )

    def _take(self, scene: Scene) -> None:
        self.seen.add(scene.name)
        self.scenes[scene.name] = scene
        if self.ledger.has_plan(scene):
            self._settle(scene.name)
            return
        counts = dict(self.problems.by_scene.get(scene.name, {}))
        future = self.pool.submit(_plan, scene, self.request, counts, self.ledger)

        def done(plan: ScenePlan) -> None:
            for problem in plan.dropped.values():
                self.problems.add(problem.kind, problem.where, problem.detail)
            self._settle(scene.name)

        self.work[future] = done

    def _miss(self, name: str) -> bool:
        """Record a scene of which nothing could be read; False where it could be, before."""
        counts = self.problems.by_scene.get(name) or {"missing_scene": 1}
        self.ledger.keep_plan(name, ScenePlan(problems=dict(counts)))
        if self.ledger.graphs_of(name):
            return False
        self._settle(name)
        return True

    def _settle(self, name: str) -> None:
        """Make ready the units whose scenes are all planned now."""
        self.planned.add(name)
        self.report("scenes related", len(self.planned), len(self.users))
        for unit in self.users[name]:
            if all(part.scene in self.planned for part in unit.parts):
                self.ready.append(unit)

    def _begin(self, unit: Unit) -> None:
        names = [part.scene for part in unit.parts]
        scenes = {name: self.scenes[name] for name in names if name in self.scenes}
        future = self.pool.submit(_write, unit, scenes, self.ledger)
        self.work[future] = partial(self._finish, unit)

    def _finish(self, unit: Unit, record: ShardRecord) -> None:
        self.ledger.finish_shard(record)
        self._forget(unit)
        for key, reason in record.skipped.items():
            self.problems.add("skipped_graph", key, reason)
        self.graphs[0] += record.entry.num_graphs
        self.graphs[1] -= unit.room - record.entry.num_graphs
        self._tell()

    def _forget(self, unit: Unit) -> None:
        """Let go of scenes that no other unit waits for: a data set has thousands."""
        for part in unit.parts:
            self.users[part.scene].remove(unit)
            if not self.users[part.scene]:
                self.scenes.pop(part.scene, None)

    def _tell(self) -> None:
        self.report("graphs written", *self.graphs)

    def _collect(self, left: int) -> None:
        """Begin what is ready and take results until no more than so many jobs are under way."""
        while True:
            while self.ready and len(self.work) < self.at_once:
                self._begin(self.ready.popleft())
            done = [future for future in self.work if future.done()]
            if not done:
                if not self.ready and len(self.work) <= left:
                    return
                done = list(wait(self.work, return_when=FIRST_COMPLETED).done)
            for future in done:
                self.work.pop(future)(future.result())


def _plan(
    scene: Scene, request: BuildRequest, problems: dict[str, int], ledger: Ledger
) -> ScenePlan:
    plan = plan_scene(scene, request, problems)
    ledger.keep_plan(scene.name, plan)
    return ScenePlan(dropped=plan.dropped)


def _write(unit: Unit, scenes: dict[str, Scene], ledger: Ledger) -> ShardRecord:
    parts = []
    for part in unit.parts:
        graphs = ledger.graphs_of(part.scene)[part.first : part.last]
        if graphs:
            parts.append((scenes[part.scene], graphs))
    return write_shard(ledger.out / unit.name, parts)


def _merge(build: _Build, dataset: str) -> Manifest | None:
    """Write the manifest if every shard of every task is there."""
    ledger, request = build.ledger, build.request
    records = [ledger.find_shard(unit.name) for unit in build.units]
    found = [record for record in records if record is not None]
    if len(found) < len(build.units):
        return None
    counts = Counter(build.listed.counts)
    for name in build.names:
        plan = ledger.read_plan(name)
        counts.update(plan.problems if plan else {})
    skipped = sum(len(record.skipped) for record in found)
    counts.update({"skipped_graph": skipped} if skipped else {})
    entries = [record.entry for record in found if record.entry.num_graphs]
    if not entries:
        seen = Problems(counts=counts)
        raise DataError(
            f"{ledger.out}: no scene yields a graph of {request.sampling.min_views} views (left"
            f" out: {seen.summary()}); look for wrong cameras or depth, take more frames, or lower"
            " --min-views"
        )
    before = ledger.find_manifest()
    if before is not None and before.shards == entries:
        return before  # with the problems of a build whose records are gone
    met = {PROBLEMS: dict(sorted(counts.items()))} if counts else {}
    manifest = Manifest(
        dataset=dataset,
        min_views=request.sampling.min_views,
        max_views=request.sampling.max_views,
        shards=entries,
        request={**asdict(request), **met},
    )
    write_manifest(ledger.out, manifest)
    ledger.remove_remains()
    return manifest
