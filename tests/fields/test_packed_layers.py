"""Sources of truth: PyTorch's layers in float64, and bitwise independence of batches and threads."""

import copy
import pickle
from functools import cache
from importlib import import_module

import pytest
import torch
from torch.autograd import forward_ad

from hyperplanes.adaptation import AdaptedField
from hyperplanes.adaptation.correction.stacking import stack
from hyperplanes.export.surfaces import mesh_level
from hyperplanes.export.voxel_fitting import render_guide
from hyperplanes.fields import TARGETS, TargetConfig
from hyperplanes.fields import layers as packed_layers
from hyperplanes.fields.layers import PackedLayers
from hyperplanes.geometry.image_planes import ImagePlanes
from hyperplanes.geometry.kernels import compiling
from hyperplanes.geometry.occupancy import full
from hyperplanes.geometry.rays import Sphere, cast
from hyperplanes.parameters import Parameters
from hyperplanes.rendering import Hierarchical, RayMarching
from hyperplanes.rendering.refinement import RefinedOccupancy
from hyperplanes.views import Views
from tests.fields.tile_registers import emulated_kernel
from tests.reference_rendering import ring

HAS_AMX = compiling.layers_module() == "layers.amx"
HAS_BFLOAT16 = HAS_AMX or compiling.layers_module(mixed_precision=True) == "layers.bfloat16"
ERRORS = {"layers.single": 1e-5, "layers.bfloat16": 5e-2, "layers.amx": 1e-4, "layers.amx_bfloat16": 5e-2}
"""Kernels and their tolerances relative to float64; factors of bfloat16 kernels have 8 bits, or 16 as two numbers."""
of_bfloat16 = pytest.mark.skipif(not HAS_BFLOAT16, reason="needs AMX, or AVX512_BF16 of AMD")


@pytest.fixture(
    params=[name if name == "layers.single" else pytest.param(name, marks=of_bfloat16) for name in ERRORS], autouse=True
)
def module(request, monkeypatch):
    """Each kernel. That for AVX-512 runs on all processors, but is only used by default where it is fast.

    Without AMX, its instructions are emulated.
    """
    use(request.param, monkeypatch)
    return request.param


def use(name, monkeypatch):
    """Select the kernel of a module."""
    monkeypatch.setattr(packed_layers, "layers_module", lambda mixed_precision=False: name)
    if "amx" in name and not HAS_AMX:
        monkeypatch.setattr(packed_layers, "compile_kernel", lambda kernel, dtype: emulated_kernel(kernel))


def layers_of(depth, width, inputs, skip, seed=0):
    generator = torch.Generator().manual_seed(seed)
    sizes = [inputs if not index else width + inputs * (index == skip) for index in range(depth)]
    return [
        (torch.randn(width, size, generator=generator) * (2 / size) ** 0.5, torch.randn(width, generator=generator))
        for size in sizes
    ]


def by_pytorch(layers, given, skip, factor=lambda value: value):
    value = given
    for index, (weight, bias) in enumerate(layers):
        value = torch.cat([given, value], 1) if index == skip > 0 else value
        value = (factor(value) @ factor(weight).T + bias).clamp_min(0)
    return value


@pytest.mark.parametrize(("depth", "width", "inputs"), [(1, 64, 7), (2, 128, 1), (4, 128, 130), (5, 192, 33)])
@pytest.mark.parametrize("count", [0, 1, 59, 61, 500])
def test_values_are_those_of_pytorch(module, depth, width, inputs, count):
    skip = depth // 2
    layers = layers_of(depth, width, inputs, skip)
    given = torch.randn(count, inputs, generator=torch.Generator().manual_seed(1))
    expected = by_pytorch([(weight.double(), bias.double()) for weight, bias in layers], given.double(), skip)
    found = PackedLayers.of(layers, skip)(given)
    error = ERRORS[module]
    torch.testing.assert_close(found, expected.float(), rtol=error, atol=error)
    assert not count or (found > 0).any()


@cache
def few_by_few(module):
    """Packed layers, many points, and their values computed in calls of seven points each."""
    layers = PackedLayers.of(layers_of(4, 128, 130, 2), 2)
    given = torch.randn(1000, 130, generator=torch.Generator().manual_seed(2))  # enough for a part for each thread
    return layers, given, torch.cat([layers(part) for part in given.split(7)])


