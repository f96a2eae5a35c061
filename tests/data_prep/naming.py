"""What a build that is shared out relies on, for any converter."""

from data_prep.converters import list_scenes, read_scenes
from data_prep.problems import Problems


def describe_frame(frame):
    return frame.name, frame.image_size, frame.K.tolist(), frame.world_from_cam.tolist()


def describe(scenes):
    return {scene.name: [*map(describe_frame, scene.frames)] for scene in scenes}


def assert_scenes_are_named_before_they_are_read(dataset, root, split="train", **options):
    """Names are in one order and hold all scenes; one by one these are what they are together.

    Returns:
        The names.
    """
    names = list_scenes(dataset, root, split, problems=Problems(), **options)
    assert names == list_scenes(dataset, root, split, problems=Problems(), **options)
    assert len(set(names)) == len(names)
    whole = Problems()
    together = describe(read_scenes(dataset, root, split, problems=whole, **options))
    assert together.keys() <= set(names)
    for name in names:
        alone = Problems()
        found = describe(read_scenes(dataset, root, split, problems=alone, names=[name], **options))
        assert found == {n: frames for n, frames in together.items() if n == name}
        assert alone.by_scene.get(name) == whole.by_scene.get(name)
        assert alone.by_scene.keys() <= {name}
    assert not describe(read_scenes(dataset, root, split, problems=Problems(), names=[], **options))
    return names
