"""Sources of truth: the formulas of the updates, and properties (an untrained hypernetwork changes nothing, objects of
a batch are independent, centred updates have mean zero, a mean of codes does not depend on the order of views).
"""

from dataclasses import replace

import pytest
import torch

from hyperplanes.fields import PointMultiPlaneNeRF, TargetConfig
from hyperplanes.hypernetwork import (
    Autoencoder,
    AutoencoderConfig,
    ImageHyperNetwork,
    ImageHyperNetworkConfig,
    Observed,
)
from hyperplanes.hypernetwork.updates import LowRankUpdate
from hyperplanes.hypernetwork.weights import LowRankReader

CONFIG = ImageHyperNetworkConfig(views=3, normalisation="group", code=8, depth=2, width=16)
SHAPES = {
    "fine.layers.0.weight": torch.Size([6, 4]),
    "fine.layers.0.bias": torch.Size([6]),
    "fine.density.weight": torch.Size([1, 6]),
    "fine.density.bias": torch.Size([1]),
    "fine.colour.weight": torch.Size([3, 5]),
    "fine.colour.bias": torch.Size([3]),
}


class _OneByOne(ImageHyperNetwork):
    """A hypernetwork that is called with images and directions of several objects, or of one object."""

    def __call__(self, images, directions, theta):
        if images.ndim == 5:
            return super().__call__(Observed(images, directions), theta)
        return super().__call__(Observed(images[None], directions[None]), theta)[0]


def make(config=CONFIG, *, awake=True):
    torch.manual_seed(0)
    network = _OneByOne(config, SHAPES)
    if awake:  # the output layers are initialised with zero
        for output in network.outputs:
            torch.nn.init.normal_(output.weight)
    return network.eval()


def inputs(seed=0):
    generator = torch.Generator().manual_seed(seed)
    images = torch.rand(3, 3, 16, 16, generator=generator)
    directions = torch.randn(3, 3, generator=generator)
    theta = {name: torch.randn(shape, generator=generator) for name, shape in SHAPES.items()}
    return images, directions / directions.norm(dim=1, keepdim=True), theta


def differs(one, other):
    return any((one[name] - other[name]).abs().max() > 1e-6 for name in one)


def test_an_untrained_hypernetwork_changes_nothing():
    update = make(awake=False)(*inputs())
    assert all((change == 0).all() for change in update.values())


def test_the_update_has_the_names_and_shapes_of_the_chosen_layers():
    update = make()(*inputs())
    assert {name: value.shape for name, value in update.items()} == {
        name: shape for name, shape in SHAPES.items() if "layers" not in name
    }
    other = make(replace(CONFIG, layers=("0",)))(*inputs())
    assert set(other) == {"fine.layers.0.weight", "fine.layers.0.bias"}


@torch.no_grad()
def test_the_update_depends_on_every_input():
    network, (images, directions, theta) = make(), inputs()
    update = network(images, directions, theta)
    for view in range(3):
        changed = images.clone()
        changed[view] *= 0.5
        assert differs(update, network(changed, directions, theta))
    for name in update:
        assert differs(update, network(images, directions, {**theta, name: theta[name] + 1}))
    assert differs(update, network(images.flip(0), directions, theta))


@pytest.mark.parametrize("view", range(3))
@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize("sign", [-1.0, 1.0])
@torch.no_grad()
def test_the_update_depends_on_positive_and_negative_viewing_directions(view, axis, sign):
    network, (images, directions, theta) = make(), inputs()
    directions[view, axis] = 0.3 * sign
    changed = directions.clone()
    changed[view, axis] = 0.6 * sign
    assert differs(network(images, directions, theta), network(images, changed, theta))


@torch.no_grad()
def test_directions_and_weights_can_be_omitted():
    images, directions, theta = inputs()
    other = {name: value + 1 for name, value in theta.items()}
    blind = make(replace(CONFIG, see_directions=False))
    assert not differs(blind(images, directions, theta), blind(images, -directions, theta))
    assert differs(blind(images, directions, theta), blind(images, directions, other))
    unweighted = make(replace(CONFIG, see_weights=False))
    assert not differs(unweighted(images, directions, theta), unweighted(images, directions, other))


