"""The same samples at every step, whatever the number of devices and loader processes."""

import itertools

import numpy as np
import pytest
import torch

from l3r.config import load_config
from l3r.data.loader import build_training_loader, read_ahead
from l3r.data.sampling import Variation
from l3r.data.steps import DeviceShare
from l3r.errors import ConfigError
from tests.data.described import (
    SIZES,
    Described,
    all_shares,
    data_config,
    datasets,
)
from tests.data.graphs import make_graph, make_mixed_graph, write_folder

WORLD_SIZES = (1, 2, 4, 8)


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    """Two sources; the second mixes orientations."""
    root = tmp_path_factory.mktemp("shards")
    turns = (False, True, True)
    return [
        write_folder(root / "a", [make_graph(n, 3, 32, 40) for n in range(11)]),
        write_folder(root / "b", [make_mixed_graph(n, turns, 32, 40) for n in range(7)]),
    ]


def assert_planned_alike(plans, shares):
    """Plans of several world sizes, put together over their devices, are those of one device."""
    whole = plans[0]
    for world_size in WORLD_SIZES:
        parts = [p for s, p in zip(shares, plans, strict=True) if s.world_size == world_size]
        assert {(part.step, part.image_size) for part in parts} == {(whole.step, whole.image_size)}
        together = sorted((slot for part in parts for slot in part.slots), key=lambda s: s.slot)
        assert tuple(together) == whole.slots


def assert_read_as_planned(plan, batches, shares):
    whole = batches[0]
    assert whole.key == [slot.key for slot in plan.slots]
    assert whole.image.shape[-2:] == plan.image_size
    for share, batch in zip(shares, batches, strict=True):
        own = list(share.slots(0, 8))
        assert torch.equal(batch.image, whole.image[own])
        assert torch.equal(batch.depth, whole.depth[own])
        assert torch.equal(batch.K, whole.K[own])


@pytest.mark.parametrize(
    ("num_steps", "num_read", "worker_counts"),
    [(50, 3, (2,)), pytest.param(1000, 10, (2, 3), marks=pytest.mark.slow)],
)
def test_steps_are_alike_on_any_devices_and_from_any_processes(
    folders, num_steps, num_read, worker_counts
):
    """Graphs, shapes and draws of every step; of the first few pixels, depth and cameras."""
    shares = all_shares(WORLD_SIZES)
    config = data_config(*folders)
    described = Described(datasets(config, shares), num_read)
    expected = [described[number] for number in range(num_steps)]
    for plans, _ in expected:
        assert_planned_alike(plans, shares)
    for plans, batches in expected[:num_read]:
        assert_read_as_planned(plans[0], batches, shares)
    for num_workers in worker_counts:
        config.num_workers = num_workers
        found = read_ahead(described, range(num_steps), config, pin_memory=False)
        for (plans, batches), (one, two) in zip(expected, found, strict=True):
            assert one == plans
            for ours, theirs in zip(two, batches, strict=True):
                assert torch.equal(ours.image, theirs.image)
                assert torch.equal(ours.depth, theirs.depth)
    plans = [plans[0] for plans, _ in expected]
    assert [plan.step for plan in plans] == list(range(num_steps))
    assert {plan.image_size for plan in plans} == {tuple(size) for size in SIZES}
    assert {slot.source for plan in plans for slot in plan.slots} == {0, 1}
    colors = {color for plan in plans for slot in plan.slots for color in slot.colors}
    assert len(colors) == num_steps * 8 * 3


