"""A build shared out over tasks and workers, killed and taken up again, writes the same bytes."""

import itertools
import os
import random
import signal
import subprocess
import sys
import time
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from data_prep.build import build_shards
from data_prep.ledger import FOLDER
from data_prep.plan import ScenePlan, plan_scene
from data_prep.plan_file import read_plan, write_plan
from data_prep.source import HeldSource, PartSource
from data_prep.units import BuildRequest, TaskShare, list_units
from l3r.data.schema import MANIFEST_NAME, load_index, read_manifest
from l3r.errors import DataError
from tests.data_prep.conftest import BUILD

PREP = [sys.executable, "-c", "import sys; from data_prep.cli import main; sys.exit(main())"]
MOMENTS = 10


@pytest.fixture(scope="session")
def three_scenes(room_scene):
    """Parts of the room under three names."""
    parts = (range(0, 16), range(4, 20), range(8, 24))
    return HeldSource([replace(room_scene.take(v), name=f"s{n}") for n, v in enumerate(parts)])


def contents(folder):
    """Every file that a reader may see."""
    files = sorted(path for path in folder.iterdir() if not path.name.startswith("."))
    return {path.name: path.read_bytes() for path in files}


names = st.lists(st.text("abc/", min_size=1, max_size=4), unique=True, max_size=12)
requests = st.builds(BuildRequest, num_graphs=st.integers(1, 9), graphs_per_shard=st.integers(1, 9))


@given(names=names, request=requests, count=st.integers(1, 20))
def test_tasks_share_the_units_out_and_units_the_graphs(names, request, count):
    units = list_units("d", names, request)
    shares = [TaskShare(index=index, count=count).take(units) for index in range(count)]
    assert list(itertools.chain(*shares)) == units
    assert max(map(len, shares)) - min(map(len, shares)) <= 1
    graphs = [
        (part.scene, number)
        for unit in units
        for part in unit.parts
        for number in range(part.first, part.last)
    ]
    assert graphs == [(name, number) for name in names for number in range(request.num_graphs)]
    assert all(unit.room <= request.graphs_per_shard for unit in units)
    assert [unit.name for unit in units] == sorted({unit.name for unit in units})


@pytest.mark.parametrize("share", [(1, 1), (-1, 3), (0, 0)])
def test_a_task_outside_its_range_is_refused(share):
    with pytest.raises(DataError, match="expected a number from 0"):
        TaskShare(index=share[0], count=share[1])


@pytest.mark.parametrize("size", [2, 20])
def test_the_number_and_order_of_tasks_change_no_byte(three_scenes, tmp_path, size):
    request = replace(BUILD, graphs_per_shard=size)
    whole = build_shards(three_scenes, tmp_path / "one", request)
    assert {len(unit.parts) for unit in list_units("d", "abc", request)} == {1 if size == 2 else 3}
    for count, order in ((2, (1, 0)), (5, (3, 0, 4, 2, 1))):
        out = tmp_path / str(count)
        found = [
            build_shards(three_scenes, out, request, share=TaskShare(index=index, count=count))
            for index in order
        ]
        assert found == [None] * (count - 1) + [whole] or size == 20
        assert found[-1] == whole
        assert contents(out) == contents(tmp_path / "one")


def test_workers_plan_and_write_the_same_bytes(three_scenes, tmp_path):
    build_shards(three_scenes, tmp_path / "here", BUILD)
    build_shards(three_scenes, tmp_path / "there", BUILD, num_workers=2)
    assert contents(tmp_path / "here") == contents(tmp_path / "there")


def test_small_scenes_share_a_tar_and_keep_their_own_keys(three_scenes, tmp_path):
    manifest = build_shards(three_scenes, tmp_path, replace(BUILD, graphs_per_shard=10))
    assert [shard.num_graphs for shard in manifest.shards] == [10, 5]
    keys = [entry.key for entry in load_index(tmp_path / manifest.shards[0].name).graphs]
    assert keys == [f"synthetic-s{scene}-{n:06d}" for scene in (0, 1) for n in range(5)]


def test_a_scene_has_no_more_graphs_than_its_images_allow(three_scenes, tmp_path):
    few = replace(BUILD, graphs_per_image=0.2)
    assert len(plan_scene(three_scenes.scenes[0], few).graphs) == 4  # 16 images
    assert build_shards(three_scenes, tmp_path, few).num_graphs == 3 * 4


def test_scenes_that_came_or_went_since_the_build_began_are_refused(three_scenes, tmp_path):
    build_shards(three_scenes, tmp_path, BUILD, share=TaskShare(index=0, count=2))
    fewer = HeldSource(three_scenes.scenes[:2])
    with pytest.raises(DataError, match=r"begun with 3 scenes, now there are 2 \(s2 differs\)"):
        build_shards(fewer, tmp_path, BUILD, share=TaskShare(index=1, count=2))


