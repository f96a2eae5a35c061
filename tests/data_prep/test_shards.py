import io
import json
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import webdataset

from data_prep.build import build_shards
from data_prep.draw import scene_seed
from data_prep.frames import STORABLE, FrameCache, read_depth, reduce_frame
from data_prep.ledger import FOLDER
from data_prep.plan import hold_out, plan_scene
from data_prep.scene import Frame
from data_prep.shards import relative_to_first
from data_prep.source import HeldSource
from data_prep.stored_size import reduced_size
from l3r.data.schema import MANIFEST_NAME, decode_graph, load_index, read_manifest, read_members
from l3r.errors import DataError
from tests.data_prep.conftest import BUILD

GOLDEN = Path(__file__).parents[1] / "golden" / "shard_listing.txt"


def digests(folder):
    return {shard.name: shard.sha256 for shard in read_manifest(folder).shards}


@pytest.fixture
def copied(room_shards, tmp_path):
    return shutil.copytree(room_shards, tmp_path / "copied")


def test_plain_webdataset_reads_the_shards(room_shards):
    urls = [str(room_shards / shard.name) for shard in read_manifest(room_shards).shards]
    samples = list(webdataset.WebDataset(urls, shardshuffle=False))
    assert [sample["__key__"][-6:] for sample in samples] == [f"{n:06d}" for n in range(5)]
    for sample in samples:
        meta = json.loads(sample["json"])
        depth = np.load(io.BytesIO(sample["00.depth.npy"]), allow_pickle=False)
        image = cv2.imdecode(np.frombuffer(sample["00.jpg"], np.uint8), cv2.IMREAD_COLOR)
        assert [*image.shape[:2]] == [*depth.shape] == meta["image_size"][0]


def test_the_listing_of_a_shard_is_as_recorded(room_shards):
    shard = room_shards / read_manifest(room_shards).shards[0].name
    entry = load_index(shard).graphs[0]
    members = read_members(shard, entry)
    meta = json.loads(members["json"])
    lines = [f"{entry.key}.{name}" for name in members if name != "__key__"]
    lines += [f"json: {key}" for key in meta] + [f"pairs: {key}" for key in meta["pairs"]]
    assert lines == GOLDEN.read_text().splitlines()


def test_graphs_agree_with_their_source(room_shards, room_scene):
    shard = room_shards / read_manifest(room_shards).shards[0].name
    entry = load_index(shard).graphs[0]
    sample = decode_graph(read_members(shard, entry), entry.num_views)
    frames = {frame.name: frame for frame in room_scene.frames}
    first = frames[sample.file[0]].world_from_cam
    for view, name in enumerate(sample.file):
        frame = frames[name]
        np.testing.assert_array_equal(sample.K[view], frame.K)
        np.testing.assert_allclose(sample.depth[view], frame.read_depth(), rtol=2**-11)
        np.testing.assert_allclose(
            first @ np.linalg.inv(sample.cam_from_world[view]), frame.world_from_cam, atol=1e-9
        )
        error = np.abs(sample.image[view].astype(int) - frame.read_image())
        assert np.median(error) <= 2  # JPEG
    assert sample.pairs.iou.diagonal().min() == 1
    assert (sample.pairs.iou[~np.eye(entry.num_views, dtype=bool)] <= 0.75).all()


def test_two_builds_agree_byte_for_byte(room_shards, room_scene, tmp_path):
    build_shards(HeldSource([room_scene]), tmp_path, BUILD)
    assert digests(tmp_path) == digests(room_shards)


def test_the_number_of_workers_changes_no_byte(room_shards, room_scene, tmp_path):
    build_shards(HeldSource([room_scene]), tmp_path, BUILD, num_workers=2)
    assert digests(tmp_path) == digests(room_shards)


def test_a_removed_shard_comes_back_with_the_same_bytes(copied, room_scene, room_shards):
    names = [shard.name for shard in read_manifest(copied).shards]
    (copied / names[1]).unlink()
    kept = (copied / names[0]).stat().st_mtime_ns
    build_shards(HeldSource([room_scene]), copied, BUILD)
    assert digests(copied) == digests(room_shards)
    assert (copied / names[1]).read_bytes() == (room_shards / names[1]).read_bytes()
    assert (copied / names[0]).stat().st_mtime_ns == kept