@pytest.mark.parametrize("threads", [1, 2, 3])
def test_values_do_not_depend_on_batches_and_threads_by_a_bit(module, threads, monkeypatch):
    layers, given, alone = few_by_few(module)
    monkeypatch.setattr(torch.Tensor, "new_empty", lambda self, *size: self.new_full(size, torch.nan))  # if unwritten
    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    try:
        assert torch.equal(layers(given), alone)
        assert torch.equal(layers(given.T.contiguous().T), alone)  # another layout in memory
    finally:
        torch.set_num_threads(before)


@of_bfloat16
@pytest.mark.parametrize("name", ["layers.bfloat16", "layers.amx_bfloat16"])
@pytest.mark.parametrize(("depth", "inputs"), [(1, 64), (1, 7), (4, 33)])
def test_mixed_precision_rounds_only_the_factors_of_products(name, depth, inputs, monkeypatch):
    """Sums and biases have single precision. Later layers may round values near a tie differently."""
    use(name, monkeypatch)
    layers, given = layers_of(depth, 64, inputs, depth // 2), torch.randn(70, inputs, generator=torch.Generator())
    doubles = [(weight.double(), bias.double()) for weight, bias in layers]
    exact = by_pytorch(doubles, given.double(), depth // 2)
    rounded = by_pytorch(doubles, given.double(), depth // 2, lambda value: value.bfloat16().double())
    found = PackedLayers.of(layers, depth // 2, mixed_precision=True)(given).double()
    if depth == 1:
        torch.testing.assert_close(found, rounded, rtol=1e-5, atol=1e-5)
    assert (found - rounded).square().mean() < 0.1 * (rounded - exact).square().mean()


@of_bfloat16
@pytest.mark.parametrize("width", [32, 96, 160])
def test_amx_supports_widths_that_are_not_multiples_of_64(width, monkeypatch):
    use("layers.amx", monkeypatch)
    layers, given = layers_of(3, width, 35, 1), torch.randn(50, 35, generator=torch.Generator().manual_seed(1))
    expected = by_pytorch([(weight.double(), bias.double()) for weight, bias in layers], given.double(), 1)
    torch.testing.assert_close(PackedLayers.of(layers, 1)(given), expected.float(), rtol=1e-4, atol=1e-4)


def test_inputs_of_any_layout_are_read():
    layers = PackedLayers.of(layers_of(3, 64, 5, 1), 1)
    given = torch.randn(40, 10, generator=torch.Generator().manual_seed(1))
    for view in (
        given[:, ::2],
        given[::3, 2:7],
        given.T[:5, :].T,
        given[:1, :5].expand(7, 5),
        given[:, :1].expand(40, 5),
    ):
        assert torch.equal(layers(view), layers(view.contiguous()))


def test_nan_of_a_point_does_not_spread_to_others():
    given = torch.zeros(9, 5)
    given[3, 2] = torch.nan
    found = PackedLayers.of(layers_of(2, 64, 5, 1), 1)(given).isnan()
    assert found[3].all()
    assert not found[[0, 1, 2, 4, 5, 6, 7, 8]].any()


@pytest.mark.parametrize(
    ("width", "dtype"),
    [(63, torch.float32), (80, torch.float32), (None, torch.float32), (64, torch.float64)],
)
def test_other_widths_and_precisions_are_left_to_pytorch(module, width, dtype):
    width = width or import_module(f"hyperplanes.geometry.kernels.{module}").MAX_LAYER_WIDTH + 64
    layers = [(weight.to(dtype), bias.to(dtype)) for weight, bias in layers_of(2, width, 5, 1)]
    assert PackedLayers.of(layers, 1) is None


def test_inconsistent_shapes_are_left_to_pytorch():
    layers = layers_of(3, 64, 5, 1)
    assert PackedLayers.of(layers, 1) is not None
    assert PackedLayers.of(layers, 2) is None  # another layer reads the inputs
    assert PackedLayers.of([*layers[:2], (layers[2][0], torch.zeros(63))], 1) is None
    packed = PackedLayers.of(layers, 1)
    assert packed.takes(torch.zeros(2, 5))
    assert not any(map(packed.takes, (torch.zeros(2, 6), torch.zeros(5), torch.zeros(2, 5, dtype=torch.float64))))


@pytest.mark.parametrize(
    ("found", "wide", "amx", "products", "compiler", "settings", "expected"),
    [
        (None, True, True, True, (22, 1, 0), {}, [None, None]),
        (1, False, False, False, (22, 1, 0), {}, [None, None]),
        (1, True, False, False, (22, 1, 0), {}, ["layers.single", "layers.single"]),
        (1, True, False, True, (22, 1, 0), {}, ["layers.single", "layers.bfloat16"]),
        (1, True, True, True, (22, 1, 0), {}, ["layers.amx", "layers.amx_bfloat16"]),
        (
            1,
            True,
            True,
            True,
            (15, 0, 7),
            {},
            ["layers.single", "layers.single"],
        ),  # would crash at the first AMX instruction
        (
            1,
            True,
            True,
            True,
            (22, 1, 0),
            {"CPU_NAME": "generic"},
            ["layers.single", "layers.single"],
        ),  # cannot compile AMX
        (1, True, True, True, (22, 1, 0), {"CPU_FEATURES": "+avx2"}, ["layers.single", "layers.single"]),
        (1, True, False, True, (22, 1, 0), {"ENABLE_AVX": 0}, ["layers.single", "layers.single"]),
    ],
)
def test_the_kernel_depends_on_the_processor_and_the_compiler(  # noqa: PLR0913
    monkeypatch, found, wide, amx, products, compiler, settings, expected
):
    import llvmlite.binding
    from numba.core import config

    monkeypatch.setattr(compiling, "find_spec", lambda name: found)
    monkeypatch.setattr(compiling, "has_amx", lambda: amx)
    monkeypatch.setattr(compiling, "has_bfloat16_products", lambda: products)
    monkeypatch.setattr(llvmlite.binding, "get_host_cpu_features", lambda: {"avx512f": wide})
    monkeypatch.setattr(llvmlite.binding, "llvm_version_info", compiler)
    for name, value in settings.items():
        monkeypatch.setattr(config, name, value)
    choose = compiling.layers_module.__wrapped__
    assert [choose(), choose(mixed_precision=True)] == expected


def test_packed_layers_cannot_be_pickled():
    """Another process may use another kernel, and must itself request AMX registers from Linux."""
    with pytest.raises(TypeError, match="packed layers: expected to be packed again in each process"):
        pickle.dumps(PackedLayers.of(layers_of(2, 64, 5, 1), 1))


def test_without_a_kernel_layers_are_left_to_pytorch(monkeypatch):
    monkeypatch.setattr(packed_layers, "layers_module", lambda mixed_precision: None)
    assert PackedLayers.of(layers_of(2, 64, 5, 1), 1) is None


def field_of(config):
    """A field whose weights require gradients."""
    torch.manual_seed(0)
    network = TARGETS["point_multiplane"](config)
    images = torch.rand(3, 3, 9, 11, generator=torch.Generator().manual_seed(0))
    return network.bind(Parameters.of(network), ImagePlanes(images, ring(3, (9, 11))), Sphere())


@pytest.fixture
def used(monkeypatch):
    """The number of points in each call of the kernel."""
    counts, call = [], PackedLayers.__call__
    monkeypatch.setattr(PackedLayers, "__call__", lambda self, given: counts.append(len(given)) or call(self, given))
    return counts


CONFIG = TargetConfig(depth=4, width=64, planes=3, point_frequencies=2, direction_frequencies=1)
POINTS = torch.rand(20, 3, generator=torch.Generator().manual_seed(1)) - 0.5


def test_a_field_has_the_same_values_with_gradients_and_without(module, used):
    """With gradients, PyTorch multiplies the layers, with sums in another order."""
    field, directions = field_of(CONFIG), torch.nn.functional.normalize(POINTS, dim=1)
    learned = field(POINTS, directions)
    learned[0].sum().backward()
    assert all(value.grad is not None for name, value in field.parameters.items() if name.startswith("layers.single"))
    assert not used
    with torch.no_grad():
        found = field(POINTS, directions)
    assert used == [20]
    for one, other in zip(found, learned, strict=True):
        torch.testing.assert_close(one, other, rtol=ERRORS[module], atol=ERRORS[module])


def test_gradients_of_points_go_through_frozen_layers(used):
    field = field_of(CONFIG)
    frozen = type(field)(field.target, field.parameters.detach(), field.planes, field.bounds)
    moved = POINTS.clone().requires_grad_(True)
    frozen.density(moved).sum().backward()
    assert not used
    assert moved.grad.abs().sum() > 0


@torch.no_grad()
def test_weights_that_change_in_place_change_the_field(used):
    field = field_of(CONFIG)
    before = field.density(POINTS)
    field.parameters["layers.1.bias"].add_(0.5)
    changed = field.density(POINTS)
    assert (changed - before).abs().max() > 1e-3
    fresh = type(field)(field.target, field.parameters, field.planes, field.bounds)
    assert torch.equal(fresh.density(POINTS), changed)
    assert used == [20, 20, 20]


@torch.no_grad()
def test_copies_and_pickles_contain_no_packed_weights(used):
    field = field_of(CONFIG)
    expected = field.density(POINTS)
    names = {"target", "parameters", "planes", "bounds", "mixed_precision"}
    assert set(vars(field)) > names
    for copied in (copy.deepcopy(field), pickle.loads(pickle.dumps(field))):
        assert set(vars(copied)) == names
        assert torch.equal(copied.density(POINTS), expected)
    assert len(used) == 3


@torch.no_grad()
def test_pictures_use_mixed_precision_by_default_and_values_do_not(monkeypatch):
    asked, cameras = [], ring(1, (8, 8))
    monkeypatch.setattr(packed_layers, "layers_module", lambda mixed_precision=False: mixed_precision)
    monkeypatch.setattr(PackedLayers, "of", lambda *_, mixed_precision: asked.append(mixed_precision))

    def asked_by(compute, **changes):
        field, grid = field_of(CONFIG), full(Sphere(), 4)
        voxels = RefinedOccupancy(grid.occupied, grid.bounds, grid.occupied.float())
        asked.clear()
        compute(AdaptedField(field, grid, RayMarching(8), refined=voxels, **changes))
        return asked

    def stacked(field):
        return stack(field, field, 0.4)

    assert asked_by(lambda field: [field.render(cameras) for _ in range(2)]) == [True]  # packed only once
    assert set(asked_by(lambda field: stacked(field).render(cameras))) == {True}
    assert asked_by(lambda field: field.render(cameras, Hierarchical(4, 4)), proposal=field_of(CONFIG)) == [True, True]
    assert asked_by(lambda field: field.render(cameras, mixed_precision=False)) == [False]
    assert set(asked_by(lambda field: stacked(field).render(cameras, mixed_precision=False))) == {False}
    assert asked_by(lambda field: (field.density(POINTS), field(POINTS, POINTS))) == [False]
    assert asked_by(lambda field: field.trace(cast(cameras, torch.zeros(1).long(), torch.ones(1, 2)))) == [False]
    assert asked_by(lambda field: mesh_level._rendered(field, cameras)) == [False]
    assert asked_by(lambda field: render_guide(field, Views(torch.zeros(1, 3, 8, 8), cameras))) == [False]


def test_without_a_faster_kernel_the_field_in_mixed_precision_is_the_field_itself(monkeypatch):
    field = field_of(CONFIG)
    assert field.in_mixed_precision is field
    monkeypatch.setattr(packed_layers, "layers_module", lambda mixed_precision=False: mixed_precision)
    mixed = field_of(CONFIG).in_mixed_precision
    assert mixed.mixed_precision
    assert mixed.in_mixed_precision is mixed


def test_inputs_of_another_size_are_refused_by_pytorch():
    field = field_of(CONFIG)
    with torch.no_grad(), pytest.raises(RuntimeError, match="shapes cannot be multiplied"):
        field.trunk(torch.rand(5, field.target.input_size + 3))


@torch.no_grad()
def test_the_result_has_the_precision_of_the_inputs_whatever_the_default():
    field = field_of(CONFIG)
    given = field.target.inputs(POINTS, field.planes, field.bounds)
    expected = field.trunk(given)
    before = torch.get_default_dtype()
    torch.set_default_dtype(torch.float64)
    try:
        assert torch.equal(field.trunk(given), expected)
    finally:
        torch.set_default_dtype(before)


@pytest.mark.filterwarnings("ignore:.torch.jit.script. is deprecated:DeprecationWarning")  # in forward_ad
@torch.no_grad()
def test_transforms_traces_and_autocast_go_through_pytorch(module, used, monkeypatch):
    field = field_of(CONFIG)
    given = field.target.inputs(POINTS, field.planes, field.bounds)
    by_rows = torch.func.vmap(lambda row: field.trunk(row[None])[0])(given)
    with monkeypatch.context() as patched:
        patched.setattr(torch.jit, "is_tracing", lambda: True)
        traced = field.trunk(given)
    with torch.autocast("cpu", torch.bfloat16):
        assert field.trunk(given).dtype == torch.bfloat16
    with forward_ad.dual_level():
        weights = field.parameters["layers.1.weight"]
        dual = forward_ad.make_dual(weights, torch.ones_like(weights))
        moved = Parameters({**field.parameters, "layers.1.weight": dual})
        tangent = forward_ad.unpack_dual(type(field)(field.target, moved, field.planes, field.bounds).trunk(given))[1]
    assert not used
    assert tangent.abs().max() > 0
    error = ERRORS[module]
    torch.testing.assert_close(by_rows, field.trunk(given), rtol=error, atol=error)
    torch.testing.assert_close(traced, field.trunk(given), rtol=error, atol=error)
    assert used == [20, 20]