def test_a_scene_that_was_named_and_cannot_be_read_is_counted(three_scenes, tmp_path):
    manifest = build_shards(Without(three_scenes, whole), tmp_path, BUILD)
    assert manifest.request["problems"] == {"missing_scene": 1}
    assert manifest.num_graphs == 10


class Without(PartSource):
    """All scenes are named, one cannot be read."""

    def read(self, names, problems):
        return (scene for scene in super().read(names, problems) if scene.name != "s1")


def whole(scene):
    return scene


def test_a_scene_that_was_planned_and_cannot_be_read_any_more_ends_the_build(
    three_scenes, tmp_path
):
    straight, out = tmp_path / "straight", tmp_path / "out"
    build_shards(three_scenes, straight, BUILD)
    build_shards(three_scenes, out, BUILD, share=TaskShare(index=0, count=2))
    spoilt = Without(three_scenes, whole)
    for _ in range(2):
        with pytest.raises(DataError, match=r"s1 has graphs to be written and cannot be read"):
            build_shards(spoilt, out, BUILD, share=TaskShare(index=1, count=2))
    build_shards(three_scenes, out, BUILD, share=TaskShare(index=1, count=2))
    assert contents(out) == contents(straight)
    # And in a finished folder that has lost a tar of it.
    (out / "synthetic-000004.tar").unlink()
    with pytest.raises(DataError, match="cannot be read any more"):
        build_shards(spoilt, out, BUILD)
    build_shards(three_scenes, out, BUILD)
    assert contents(out) == contents(straight)


def test_a_scene_that_could_not_be_read_by_one_task_is_left_out_by_all(three_scenes, tmp_path):
    whole_build = build_shards(Without(three_scenes, whole), tmp_path / "one", BUILD)
    out = tmp_path / "two"
    spoilt = Without(three_scenes, whole)
    assert build_shards(spoilt, out, BUILD, share=TaskShare(index=0, count=2)) is None
    found = build_shards(three_scenes, out, BUILD, share=TaskShare(index=1, count=2))
    assert found == whole_build
    assert contents(out) == contents(tmp_path / "one")


def test_of_two_plans_of_a_scene_the_first_is_kept(room_scene, tmp_path):
    write_plan(tmp_path / "plan.npz", plan_scene(room_scene, BUILD))
    before = (tmp_path / "plan.npz").read_bytes()
    write_plan(tmp_path / "plan.npz", ScenePlan())
    assert (tmp_path / "plan.npz").read_bytes() == before


def test_a_shard_that_vanishes_while_others_are_written_is_named(three_scenes, tmp_path):
    out = tmp_path / "out"

    def vandal(name, done, total):
        if name == "graphs written" and done == 4:
            (out / "synthetic-000000.tar").unlink()

    with pytest.raises(DataError, match=r"synthetic-000000\.tar: was finished and is gone"):
        build_shards(three_scenes, out, BUILD, report=vandal)
    assert not (out / MANIFEST_NAME).exists()
    build_shards(three_scenes, out, BUILD)
    build_shards(three_scenes, tmp_path / "whole", BUILD)
    assert contents(out) == contents(tmp_path / "whole")


@pytest.mark.parametrize("workers", [0, 2])
def test_a_tar_is_recorded_before_the_next_ones_are_all_written(three_scenes, tmp_path, workers):
    """Else a build that is killed begins anew."""
    lead = []

    def watch(name, done, total):
        records = {path.stem for path in (tmp_path / FOLDER).glob("*.tar.json")}
        lead.append(len({path.name for path in tmp_path.glob("*.tar")} - records))

    request = replace(BUILD, graphs_per_shard=1)
    build_shards(three_scenes, tmp_path, request, num_workers=workers, report=watch)
    assert max(lead) <= 2 * workers + 1


def test_a_plan_comes_back_as_it_was_written(room_scene, tmp_path):
    plan = plan_scene(room_scene, BUILD, {"missing_depth": 2})
    write_plan(tmp_path / "plan.npz", plan)
    again = read_plan(tmp_path / "plan.npz")
    assert (again.fingerprint, again.dropped, again.problems) == (
        plan.fingerprint,
        plan.dropped,
        {"missing_depth": 2},
    )
    assert [(g.key, g.views) for g in again.graphs] == [(g.key, g.views) for g in plan.graphs]
    for one, other in zip(again.graphs, plan.graphs, strict=True):
        for name in vars(one.pairs):
            assert getattr(one.pairs, name).tobytes() == getattr(other.pairs, name).tobytes()
    write_plan(tmp_path / "none.npz", ScenePlan())
    assert read_plan(tmp_path / "none.npz") == ScenePlan()