def test_an_interrupted_build_goes_on(room_scene, room_shards, tmp_path):
    def stop(name, done, total):
        if name == "graphs written" and done:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        build_shards(HeldSource([room_scene]), tmp_path, BUILD, report=stop)
    assert not (tmp_path / MANIFEST_NAME).exists()
    seen = []
    build_shards(HeldSource([room_scene]), tmp_path, BUILD, report=lambda *step: seen.append(step))
    assert [step[1:] for step in seen if step[0] == "graphs written"] == [(0, 3), (2, 3), (3, 3)]
    assert digests(tmp_path) == digests(room_shards)


def test_a_finished_folder_is_not_touched_even_without_its_records(copied, room_scene):
    shutil.rmtree(copied / FOLDER)
    before = {path: path.stat().st_mtime_ns for path in copied.glob("*.tar")}
    build_shards(HeldSource([room_scene]), copied, BUILD)
    assert before == {path: path.stat().st_mtime_ns for path in copied.glob("*.tar")}


def test_another_request_in_the_same_folder_is_refused(copied, room_scene):
    with pytest.raises(DataError, match="begun with seed 0, asked now with 1"):
        build_shards(HeldSource([room_scene]), copied, replace(BUILD, seed=1))


def test_changed_cameras_are_refused(copied, room_scene):
    frame = room_scene.frames[0]
    moved = replace(frame, world_from_cam=frame.world_from_cam + 1e-3)
    changed = replace(room_scene, frames=[moved, *room_scene.frames[1:]])
    (copied / read_manifest(copied).shards[0].name).unlink()
    with pytest.raises(DataError, match="have changed since the build"):
        build_shards(HeldSource([changed]), copied, BUILD)


def test_tars_of_unknown_origin_are_refused(tmp_path, room_scene):
    (tmp_path / "x.tar").write_bytes(b"")
    with pytest.raises(DataError, match="no record of a build"):
        build_shards(HeldSource([room_scene]), tmp_path, BUILD)


def test_scenes_without_a_graph_are_refused(tmp_path, room_scene):
    few = replace(room_scene, frames=room_scene.frames[:3])
    with pytest.raises(DataError, match="no scene yields a graph"):
        build_shards(HeldSource([few]), tmp_path, BUILD)


@pytest.mark.parametrize(
    "bad", [{"num_graphs": 0}, {"graphs_per_shard": 0}, {"graphs_per_image": 0.0}]
)
def test_requests_out_of_range_are_refused(bad):
    with pytest.raises(DataError, match="expected 1 or more"):
        replace(BUILD, **bad)


@pytest.mark.parametrize(
    ("size", "reduced"),
    [
        ((480, 640), (480, 640)),
        ((48, 48), (48, 48)),
        ((1280, 1920), (480, 720)),
        ((1896, 1066), (854, 480)),
        ((1000, 1000), (640, 640)),
        ((300, 4000), (300, 4000)),
    ],
)
def test_images_shrink_until_a_side_would_be_too_short(size, reduced):
    assert reduced_size(size) == reduced


def test_shrinking_keeps_depth_under_its_pixel():
    # A ramp in x: after shrinking, depth still tells the x that K says the pixel looks along.
    height, width = 960, 1280
    K = np.array([[600.0, 0, 640], [0, 600, 480], [0, 0, 1]])
    ramp = np.tile(np.arange(width) + 0.5, (height, 1)).astype(np.float32)
    frame = Frame(
        name="ramp",
        image_size=(height, width),
        K=K,
        world_from_cam=np.eye(4),
        read_image=lambda: np.repeat((ramp / 8).astype(np.uint8)[..., None], 3, axis=2),
        read_depth=lambda: ramp,
    )
    stored = reduce_frame(frame)
    assert stored.image.shape == (480, 640, 3)
    x = (np.arange(640) + 0.5 - stored.K[0, 2]) / stored.K[0, 0]
    source_x = K[0, 0] * x + K[0, 2]
    # Halved, a pixel's centre is the border of two: nearest takes one, half a source pixel off.
    assert np.abs(stored.depth[0] - source_x).max() <= 0.5 + 1e-6
    assert np.abs(stored.image[0, :, 0] - source_x / 8).max() <= 1


