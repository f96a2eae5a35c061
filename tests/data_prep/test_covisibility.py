import math
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.sparse import csr_array

from data_prep.converters.synthetic import intrinsics
from data_prep.covisibility import croco_score, read_own_overlap, relate_pairs
from data_prep.depth_views import prepare_views
from data_prep.raycast import render
from data_prep.room import build_room, draw_cameras
from data_prep.scene import Frame, Scene
from l3r.errors import DataError
from tests.data_prep.relations import count_seen, relate_all, square
from tests.data_prep.scattered import scatter


@pytest.fixture(scope="module")
def few(room_scene):
    return replace(room_scene, frames=room_scene.frames[:6])


@pytest.fixture(scope="module")
def table(few):
    return relate_all(few)


def grid_points(frame, stride):
    """Known grid points of a frame, one by one: pixel, depth and world point."""
    depth = frame.read_depth()
    for row in range(stride // 2, depth.shape[0], stride):
        for column in range(stride // 2, depth.shape[1], stride):
            z = float(depth[row, column])
            if z > 0:
                ray = np.linalg.solve(frame.K, [column + 0.5, row + 0.5, 1.0])
                yield (frame.world_from_cam @ [*(z * ray), 1.0])[:3]


def is_seen(point, frame, depth):
    x, y, z = (np.linalg.inv(frame.world_from_cam) @ [*point, 1.0])[:3]
    if z <= 0:
        return False
    u, v, _ = frame.K @ [x / z, y / z, 1.0]
    row, column = math.floor(v), math.floor(u)
    if not (0 <= row < depth.shape[0] and 0 <= column < depth.shape[1]):
        return False
    found = float(depth[row, column])
    return found > 0 and abs(found - z) <= max(0.05 * z, 0.05)


def test_counts_equal_a_loop_over_points(few):
    seen = count_seen(prepare_views(few))
    depths = [frame.read_depth() for frame in few.frames]
    for i in range(3):
        points = list(grid_points(few.frames[i], stride=4))
        for j, frame in enumerate(few.frames):
            expected = sum(is_seen(point, frame, depths[j]) for point in points)
            # Points within rounding of a pixel's edge may fall on either side.
            assert abs(int(seen[i, j]) - expected) <= 0.002 * len(points)


def test_the_table_follows_from_the_counts(few, table):
    views = prepare_views(few)
    seen, count = count_seen(views), views.valid.sum(-1).numpy()
    np.testing.assert_array_equal(seen.diagonal(), count)
    iou, covisible = square(table, "iou"), square(table, "covisible")
    for i, j in ((0, 1), (2, 5), (4, 3)):
        common = (seen[i, j] + seen[j, i]) / 2
        assert iou[i, j] == pytest.approx(common / (count[i] + count[j] - common), abs=1e-6)
        assert covisible[i, j] == pytest.approx(seen[i, j] / count[i])


def test_a_pair_is_related_alike_whatever_stands_beside_it(few, table):
    views = prepare_views(few)
    for rows in ([3], [14, 2, 7], list(range(15))[::-1]):
        part = relate_pairs(few, views, table.views[rows])
        for name in ("iou", "covisible", "rotation", "axis", "parallax", "angle", "score"):
            np.testing.assert_array_equal(getattr(part, name), getattr(table, name)[sorted(rows)])


@given(st.permutations(range(6)))
def test_the_order_of_the_images_does_not_matter(few, table, order):
    found = relate_all(few.take(order))
    for name in ("iou", "covisible", "rotation", "axis", "parallax", "angle", "score"):
        expected = square(table, name)[np.ix_(order, order)]
        np.testing.assert_allclose(square(found, name), expected, rtol=2e-6, atol=2e-6)


def test_angles_equal_their_definitions(few, table):
    found = square(table, "rotation"), square(table, "axis")
    for i, j in ((0, 1), (2, 5)):
        Ri, Rj = (few.frames[k].world_from_cam[:3, :3] for k in (i, j))
        rotation = math.acos((np.trace(Ri.T @ Rj) - 1) / 2)
        axis = math.acos(Ri[:, 2] @ Rj[:, 2])
        assert [angle[i, j] for angle in found] == pytest.approx([rotation, axis], abs=1e-5)


def wall(offset, distance=4.0, size=(48, 64), metric_depth=None):
    """A camera at a sideways offset in front of a wall."""
    camera = np.eye(4)
    camera[0, 3] = offset
    depth = np.full(size, distance if metric_depth is None else metric_depth, np.float32)
    height, width = size
    K = np.array([[width / 2, 0, width / 2], [0, width / 2, height / 2], [0, 0, 1]])
    return Frame(
        name=f"{offset}.png",
        image_size=size,
        K=K,
        world_from_cam=camera,
        read_image=partial(np.zeros, (*size, 3), np.uint8),
        read_depth=lambda: depth,
    )


def wall_scene(*frames):
    return Scene(dataset="toy", name="wall", is_metric=True, frames=list(frames))


def test_a_shift_along_a_wall_overlaps_by_what_stays_in_view():
    # The wall is 8 m wide in view: a shift of 2 m leaves 6 m, IoU 6 / 10.
    scene = wall_scene(wall(0.0), wall(2.0), wall(20.0))
    table = relate_all(scene)
    assert table.covisible[0] == pytest.approx([0.75, 0.75])
    assert table.iou == pytest.approx([0.6, 0, 0])


def test_parallax_stands_in_where_nothing_turns():
    scene = wall_scene(wall(0.0), wall(2.0))
    table = relate_all(scene)
    first, second = np.zeros(3), np.array([2.0, 0, 0])
    common = [
        point
        for frame in scene.frames
        for point in grid_points(frame, stride=4)
        if -2 < point[0] < 4  # both see the wall from 2 m left of the first to 4 m right
    ]
    angles = [
        math.acos(
            (first - p) @ (second - p) / np.linalg.norm(first - p) / np.linalg.norm(second - p)
        )
        for p in common
    ]
    assert table.parallax[0] == pytest.approx(np.median(angles), abs=0.01)
    assert table.rotation[0] == pytest.approx(0, abs=1e-6)
    assert table.angle[0] == table.parallax[0]
    assert table.score[0] > 0


def test_parallax_of_pairs_without_common_points_is_nan():
    table = relate_all(wall_scene(wall(0.0), wall(20.0)))
    assert np.isnan(table.parallax).all()
    assert (table.angle == table.rotation).all()


def test_what_another_surface_hides_is_not_seen():
    scene = wall_scene(wall(0.0), wall(1.0, metric_depth=2.0))
    assert count_seen(prepare_views(scene))[0, 1] == 0


def test_unknown_depth_counts_nowhere():
    scene = wall_scene(wall(0.0), wall(0.5, metric_depth=0.0))
    table = relate_all(scene)
    assert prepare_views(scene).valid[1].sum() == 0
    assert table.iou[0] == 0
    assert np.isfinite(table.score).all()


def test_far_from_the_origin_nothing_changes(few):
    moved = []
    for frame in few.frames:
        camera = frame.world_from_cam.copy()
        camera[:3, 3] += [4e5, -5e6, 100.0]
        moved.append(replace(frame, world_from_cam=camera))
    seen = count_seen(prepare_views(replace(few, frames=moved)))
    assert np.abs(seen - count_seen(prepare_views(few))).max() <= 2


@pytest.mark.parametrize(
    "sizes", [((48, 64), (96, 128)), ((48, 64), (64, 48)), ((90, 64), (48, 200))]
)
def test_images_of_several_sizes_overlap_by_what_both_see(sizes):
    # Cameras of one focal length per width, so that each sees 8 m of the wall sideways.
    scene = wall_scene(wall(0.0, size=sizes[0]), wall(2.0, size=sizes[1]))
    table = relate_all(scene)
    for i, j in ((0, 1), (1, 0)):
        points = list(grid_points(scene.frames[i], stride=4))
        there = scene.frames[j]
        expected = np.mean([is_seen(point, there, there.read_depth()) for point in points])
        assert table.covisible[0, i] == pytest.approx(expected, abs=0.02)
    assert 0.2 < table.iou[0] < 0.8


def test_a_scene_of_one_size_does_not_change_when_another_size_joins(few, table):
    big = replace(wall(0.0, size=(240, 320)), world_from_cam=few.frames[0].world_from_cam)
    joined = replace(few, frames=[*few.frames, big])
    found = relate_all(joined)
    found = found.take((found.views < 6).all(axis=1))
    np.testing.assert_allclose(found.iou, table.iou)
    np.testing.assert_allclose(found.covisible, table.covisible)


def test_a_very_tall_image_is_thinned_along_its_height():
    frame = wall(0.0, size=(3200, 400))
    views = prepare_views(wall_scene(frame, wall(0.5, size=(3200, 400))))
    assert views.depth.shape[1:] == (3200 // 5 + 2, 400 // 5 + 2)
    assert views.valid.shape[1] == (3200 // 25) * (400 // 25)


def compare(scene, scattered):
    """Overlap of all pairs, from all of the depth and from what was kept of it."""
    tables = [relate_all(each) for each in (scene, scattered)]
    # Of each ordered pair its overlap and its share.
    return [np.stack([np.tile(t.iou, 2), t.covisible.T.reshape(-1)]) for t in tables]


def test_scattered_depth_gives_the_overlap_of_the_whole(few):
    # Here the grid is as fine as what is known; the next test has the sizes of genuine images.
    whole, found = compare(few, scatter(few, "waymo", share=0.15))
    assert np.abs(found - whole).mean() < 0.03
    assert np.abs(found - whole).max() < 0.15
    assert (whole[0] > 0.2).any()


@pytest.mark.slow
@pytest.mark.parametrize(("share", "low"), [(0.07, 0.02), (0.01, 0.04)])
def test_at_the_size_of_genuine_images_the_overlap_is_close_and_orders_pairs_alike(share, low):
    room, size = build_room(3), (480, 640)
    cameras = draw_cameras(room, 12, seed=1)
    K = intrinsics(size)
    frames = []
    for camera in cameras:
        _, depth = render(room, torch.from_numpy(K), camera[None], size)
        frames.append(
            replace(
                wall(0.0, size=size),
                K=K,
                world_from_cam=camera.numpy(),
                read_depth=partial(np.asarray, depth[0].numpy()),
            )
        )
    scene = wall_scene(*frames)
    whole, found = compare(scene, scatter(scene, "waymo", share=share))
    seen = whole[0] > 0.05
    assert -low < (found - whole)[0, seen].mean() < 0.005
    assert np.corrcoef(whole[0], found[0])[0, 1] > 0.998


def test_an_image_of_scattered_depth_sees_its_own_points(few):
    scene = scatter(few, "waymo", share=0.15)
    views = prepare_views(scene)
    share = count_seen(views).diagonal() / views.valid.sum(-1).numpy()
    assert (share > 0.97).all()
    # One point at most from each cell of four by four pixels, of those that are known.
    depth = scene.frames[0].read_depth()
    cells = depth.reshape(30, 4, 40, 4).max((1, 3)) > 0
    assert views.valid[0].sum() == cells.sum()


def test_scattered_depth_says_nothing_far_from_where_it_is_known():
    scene = wall_scene(wall(0.0, size=(480, 640)), wall(0.0, size=(480, 640)))
    half = np.zeros((480, 640), np.float32)
    half[::7, 0:320:5] = 4.0
    frames = [scene.frames[0], replace(scene.frames[1], read_depth=lambda: half)]
    scene = replace(scene, frames=frames, has_sparse_depth=True)
    table = relate_all(scene)
    assert table.covisible[0, 0] == pytest.approx(0.5 + 16 / 640, abs=0.02)
    assert table.covisible[0, 1] == pytest.approx(1, abs=0.01)


def overlap_of(scene, value):
    n = len(scene.frames)
    whole = np.full((n, n), value) + (1 - value) * np.eye(n)
    return replace(scene, read_overlap=lambda: csr_array(whole))


def test_the_overlap_a_scene_knows_itself_takes_the_place_of_reprojection(few, table):
    found = relate_all(overlap_of(few, 0.25))
    assert (found.iou == 0.25).all()
    np.testing.assert_array_equal(found.covisible, table.covisible)
    score = croco_score(torch.from_numpy(found.iou), torch.from_numpy(found.angle))
    np.testing.assert_array_equal(found.score, score.numpy())


def test_pairs_that_a_scene_does_not_name_do_not_overlap(few):
    entries = csr_array(([1.0] * 6 + [0.5, 0.5], ([*range(6), 1, 4], [*range(6), 4, 1])))
    found = relate_all(replace(few, read_overlap=lambda: entries))
    assert found.iou[found.find(np.array([[4, 1]]))] == 0.5
    assert found.iou.sum() == 0.5


def test_the_overlap_follows_the_frames_that_are_kept(few):
    draw = np.random.default_rng(0).random((6, 6))
    whole = (draw + draw.T) / 2
    np.fill_diagonal(whole, 1)
    scene = replace(few, read_overlap=lambda: csr_array(whole)).take([4, 1, 3])
    kept = scene.take([0, 2]).read_overlap().toarray()
    np.testing.assert_array_equal(kept, whole[np.ix_([4, 3], [4, 3])])
    assert [frame.name for frame in scene.frames] == [few.frames[k].name for k in (4, 1, 3)]


@pytest.mark.parametrize(
    "spoil",
    [
        lambda n: np.eye(n - 1),
        lambda n: np.full((n, n), np.nan),
        lambda n: 2 * np.eye(n),
        lambda n: np.eye(n) - 0.1 * np.eye(n, k=1),
        lambda n: np.eye(n) + 0.5 * np.eye(n, k=1),
    ],
)
def test_an_overlap_that_is_none_is_refused(few, spoil):
    scene = replace(few, read_overlap=lambda: csr_array(spoil(6)))
    with pytest.raises(DataError, match="its own overlap"):
        read_own_overlap(scene)


def test_depth_of_another_size_than_the_image_is_refused(few):
    scene = replace(few, frames=[replace(few.frames[0], image_size=(60, 80))])
    with pytest.raises(DataError, match=r"depth is \(120, 160\)"):
        prepare_views(scene)


iou = st.floats(0, 1)
angle = st.floats(0, math.pi)


@given(iou, angle)
def test_the_score_stays_between_zero_and_the_overlap(iou, angle):
    score = croco_score(torch.tensor(iou), torch.tensor(angle)).item()
    assert 0 <= score <= iou + 1e-6


@given(iou)
def test_the_score_is_the_overlap_at_sixty_degrees(iou):
    score = croco_score(torch.tensor(iou), torch.tensor(math.radians(60)))
    assert score.item() == pytest.approx(iou, abs=1e-6)


@pytest.mark.parametrize(
    ("degrees", "value"), [(0, 0), (10, 0.060), (30, 0.464), (45, 0.828), (75, 0.767), (120, 0)]
)
def test_the_score_has_the_published_values(degrees, value):
    score = croco_score(torch.tensor(1.0), torch.tensor(math.radians(degrees)))
    assert score.item() == pytest.approx(value, abs=5e-4)
