import json

import pytest

from data_prep.converters.co3d import Options, read, survey
from data_prep.converters.co3d.splits import read_set_lists
from data_prep.problems import Problems
from l3r.errors import DataError
from tests.data_prep.co3d.writer import (
    Recipe,
    put,
    sequence_annotation,
    write_category,
    write_jgz,
    write_lists,
    write_sequence,
)

SEQUENCES = ("train_a", "train_b", "dev_a", "many_a")


@pytest.fixture(scope="module")
def sequences(tmp_path_factory):
    """A root of four sequences without set lists, and the records of each."""
    root = tmp_path_factory.mktemp("splits")
    recipes = [Recipe(sequence=name, image_size=(16, 16), first_number=100) for name in SEQUENCES]
    records = {recipe.sequence: write_sequence(root, recipe) for recipe in recipes}
    write_category(root, [r for some in records.values() for r in some], lists=False)
    return root, records


@pytest.fixture
def listed(sequences):
    """The same with the set lists removed after each test."""
    yield sequences
    for path in (sequences[0] / "apple" / "set_lists").glob("*"):
        path.unlink()


def frames_of(root, split, **options):
    """Scene name -> frame names; nothing where no scene is left."""
    try:
        scenes = list(read(root, split, problems=Problems(quiet=True), **options))
    except DataError:
        return {}
    return {scene.name.removeprefix("apple/"): len(scene.frames) for scene in scenes}


def test_few_view_test_sequences_are_held_out_whole(listed):
    root, records = listed
    # As published: the test list of fewview_train repeats its training frames.
    both = records["train_a"] + records["train_b"]
    write_lists(root, "fewview_train", train=both, test=both)
    write_lists(
        root, "fewview_dev", train=both, val=records["dev_a"][:1], test=records["dev_a"][1:3]
    )
    write_lists(root, "manyview_dev_0", train=records["many_a"][:3], test=records["many_a"][3:])
    assert frames_of(root, "train") == {"train_a": 4, "train_b": 4}
    assert frames_of(root, "test") == {"dev_a": 2, "many_a": 1}
    assert frames_of(root, "val") == {"dev_a": 1}
    assert frames_of(root, "all") == dict.fromkeys(SEQUENCES, 4)
    excluded = {line.name: line.excluded for line in survey(root)}
    assert excluded == {
        "apple/dev_a": "held out for testing",
        "apple/many_a": "held out for testing",
        "apple/train_a": "",
        "apple/train_b": "",
    }


def test_a_test_sequence_is_not_trained_on_though_another_list_trains_on_it(listed):
    root, records = listed
    write_lists(root, "fewview_dev", train=records["train_a"], test=records["dev_a"])
    write_lists(root, "fewview_test", train=records["dev_a"], test=records["train_b"][:1])
    write_lists(root, "manyview_test_0", train=records["train_b"], test=records["dev_a"][:1])
    # Many-view sequences are evaluated on as well, even where a list of theirs names no test.
    write_lists(root, "manyview_dev_0", train=records["many_a"])
    assert frames_of(root, "train") == {"train_a": 4}


def test_without_few_view_lists_frames_are_held_out_one_by_one(listed):
    root, records = listed
    many = records["many_a"]
    write_lists(root, "manyview_dev_0", train=many[:3], val=many[1:2], test=many[2:])
    assert frames_of(root, "train") == {"many_a": 1}
    assert frames_of(root, "val") == {"many_a": 1}
    assert frames_of(root, "test") == {"many_a": 2}
    assert [line.excluded for line in survey(root)] == [
        "in no training list",
        "",
        "in no training list",
        "in no training list",
    ]


def test_the_frame_number_is_the_key_and_not_the_suffix_of_the_file(listed, problems):
    root, records = listed
    # Numbers run 100, 101, 102, 103; files are called 1, 4, 7, 10.
    assert records["train_a"][1]["image"]["path"].endswith("frame000004.jpg")
    write_lists(root, "fewview_train", train=records["train_a"][1:3])
    (scene,) = read(root, problems=problems)
    assert [frame.name for frame in scene.frames] == ["frame000004.jpg", "frame000007.jpg"]


