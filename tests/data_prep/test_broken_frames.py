"""A frame that breaks must not kill a build, nor change what else is in it."""

import json
import shutil
from dataclasses import replace

import pytest

from data_prep.build import build_shards
from data_prep.graph_sampling import SamplingOptions
from data_prep.ledger import FOLDER
from data_prep.source import HeldSource, RawSource
from l3r.data.schema import (
    MANIFEST_NAME,
    decode_graph,
    load_index,
    read_manifest,
    read_members,
)
from l3r.errors import DataError
from tests.data_prep.conftest import BUILD

BROKEN = (3, 7)


def broken(*_):
    raise DataError("disk: nothing there")


def spoil(scene, views, what="read_image"):
    """The scene with some frames that cannot be read."""
    frames = [
        replace(frame, **{what: broken}) if view in views else frame
        for view, frame in enumerate(scene.frames)
    ]
    return replace(scene, frames=frames)


def breaks_after(frame, reads):
    """The frame, whose image can be read a few times only."""
    left = [reads]

    def read():
        left[0] -= 1
        return frame.read_image() if left[0] >= 0 else broken()

    return replace(frame, read_image=read)


def build(scene, out, **options):
    """Manifest, and how often each problem came up."""
    scenes = scene if isinstance(scene, list) else [scene]
    manifest = build_shards(HeldSource(scenes), out, BUILD, **options)
    return manifest, manifest.request.get("problems", {})


def files_in(folder):
    found = []
    for shard in read_manifest(folder).shards:
        for entry in load_index(folder / shard.name).graphs:
            sample = decode_graph(read_members(folder / shard.name, entry), entry.num_views)
            found.append((entry.key, sample.file))
    return found


def digests(folder):
    return {shard.name: shard.sha256 for shard in read_manifest(folder).shards}


@pytest.mark.parametrize("what", ["read_image", "read_depth"])
def test_frames_that_cannot_be_read_are_in_no_graph_and_are_named(
    room_scene, tmp_path, caplog, what
):
    manifest, counts = build(spoil(room_scene, BROKEN, what), tmp_path)
    assert counts == {"unreadable_frame": 2}
    names = {room_scene.frames[view].name for view in BROKEN}
    assert not any(names & set(files) for _, files in files_in(tmp_path))
    assert manifest.num_graphs == BUILD.num_graphs
    assert all(name in caplog.text for name in names)


def test_the_graphs_are_those_of_the_scene_without_the_broken_frames(room_scene, tmp_path):
    kept = [view for view in range(len(room_scene.frames)) if view not in BROKEN]
    build(spoil(room_scene, BROKEN), tmp_path / "a")
    build(room_scene.take(kept), tmp_path / "b")
    assert digests(tmp_path / "a") == digests(tmp_path / "b")


def test_frames_of_which_no_depth_is_known_are_left_out(room_scene, tmp_path):
    empty = replace(room_scene.frames[0], read_depth=lambda: 0 * room_scene.frames[0].read_depth())
    scene = replace(room_scene, frames=[empty, *room_scene.frames[1:]])
    _, counts = build(scene, tmp_path)
    assert counts == {"empty_depth": 1}


def test_an_interrupted_build_leaves_the_same_frames_out_again(room_scene, tmp_path):
    def stop(name, done, total):
        if name == "graphs written" and done:
            raise KeyboardInterrupt

    scene = spoil(room_scene, BROKEN)
    build(scene, tmp_path / "straight")
    with pytest.raises(KeyboardInterrupt):
        build(scene, tmp_path / "resumed", report=stop)
    # Repaired meanwhile: what was planned without them stays without them.
    _, counts = build(room_scene, tmp_path / "resumed")
    assert digests(tmp_path / "resumed") == digests(tmp_path / "straight")
    assert counts == {"unreadable_frame": 2}
    # And a third time, when nothing is left to do.
    assert build(room_scene, tmp_path / "resumed")[1] == counts


def test_an_interrupted_build_does_not_relate_the_images_again(room_scene, room_shards, tmp_path):
    def stop(name, done, total):
        if name == "graphs written" and done:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        build(room_scene, tmp_path, report=stop)
    rest = {file for _, files in files_in(room_shards)[2:] for file in files}
    others = [n for n, frame in enumerate(room_scene.frames) if frame.name not in rest]
    assert others
    build(spoil(room_scene, others, "read_depth"), tmp_path)
    assert digests(tmp_path) == digests(room_shards)


