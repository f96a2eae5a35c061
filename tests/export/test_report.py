import base64
import re
from dataclasses import replace
from html.parser import HTMLParser

import cv2
import numpy as np
import pytest
import torch

from l3r.export.durations import format_seconds
from l3r.export.plan import draw_plan, edge_steps, top_axes
from l3r.export.report import MAX_IMAGES, render_report
from l3r.export.run_json import RunRecord
from l3r.export.thumbnails import confidence_picture, depth_picture, photo_picture


def rename(scene, **by_view):
    files = list(scene.cameras.file)
    for view, name in by_view.items():
        files[int(view[1:])] = name
    return replace(scene, cameras=replace(scene.cameras, file=files))


def pixels(picture):
    data = base64.b64decode(picture.uri.split(",")[1])
    return cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)


class Balanced(HTMLParser):
    """Fails on tags that are not closed in order."""

    VOID = ("meta", "img", "br")

    def __init__(self):
        super().__init__()
        self.open = []
        self.tags = []

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))

    def handle_endtag(self, tag):
        assert self.open.pop() == tag


def parse(html):
    parser = Balanced()
    parser.feed(html)
    parser.close()
    assert not parser.open
    return parser.tags


def test_the_page_is_one_file_without_script_or_network(scene_with_a_loss):
    html = render_report(scene_with_a_loss, RunRecord())
    tags = parse(html)
    assert not [tag for tag, _ in tags if tag in ("script", "link", "iframe", "object")]
    for tag, attributes in tags:
        for name in ("src", "href"):
            assert attributes.get(name, "data:").startswith("data:"), tag
    assert "http" not in re.sub(r"data:[^\"]*", "", html)
    assert "url(" not in html


def test_it_says_what_it_should(scene_with_a_loss):
    record = RunRecord(
        warnings=["nearly a star"], skipped=[("bad.jpg", "truncated")], command=["l3r", "go"]
    )
    seconds = {**scene_with_a_loss.seconds, "export_ply": 90.0}
    text = re.sub(r"<[^>]+>", " ", render_report(scene_with_a_loss, record, seconds))
    text = " ".join(text.split())
    for phrase in (
        "5 / 6 images registered",
        "1 component",
        "1 min 36 s in all stages",
        "nearly a star",
        "bad.jpg was left out: truncated",
        "root: ring_000.jpg",
        "2 edges not drawn",
        "export ply 1 min 30 s",
        "not registered",
        "160 &times; 120 px, focal length 144 px",
        "Largest degree: 2",
        "l3r go",
    ):
        assert phrase in text, phrase


def test_odd_names_are_escaped(scene):
    evil = '"><script>alert(1)</script>&amp;.jpg'
    html = render_report(
        rename(scene, v0=evil, v3=evil + "2"),
        RunRecord(
            warnings=[evil], skipped=[(evil, evil)], command=[evil], diagnostics={evil: evil}
        ),
    )
    assert "<script" not in html
    assert "&lt;script&gt;" in html
    parse(html)