def test_lists_of_another_release_are_noticed(listed, problems):
    root, records = listed
    write_lists(root, "fewview_train", train=records["train_a"])
    path = root / "apple" / "set_lists" / "set_lists_fewview_train.json"
    path.write_text(path.read_text().replace("frame000004", "frame000005"))
    (scene,) = read(root, problems=problems)
    assert len(scene.frames) == 3
    assert problems.counts == {"set_list_disagrees": 1}


@pytest.mark.parametrize("split", ["train", "val", "test"])
def test_without_set_lists_nothing_is_known_to_be_free(sequences, split):
    with pytest.raises(DataError, match="1 bad_set_lists"):
        list(read(sequences[0], split, problems=Problems()))


@pytest.mark.parametrize(
    "text",
    [
        "",
        "[]",
        '{"train": [], "val": []}',
        '{"train": [], "val": [], "tesu": []}',
        '{"train": [], "val": [], "test": {}}',
        '{"train": [["a", "1", "p"]], "val": [], "test": []}',
        '{"train": [["a", 1]], "val": [], "test": []}',
        '{"train": [["a", true, "p"]], "val": [], "test": []}',
        "[" * 5000,
        "\udcff",
    ],
)
def test_one_damaged_list_closes_the_category_since_tests_may_be_named_in_it(listed, text):
    root, records = listed
    write_lists(root, "fewview_train", train=records["train_a"])
    put(root, "apple/set_lists/set_lists_fewview_dev.json", text.encode("utf-8", "surrogateescape"))
    with pytest.raises(DataError, match="set_lists_fewview_dev"):
        read_set_lists(root / "apple" / "set_lists")
    with pytest.raises(DataError, match="1 bad_set_lists"):
        list(read(root, problems=Problems()))
    assert {line.excluded for line in survey(root)} == {"no set lists that can be read"}


def judged(root, **scores):
    rows = [sequence_annotation(name, **score) for name, score in scores.items()]
    write_jgz(root / "apple" / "sequence_annotations.jgz", rows)


def test_cameras_of_low_or_unknown_quality_are_not_trained_on(listed):
    root, records = listed
    write_lists(root, "fewview_train", train=[r for some in records.values() for r in some])
    judged(root, train_a={"quality": 0.5}, train_b={"quality": 0.51}, dev_a={"quality": None})
    problems = Problems()
    assert [scene.name for scene in read(root, problems=problems)] == ["apple/train_b"]
    # many_a has no annotation at all.
    assert problems.counts == {"low_quality": 1, "quality_unknown": 2}
    assert [line.excluded for line in survey(root)] == [
        "viewpoint quality unknown, expected more than 0.5",
        "viewpoint quality unknown, expected more than 0.5",
        "viewpoint quality 0.50, expected more than 0.5",
        "",
    ]
    # Benchmarks name their sequences; nothing is left out of those.
    assert len(frames_of(root, "all")) == 4


def test_point_clouds_are_judged_on_request(listed):
    root, records = listed
    write_lists(root, "fewview_train", train=[r for some in records.values() for r in some])
    judged(root, train_a={"cloud": 0.2}, train_b={"cloud": 0.9}, dev_a={"cloud": None})
    options = Options(min_viewpoint_quality=0.0, min_pointcloud_quality=0.3)
    assert frames_of(root, "train", options=options) == {"train_b": 4}


def test_a_category_is_listed_by_its_folders_without_frame_annotations(tmp_path):
    usual = "images/{}.jpg", "depths/{}.jpg.geometric.png", "depth_masks/{}.png"
    names = [f"s{number:02d}" for number in range(20)]
    for name in names:
        for file in usual:
            put(tmp_path, f"apple/{name}/{file.format(0)}", b"")
    rows = [[name, 0, f"apple/{name}/images/0.jpg"] for name in names]
    lists = {"train": rows, "val": [], "test": []}
    put(tmp_path, "apple/set_lists/set_lists_fewview_train.json", json.dumps(lists).encode())
    scored = [sequence_annotation(name) for name in names]
    write_jgz(tmp_path / "apple" / "sequence_annotations.jgz", scored)
    # Nobody opens it: it holds some hundred megabytes.
    put(tmp_path, "apple/frame_annotations.jgz", b"damaged")
    lines = list(survey(tmp_path))
    assert [line.name for line in lines] == [f"apple/{name}" for name in names]
    assert {(line.num_images, line.image_size, line.excluded) for line in lines} == {(1, None, "")}