def test_an_image_that_breaks_later_takes_its_graphs_and_no_others(
    room_scene, room_shards, tmp_path
):
    whole = dict(files_in(room_shards))
    victim = whole[min(whole)][-1]
    frames = [breaks_after(f, 1) if f.name == victim else f for f in room_scene.frames]
    manifest, counts = build(replace(room_scene, frames=frames), tmp_path)
    lost = {key for key, files in whole.items() if victim in files}
    assert 0 < len(lost) < len(whole)
    assert counts == {"skipped_graph": len(lost)}
    assert dict(files_in(tmp_path)) == {k: v for k, v in whole.items() if k not in lost}
    assert manifest.num_graphs == len(whole) - len(lost)
    assert sum(shard.num_graphs for shard in manifest.shards) == manifest.num_graphs
    # Shards that lost nothing are byte for byte what they were.
    untouched = [n for n, d in digests(room_shards).items() if digests(tmp_path).get(n) == d]
    assert untouched
    # The same command again finds everything done, and counts the same.
    assert build(room_scene, tmp_path) == (manifest, counts)


def test_a_shard_that_loses_all_its_graphs_is_not_listed(room_scene, room_shards, tmp_path):
    whole, last = files_in(room_shards), read_manifest(room_shards).shards[-1].name
    (doomed,) = load_index(room_shards / last).graphs
    # Of the only graph of the last shard, the image that the fewest others have.
    victim = min(dict(whole)[doomed.key], key=lambda f: sum(f in files for _, files in whole))
    all_break = [breaks_after(frame, 1) for frame in room_scene.frames]
    with pytest.raises(DataError, match=r"no scene yields a graph .*5 skipped_graph"):
        build(replace(room_scene, frames=all_break), tmp_path / "all")
    some_break = [breaks_after(f, 1) if f.name == victim else f for f in room_scene.frames]
    manifest, _ = build(replace(room_scene, frames=some_break), tmp_path / "some")
    listed = [shard.name for shard in manifest.shards]
    assert 0 < len(listed) < len(read_manifest(room_shards).shards)
    assert last not in listed
    assert not (tmp_path / "some" / last).exists()
    assert build(room_scene, tmp_path / "some")[0] == manifest


def test_a_folder_copied_without_its_records_is_taken_up_with_its_counts(room_scene, tmp_path):
    scene = spoil(room_scene, BROKEN)
    manifest, counts = build(scene, tmp_path)
    shutil.rmtree(tmp_path / FOLDER)
    before = (tmp_path / MANIFEST_NAME).read_bytes()
    assert build(scene, tmp_path) == (manifest, counts)
    assert (tmp_path / MANIFEST_NAME).read_bytes() == before


def test_a_scene_without_readable_frames_does_not_end_the_build(room_scene, room_shards, tmp_path):
    dead = replace(spoil(room_scene, range(24)), name="dead")
    _, counts = build([dead, room_scene], tmp_path)
    assert counts == {"unreadable_frame": 24}
    assert [*digests(tmp_path).values()] == [*digests(room_shards).values()]


def test_a_scene_whose_own_overlap_is_damaged_does_not_end_the_build(
    room_scene, room_shards, tmp_path
):
    dead = replace(room_scene, name="dead", read_overlap=broken)
    _, counts = build([dead, room_scene], tmp_path)
    assert counts == {"unusable_scene": 1}
    assert [*digests(tmp_path).values()] == [*digests(room_shards).values()]


def test_scenes_whose_names_become_one_are_not_mixed(room_scene, room_shards, tmp_path):
    other = replace(room_scene, name=room_scene.name.replace("/", " "))
    assert other.slug == room_scene.slug
    _, counts = build([room_scene, other], tmp_path)
    assert counts == {"name_clash": 1}
    assert digests(tmp_path) == digests(room_shards)


def test_the_problems_of_the_converter_are_counted_in_the_manifest(raw, tmp_path):
    (raw / "depth_left" / "000003_left_depth.npy").unlink()
    source = RawSource(converter="tartanair", root=raw, split="all", label="synthetic")
    request = replace(BUILD, sampling=SamplingOptions(min_views=3, max_views=3))
    manifest = build_shards(source, tmp_path / "shards", request)
    assert manifest.request["problems"] == {"missing_depth": 1}
    plain = json.loads((tmp_path / "shards" / MANIFEST_NAME).read_bytes())
    assert plain["request"]["problems"] == {"missing_depth": 1}