def test_pictures_end_at_the_limit_and_the_page_says_so(scene):
    n = MAX_IMAGES + 3
    times = -(-n // 6)
    cameras = replace(
        scene.cameras,
        file=[f"{i}.jpg" for i in range(n)],
        image_size=(scene.cameras.image_size * times)[:n],
        K=scene.cameras.K.repeat(times, 1, 1)[:n],
        cam_from_world=scene.cameras.cam_from_world.repeat(times, 1, 1)[:n],
        registered=torch.ones(n, dtype=torch.bool),
        component=torch.zeros(n, dtype=torch.int64),
    )
    tree = replace(
        scene.tree,
        parent=torch.zeros(1, n - 1, dtype=torch.int64),
        child=torch.arange(1, n)[None],
        level=torch.ones(1, n - 1, dtype=torch.int64),
        parent_edge=-torch.ones(1, n - 1, dtype=torch.int64),
        cost=torch.ones(1, n - 1, dtype=torch.float64),
    )
    many = replace(
        scene,
        cameras=cameras,
        tree=tree,
        image=(scene.image * times)[:n],
        pts3d_world=(scene.pts3d_world * times)[:n],
        conf=(scene.conf * times)[:n],
        window=(scene.window * times)[:n],
        scores=torch.ones(n, n),
        residual=torch.zeros(n - 1),
        point_rule=["threshold"] * n,
    )
    html = render_report(many, RunRecord())
    assert f"The first {MAX_IMAGES} of {n} images" in html
    assert html.count("<article") == MAX_IMAGES


def test_the_plan_is_seen_from_above_and_not_mirrored(scene):
    axes = top_axes(scene.cameras.cam_from_world)
    right, up = axes
    # The world's up is -y: who looks down on it sees right x up point at the viewer.
    torch.testing.assert_close(
        torch.linalg.cross(right, up), torch.tensor([0.0, -1.0, 0.0]).double(), atol=1e-6, rtol=0
    )
    plan = draw_plan(scene)
    turns = [
        np.cross([*(np.subtract(b, o)), 0], [*(np.subtract(c, o)), 0])[2]
        for o, b, c in zip(*(_positions(plan, k) for k in range(3)), strict=True)
    ]
    # Cameras stand counter-clockwise in x, z; seen from -y that stays so, and pages count y down.
    assert len({np.sign(turn) for turn in turns}) == 1


def _positions(plan, shift):
    xy = [(camera.x, camera.y) for camera in plan.cameras]
    return xy[shift:] + xy[:shift]


def test_the_plan_fits_its_page(scene_with_a_loss):
    plan = draw_plan(scene_with_a_loss)
    assert len(plan.cameras) == 5
    assert [camera.view for camera in plan.cameras if camera.is_root] == [0]
    assert plan.hidden_edges == 2
    numbers = np.array(re.findall(r"(-?[\d.]+) (-?[\d.]+)", plan.cameras[0].path + plan.points))
    xy = numbers.astype(float)
    assert (xy >= 0).all()
    assert (xy <= [plan.width, plan.height]).all()


@pytest.mark.parametrize("views", [[0], [0, 1], []])
def test_few_cameras_can_be_drawn(scene, views):
    registered = torch.zeros(6, dtype=torch.bool)
    registered[views] = True
    plan = draw_plan(replace(scene, cameras=replace(scene.cameras, registered=registered)))
    assert len(plan.cameras if plan else []) == len(views)
    if plan:
        assert "nan" not in plan.points + "".join(camera.path for camera in plan.cameras)


def test_cameras_at_one_place_can_be_drawn(scene):
    cam_from_world = scene.cameras.cam_from_world.clone()
    cam_from_world[:, :3, 3] = 0
    plan = draw_plan(replace(scene, cameras=replace(scene.cameras, cam_from_world=cam_from_world)))
    assert "nan" not in plan.points + "".join(camera.path for camera in plan.cameras)


def test_edges_are_graded_by_similarity():
    assert edge_steps(torch.tensor([0.9, 0.5, 0.7])) == [0, 4, 2]
    assert edge_steps(torch.tensor([0.5, 0.5])) == [0, 0]
    assert edge_steps(torch.zeros(0)) == []


def test_pictures_are_small_true_and_robust():
    photo = torch.zeros(3, 480, 640)
    photo[0] = 1.0
    red = pixels(photo_picture(photo))
    assert red.shape == (240, 320, 3)
    assert red[0, 0].tolist() == pytest.approx([0, 0, 254], abs=3)
    depth = torch.linspace(1, 10, 200 * 200).reshape(200, 200)
    depth[0, 0] = torch.nan
    depth[-1, -1] = -1
    colors = pixels(depth_picture(depth)).astype(int)
    near, far = colors[1, 100], colors[-2, 100]
    assert near[2] > near[0]
    assert far[0] > far[2]
    assert depth_picture(torch.full((8, 8), torch.nan)).note == "no depth"
    tiny = confidence_picture(torch.ones(8, 8), highest=1.0)
    assert tiny.tiny
    assert pixels(tiny).shape == (8, 8, 3)


def test_seconds_are_short():
    assert [format_seconds(s) for s in (0.0123, 1.25, 59.94, 75.0, 7290.0)] == [
        "12 ms",
        "1.2 s",
        "59.9 s",
        "1 min 15 s",
        "2 h 01 min",
    ]