@torch.no_grad()
@pytest.mark.parametrize("join", ["concatenate", "mean"])
def test_omitting_an_input_is_the_same_as_zeros(join):
    # it has the same weights and the same update as a network with all inputs whose omitted input is zero
    (images, directions, theta), config = inputs(), replace(CONFIG, join=join)
    whole = make(config)
    nothing = {name: torch.zeros_like(value) for name, value in theta.items()}
    for change, given in (
        ({"see_directions": False}, (images, torch.zeros_like(directions), theta)),
        ({"see_weights": False}, (images, directions, nothing)),
    ):
        blind = make(replace(config, **change))
        assert all(torch.equal(value, blind.state_dict()[name]) for name, value in whole.state_dict().items())
        assert not differs(blind(images, directions, theta), whole(*given))


@pytest.mark.parametrize("depth", [1, 3, 10])
def test_the_head_has_the_depth_and_width_of_its_configuration(depth):
    head = make(replace(CONFIG, depth=depth, width=20)).head
    assert [layer.out_features for layer in head] == [20] * depth
    # three images with a code of 8 and a direction each, and the code of theta
    assert head[0].in_features == 3 * (8 + 3) + 8


def test_gradients_reach_the_hypernetwork_the_images_and_theta():
    network, (images, directions, theta) = make(), inputs()
    theta = {name: value.requires_grad_() for name, value in theta.items()}
    update = network(images.requires_grad_(), directions.requires_grad_(), theta)
    sum(change.square().sum() for change in update.values()).backward()
    assert all(value.grad.abs().sum() > 0 for value in network.parameters())
    assert images.grad.abs().sum() > 0
    assert directions.grad.abs().sum() > 0
    assert all((theta[name].grad is not None) == (name in update) for name in theta)


def test_objects_of_a_batch_are_independent():
    network = make()
    several = [inputs(seed) for seed in range(3)]
    theta = several[0][2]
    batch = network(torch.stack([each[0] for each in several]), torch.stack([each[1] for each in several]), theta)
    for (images, directions, _), update in zip(several, batch, strict=True):
        for name, value in network(images, directions, theta).items():
            torch.testing.assert_close(value, update[name])


@pytest.mark.parametrize("update", ["full", "low_rank"])
@torch.no_grad()
def test_updates_against_their_formulas(update):
    # Closed form: the outputs themselves (full), or for each row a multiple of the row of W, plus U V (low rank).
    network = make(replace(CONFIG, update=update, layers=("all",), rank=2))
    images, directions, theta = inputs()
    caught = []
    for form in network.updates:
        form.register_forward_pre_hook(lambda module, given: caught.append(given))
    found = network(images, directions, theta)
    for (outputs, parameter), form, name in zip(caught, network.updates, SHAPES, strict=True):
        if parameter.ndim == 1 or update == "full":
            expected = outputs.reshape(parameter.shape)
        else:
            rows = outputs.reshape(len(parameter), 3)
            expected = torch.stack([r[0] * w + r[1:] @ form.right for r, w in zip(rows, parameter, strict=True)])
        torch.testing.assert_close(found[name], expected)


@pytest.mark.parametrize(
    "change",
    [{"code_normalisation": "none"}, {"activation": "silu"}, {"centre": False}, {"join": "mean"}],
    ids=str,
)
@torch.no_grad()
def test_every_option_changes_the_update(change):
    shown = [torch.stack(parts) for parts in zip(*(inputs(seed)[:2] for seed in (1, 2, 3)), strict=True)]
    updates = []
    for config in (CONFIG, replace(CONFIG, **change)):
        network = make(config).train()
        network(*shown, inputs()[2])  # initial statistics (mean 0, variance 1) would standardise nothing
        updates.append(network.eval()(*inputs()))
    assert differs(*updates)


@torch.no_grad()
def test_the_mean_of_codes_does_not_depend_on_the_order_of_views():
    network = make(replace(CONFIG, join="mean"))
    images, directions, theta = inputs()
    order = [2, 0, 1]
    shuffled = network(images[order], directions[order], theta)
    for name, value in network(images, directions, theta).items():
        torch.testing.assert_close(value, shuffled[name])
    assert differs(shuffled, network(images[order], directions, theta))  # directions belong to images


@torch.no_grad()
def test_a_centred_update_has_mean_zero_over_the_objects_it_was_trained_on():
    network = make().train()
    objects = [inputs(seed)[:2] for seed in range(4)]
    images, directions = (torch.stack(parts) for parts in zip(*objects, strict=True))
    theta = inputs()[2]
    for _ in range(200):  # the running statistics converge to those of these objects
        updates = network(images, directions, theta)
    mean = {name: torch.stack([each[name] for each in updates]).mean(0) for name in updates[0]}
    size = max(float(each[name].abs().max()) for each in updates for name in each)
    assert max(float(value.abs().max()) for value in mean.values()) < 1e-3 * size