@settings(max_examples=30)
@given(at=st.floats(0, 1, exclude_max=True), cut=st.booleans(), byte=st.integers(1, 255))
def test_a_damaged_plan_is_refused(damaged_plan, at, cut, byte):
    data, path = damaged_plan
    place = int(at * len(data))
    changed = bytearray(data[:place] if cut else data)
    if not cut:
        changed[place] ^= byte
    path.write_bytes(changed)
    with pytest.raises(DataError, match="remove it, the scene is planned again"):
        read_plan(path)


@pytest.fixture(scope="session")
def damaged_plan(room_scene, tmp_path_factory):
    path = tmp_path_factory.mktemp("plan") / "plan.npz"
    write_plan(path, plan_scene(room_scene, BUILD))
    return path.read_bytes(), path


@pytest.fixture(scope="session")
def command(raw_room, tmp_path_factory):
    """Command line of a build of many small shards, but for --out."""
    return [
        *[*PREP, "build", "tartanair", "--raw", str(raw_room), "--split", "all"],
        *["--scenes", "*/P000", "--num-graphs", "40", "--graphs-per-image", "2"],
        *["--graphs-per-shard", "1", "--min-views", "4", "--max-views", "6"],
    ]


def run(command, out, **options):
    return subprocess.run(
        [*command, "--out", str(out)], capture_output=True, text=True, timeout=300, **options
    )


@pytest.mark.slow
def test_killed_at_ten_random_moments_a_build_ends_with_the_same_bytes(command, tmp_path):
    assert run(command, tmp_path / "straight").returncode == 0
    out, draw = tmp_path / "killed", random.Random(0)
    halted, kept = 0, {}
    for number, tars in enumerate(sorted(draw.sample(range(40), MOMENTS))):
        process = start(command, out, stderr=subprocess.DEVNULL, workers=number % 3)
        while len([*out.glob("*.tar")]) < tars or not (out / FOLDER / "request.json").is_file():
            time.sleep(0.002)
        time.sleep(draw.uniform(0, 0.1))
        halted += process.poll() is None
        process.kill()  # its workers are left to notice
        process.wait()
        wait_for_the_end_of(process)
        now = {path: path.stat().st_mtime_ns for path in out.glob("*.tar")}
        assert kept.items() <= now.items(), "a finished shard was written again"
        kept = {p: t for p, t in now.items() if (out / FOLDER / f"{p.name}.json").is_file()}
    assert halted > MOMENTS // 2
    assert run(command, out).returncode == 0
    assert contents(out) == contents(tmp_path / "straight")
    assert not [*out.glob(".*.tmp")]


def wait_for_the_end_of(process):
    """Until no process of its session is left."""
    deadline = time.monotonic() + 60
    with suppress(ProcessLookupError):
        while time.monotonic() < deadline:
            os.killpg(process.pid, 0)
            time.sleep(0.05)
        raise AssertionError("workers outlived the build")


def wait_for_a_tar(folder):
    deadline = time.monotonic() + 60
    while not [*folder.glob("*.tar")]:
        assert time.monotonic() < deadline
        time.sleep(0.05)


def start(command, out, workers=2, **options):
    return subprocess.Popen(
        [*command, "--out", str(out), "--workers", str(workers)],
        stdout=subprocess.DEVNULL,
        start_new_session=True,
        **options,
    )


LONG = ["--num-graphs", "250", "--graphs-per-image", "12"]
"""Makes a build last for seconds after its first tar."""


def test_workers_end_with_the_process_that_was_killed(command, tmp_path):
    process = start([*command, *LONG], tmp_path / "out", stderr=subprocess.DEVNULL)
    wait_for_a_tar(tmp_path / "out")
    assert Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()
    process.kill()
    process.wait()
    wait_for_the_end_of(process)


def test_a_full_disk_is_named_and_the_same_command_goes_on(command, tmp_path):
    # A limit on the size of a file fails as a full disk does: in the middle of a write.
    limited = ["bash", "-c", 'trap "" XFSZ; ulimit -f 20; exec "$@"', "bash", *command]
    found = run(limited, tmp_path)
    assert found.returncode == 2
    (line,) = [line for line in found.stderr.splitlines() if line.startswith("l3r-prep build: ")]
    assert "tartanair-000000.tar: File too large; free space, then run the same command" in line
    assert not [*tmp_path.glob("*.tar")]
    assert not [*tmp_path.glob(".*.tmp")]
    assert run(command, tmp_path).returncode == 0
    assert read_manifest(tmp_path).num_graphs == 40


def test_ctrl_c_ends_a_build_with_workers_in_one_line(command, tmp_path):
    process = start([*command, *LONG], tmp_path / "out", stderr=subprocess.PIPE, text=True)
    wait_for_a_tar(tmp_path / "out")
    os.killpg(process.pid, signal.SIGINT)  # a terminal signals the workers too
    _, errors = process.communicate(timeout=60)
    assert process.returncode == 130
    assert errors.splitlines()[-1].endswith("interrupted; run it again to go on")
    assert "Traceback" not in errors
