"""Sources of truth: the published layers and numbers of weights, and properties (independence of images, statistics of
normalisation).
"""

import pytest
import torch
from torch import nn

from hyperplanes.hypernetwork import ConvNet, ResNet101


def pictures(count=3, size=(20, 33), seed=0):
    return torch.rand(count, 3, *size, generator=torch.Generator().manual_seed(seed))


@pytest.mark.parametrize("size", [(8, 8), (20, 33), (64, 64), (65, 40)])
def test_convnet_gives_one_code_per_image_of_any_size(size):
    assert ConvNet(10)(pictures(size=size)).shape == (3, 10)


@pytest.mark.parametrize("normalisation", ["batch", "batch_statistics"])
def test_batch_statistics_of_a_single_value_per_channel_are_refused(normalisation):
    """16 pixels are halved four times, which leaves one."""
    network, one = ConvNet(10, normalisation), pictures(1, (16, 16))
    with pytest.raises(ValueError, match=f"hypernetwork.normalisation .* got '{normalisation}'.* training.tasks"):
        network(one)
    assert network(pictures(2, (16, 16))).shape == (2, 10)
    if normalisation == "batch":  # uses running statistics
        assert network.eval()(one).shape == (1, 10)


def test_convnet_is_3x3_convolutions_each_with_batch_normalisation():
    network = ConvNet(10)
    assert all(layer.kernel_size == (3, 3) for layer in network.modules() if isinstance(layer, nn.Conv2d))
    count = sum(isinstance(layer, nn.Conv2d) for layer in network.modules())
    assert count == sum(isinstance(layer, nn.BatchNorm2d) for layer in network.modules())


def test_resnet101_has_the_published_number_of_weights_and_layers():
    with torch.device("meta"):  # only shapes
        network = ResNet101(1000)
    # 44,549,160 in total, of which the classifier has 2048 x 1000 weights and 1000 biases
    assert sum(value.numel() for value in network.parameters()) == 44_549_160
    assert sum(value.numel() for name, value in network.named_parameters() if "code" not in name) == 42_500_160
    weighted = [name for name, layer in network.named_modules() if isinstance(layer, nn.Conv2d | nn.Linear)]
    assert len([name for name in weighted if "shortcut" not in name]) == 101


@pytest.mark.parametrize("normalisation", ["batch", "group"])
def test_resnet_gives_one_code_per_image(normalisation):
    network = ResNet101(7, normalisation, blocks=(1, 2))
    codes = network(pictures(2, (17, 24)))
    assert codes.shape == (2, 7)
    codes.square().sum().backward()
    assert all(value.grad.abs().sum() > 0 for value in network.parameters())


def test_resnet101_shrinks_an_image_32_times():
    with torch.device("meta"):
        network, images, seen = ResNet101(4), torch.rand(2, 3, 64, 96), []
    network.stages.register_forward_hook(lambda *hooked: seen.append(hooked[2].shape))
    network(images)
    assert seen == [(2, 2048, 2, 3)]


@pytest.mark.parametrize("make", [ConvNet, lambda c, n: ResNet101(c, n, (1, 1))], ids=["convnet", "resnet"])
@pytest.mark.parametrize("training", [True, False])
@torch.no_grad()
def test_with_group_normalisation_codes_of_images_are_independent(make, training):
    network = make(6, "group").train(training)
    images = pictures(4, (32, 32))
    torch.testing.assert_close(network(images)[:1], network(images[:1]), atol=1e-4, rtol=1e-4)


@torch.no_grad()
def test_with_batch_normalisation_codes_are_independent_only_in_evaluation():
    network, images = ConvNet(6, "batch"), pictures(4, (32, 32))
    assert not torch.allclose(network.train()(images)[:1], network(images[:1]), atol=1e-3)
    network.eval()
    torch.testing.assert_close(network(images)[:1], network(images[:1]))
    assert torch.equal(network(images), network(images))  # the statistics do not change


@torch.no_grad()
def test_batch_statistics_are_those_of_the_batch_in_evaluation_too():
    torch.manual_seed(0)
    images, encoder = torch.rand(4, 3, 24, 24), ConvNet(8, "batch_statistics")
    torch.testing.assert_close(encoder.eval()(images), encoder.train()(images))
    running = ConvNet(8, "batch")
    running.load_state_dict(encoder.state_dict(), strict=False)
    assert set(dict(running.named_parameters())) == set(dict(encoder.named_parameters()))
    torch.testing.assert_close(running.train()(images), encoder(images))
    assert not torch.allclose(running.eval()(images), encoder(images), atol=1e-3)


def test_a_white_image_gives_the_bias_of_the_code():
    # white is encoded as zero, including the padding, so that convolutions without bias give zero
    network = ConvNet(5, "batch").eval()
    torch.testing.assert_close(network(torch.ones(1, 3, 32, 32))[0], network.code.bias)