def test_wrong_shapes_of_the_network_are_refused():
    with pytest.raises(
        ValueError, match=r"layers: expected \('all',\) or some of \['0', 'colour', 'density'\], got \['sigma'\]"
    ):
        make(replace(CONFIG, layers=("sigma",)))
    with pytest.raises(ValueError, match=r"encoder: expected one of 'convnet', 'resnet101', got 'vgg'"):
        replace(CONFIG, encoder="vgg")
    images, directions, theta = inputs()
    with pytest.raises(ValueError, match="HyperPlanes: expected 3 images and directions, got 2 and 2"):
        make()(images[:2], directions[:2], theta)


def test_all_layers_can_be_updated_and_none_is_refused():
    assert set(make(replace(CONFIG, layers=("all",)))(*inputs())) == set(SHAPES)
    with pytest.raises(ValueError, match=r"layers: expected \('all',\) or some of .*, got none"):
        make(replace(CONFIG, layers=()))


@torch.no_grad()
def test_all_of_theta_or_the_updated_layers_are_read():
    images, directions, theta = inputs()
    reads = {name: make(replace(CONFIG, weights_seen=name)) for name in ("updated", "all")}
    for name in SHAPES:
        changed = {**theta, name: theta[name] + 1}
        for seen, network in reads.items():
            told = differs(network(images, directions, theta), network(images, directions, changed))
            assert told == (seen == "all" or "layers" not in name)
    blind = make(replace(CONFIG, weights_seen="all", see_weights=False))
    other = {name: value + 1 for name, value in theta.items()}
    assert not differs(blind(images, directions, theta), blind(images, directions, other))
    with pytest.raises(ValueError, match="weights_seen: expected one of 'updated', 'all', got 'some'"):
        make(replace(CONFIG, weights_seen="some"))


@pytest.mark.parametrize(
    "make",
    [
        lambda: ImageHyperNetwork(replace(CONFIG, update="low_rank", weights_seen="all"), SHAPES),
        lambda: Autoencoder(AutoencoderConfig(), SHAPES, ("layers.0",)),
    ],
    ids=["low rank", "autoencoder"],
)
def test_no_random_numbers_are_drawn_on_the_meta_device(make, monkeypatch):
    # Source of truth: the shapes on the CPU. Drawing on "meta" makes PyTorch load its compiler, in a second.
    expected = {name: value.shape for name, value in make().state_dict().items()}
    monkeypatch.setattr(torch.Tensor, "normal_", None)
    monkeypatch.setattr(torch, "randn", None)
    with torch.device("meta"):
        found = make().state_dict()
    assert {name: value.shape for name, value in found.items()} == expected


@torch.no_grad()
def test_the_code_of_a_matrix_and_a_bias():
    # Closed form: the code of W and b is A (U W V, u b) + c, with the parameters of the reader.
    reader = LowRankReader({"w": torch.Size([6, 5]), "b": torch.Size([6])}, 3)
    theta = {"w": torch.randn(6, 5), "b": torch.randn(6)}
    products = torch.einsum("ri,ij,jc->rc", reader.left[0], theta["w"], reader.right[0]).flatten()
    projected = (reader.left[1] * theta["b"]).sum(1) * reader.right[1].item()
    expected = reader.code.weight @ torch.cat([products, projected]) + reader.code.bias
    torch.testing.assert_close(reader(theta), expected)


def test_reading_the_network_of_the_paper_takes_few_parameters():
    with torch.device("meta"):
        target = PointMultiPlaneNeRF(TargetConfig())
        reader = LowRankReader({name: value.shape for name, value in target.named_parameters()}, 128)
    theta = sum(value.numel() for value in target.parameters())
    assert theta * 128 > 75e6
    assert sum(value.numel() for value in reader.parameters()) < 120_000


def test_a_grid_of_features_has_no_low_rank_update():
    with pytest.raises(ValueError, match=r"update: expected 'full' for layers with a grid of features, \(4, 8, 8, 8\)"):
        LowRankUpdate(torch.Size((4, 8, 8, 8)), 2)