@pytest.mark.parametrize(("world_size", "accumulate"), [(1, 4), (2, 2), (4, 2), (2, 4)])
def test_batches_of_accumulated_gradients_hold_the_same_step(folders, world_size, accumulate):
    config = data_config(*folders)
    (whole,) = datasets(config, [DeviceShare()])
    shares = [
        DeviceShare(rank=rank, world_size=world_size, accumulate=accumulate)
        for rank in range(world_size)
    ]
    devices = datasets(config, shares)
    for step in range(5):
        numbers = range(step * accumulate, (step + 1) * accumulate)
        plans = [device.describe(number) for device in devices for number in numbers]
        assert {(plan.step, plan.image_size) for plan in plans} == {
            (step, whole.describe(step).image_size)
        }
        slots = [slot for plan in plans for slot in plan.slots]
        assert all(len(plan.slots) == 8 // (world_size * accumulate) for plan in plans)
        assert sorted(slots, key=lambda s: s.slot) == list(whole.describe(step).slots)


def test_a_step_begun_in_several_batches_is_begun_again_after_a_resume(folders):
    def build():
        return build_training_loader(
            data_config(*folders), (32, 32), seed=0, num_steps=3, share=DeviceShare(accumulate=2)
        )

    everything = [batch.key for batch in build()]
    assert len(everything) == 6
    stopped = build()
    assert [batch.key for batch in itertools.islice(stopped, 3)] == everything[:3]
    assert stopped.state_dict() == {"step": 1}
    resumed = build()
    resumed.load_state_dict({"step": 1})
    assert [batch.key for batch in resumed] == everything[2:]


def test_fewer_graphs_than_batches_are_refused(folders):
    with pytest.raises(ConfigError, match="at least 9: 3 devices, 3 batches each"):
        datasets(data_config(*folders), [DeviceShare(world_size=3, accumulate=3)])


def vary(sizes=((32, 32),), jitter=(0.5, 0.5, 0.5, 0.1), seed=0):
    return Variation(image_sizes=tuple(sizes), color_jitter=jitter, seed=seed)


def test_shapes_come_equally_often_and_change_with_the_seed():
    sizes = [(384, 512), (336, 512), (288, 512), (256, 512), (160, 512)]
    drawn = [vary(sizes).draw_image_size(step) for step in range(2000)]
    for size in sizes:
        assert abs(drawn.count(size) / 2000 - 0.2) < 0.03
    assert drawn != [vary(sizes, seed=1).draw_image_size(step) for step in range(2000)]


def test_colours_depend_on_seed_step_slot_and_view_and_on_nothing_else():
    places = [(step, slot) for step in range(3) for slot in range(3)]
    alone = {place: vary().draw_colors(*place, 4) for place in places}
    assert {place: vary().draw_colors(*place, 4) for place in reversed(places)} == alone
    assert len({change for changes in alone.values() for change in changes}) == 36
    assert vary().draw_colors(0, 0, 2) == alone[0, 0][:2]
    assert vary(seed=1).draw_colors(0, 0, 4) != alone[0, 0]
    assert vary(jitter=(0.0, 0.0, 0.0, 0.0)).draw_colors(0, 0, 4) == ()


def test_colours_never_come_from_the_global_generators(folders):
    (dataset,) = datasets(data_config(*folders), [DeviceShare()])
    state = torch.get_rng_state(), np.random.get_state()[1].copy()  # noqa: NPY002
    first = dataset[0].unpack().image
    assert torch.equal(torch.get_rng_state(), state[0])
    assert np.array_equal(np.random.get_state()[1], state[1])  # noqa: NPY002
    torch.manual_seed(99)
    assert torch.equal(dataset[0].unpack().image, first)


def test_without_jitter_images_are_those_stored(folders):
    still = data_config(*folders, color_jitter=[0.0, 0.0, 0.0, 0.0])
    (plain,), (jittered,) = (
        datasets(config, [DeviceShare()]) for config in (still, data_config(*folders))
    )
    one, two = plain[0].unpack(), jittered[0].unpack()
    assert one.key == two.key
    assert torch.equal(one.depth, two.depth)
    changed = (one.image != two.image).flatten(2).any(-1)
    assert changed.all()


def test_the_five_shapes_of_the_paper_come_with_its_network():
    layers = ["configs/base.yaml", "configs/model/l3r_512.yaml"]
    config = load_config(layers)
    shapes = [[short, 512] for short in (384, 336, 288, 256, 160)]
    assert config.data.image_sizes == shapes
    assert config.data.color_jitter == [0.5, 0.5, 0.5, 0.1]
    with pytest.raises(ConfigError, match=r"data\.image_sizes.*patch_size = 16"):
        load_config([*layers, "data.image_sizes=[[250,512]]"])
    with pytest.raises(ConfigError, match=r"data\.image_sizes.*height at most width"):
        load_config([*layers, "data.image_sizes=[[512,384]]"])