def test_pixels_of_another_size_than_announced_are_refused(room_scene):
    frame = replace(room_scene.frames[0], image_size=(60, 80))
    with pytest.raises(DataError, match=r"image is \(120, 160\)"):
        reduce_frame(frame)


def test_the_cache_keeps_what_fits_and_reads_again_what_does_not(room_scene):
    reads = []

    def counted(index, frame):
        def read():
            reads.append(index)
            return frame.read_image()

        return replace(frame, read_image=read)

    frames = [counted(i, frame) for i, frame in enumerate(room_scene.frames)]
    one = 120 * 160 * (3 + 4)
    cache = FrameCache(replace(room_scene, frames=frames), budget=2 * one)
    for index in (0, 1, 0, 2, 0, 1):
        cache.read(index)
    assert reads == [0, 1, 2, 1]


def test_the_first_camera_is_exactly_the_world(room_scene):
    relative = relative_to_first(room_scene.world_from_cam[3:6])
    np.testing.assert_array_equal(relative[0], np.eye(4))


def test_held_out_frames_are_the_last_ones(room_scene):
    kept, held = hold_out(room_scene, 0.25)
    assert [*kept.frames, *held.frames] == room_scene.frames
    assert len(held.frames) == 6


def test_a_scene_draws_the_same_graphs_whatever_stands_beside_it(room_scene):
    assert scene_seed("a", 0) != scene_seed("b", 0)
    first = plan_scene(room_scene, replace(BUILD, num_graphs=3)).graphs
    more = plan_scene(room_scene, replace(BUILD, num_graphs=5)).graphs
    assert [plan.views for plan in first] == [plan.views for plan in more[:3]]


def test_scattered_depth_goes_to_the_pixel_it_falls_into_the_nearest_first():
    depth = np.zeros((960, 1280), np.float32)
    points = {(0, 0): 5.0, (1, 1): 3.0, (2, 3): 9.0, (959, 1279): 2.0, (501, 700): 7.0}
    for at, z in points.items():
        depth[at] = z
    frame = Frame(
        name="points",
        image_size=(960, 1280),
        K=np.array([[600.0, 0, 640], [0, 600, 480], [0, 0, 1]]),
        world_from_cam=np.eye(4),
        read_image=lambda: np.zeros((960, 1280, 3), np.uint8),
        read_depth=lambda: depth,
    )
    stored = reduce_frame(frame, sparse=True).depth
    expected = np.zeros((480, 640), np.float32)
    expected[0, 0], expected[1, 1], expected[479, 639], expected[250, 350] = 3, 9, 2, 7
    np.testing.assert_array_equal(stored, expected)


def test_scattered_depth_keeps_its_place_at_any_ratio():
    # 1066 x 1896 becomes 480 x 854: neither side divides.
    draw = np.random.default_rng(0)
    depth = np.zeros((1896, 1066), np.float32)
    rows, columns = draw.integers(0, 1896, 500), draw.integers(0, 1066, 500)
    depth[rows, columns] = np.arange(500) + 1
    frame = Frame(
        name="points",
        image_size=depth.shape,
        K=np.array([[900.0, 0, 533], [0, 900, 948], [0, 0, 1]]),
        world_from_cam=np.eye(4),
        read_image=lambda: np.zeros((*depth.shape, 3), np.uint8),
        read_depth=lambda: depth,
    )
    stored = reduce_frame(frame, sparse=True)
    row, column = np.nonzero(stored.depth)
    number = stored.depth[row, column].astype(int) - 1
    source_row, source_column = rows[number], columns[number]
    ratio = np.array(stored.depth.shape) / np.array(depth.shape)
    assert np.abs(row + 0.5 - (source_row + 0.5) * ratio[0]).max() <= 0.5
    assert np.abs(column + 0.5 - (source_column + 0.5) * ratio[1]).max() <= 0.5
    assert len(row) > 480


def test_depth_that_shards_cannot_hold_is_unknown(room_scene):
    least, most = STORABLE
    values = [least, most, least / 2, most * 1.01, -1, np.inf, np.nan, 0]
    depth = np.array([values], np.float32)
    frame = replace(room_scene.frames[0], image_size=(1, 8), read_depth=lambda: depth)
    np.testing.assert_array_equal(read_depth(frame), [[least, most, 0, 0, 0, 0, 0, 0]])
