"""Source of truth: the LaTeX source of the paper, typed into the tests a second time as sums, and properties."""

from dataclasses import replace

import pytest

from hyperplanes.configuration.presets import TRAINABLE, preset
from hyperplanes.experiments import EXPERIMENTS, SCALES
from hyperplanes.experiments.configurations import change, configuration, deviations
from hyperplanes.experiments.published import CROSS, SHAPENET, SINGLE, TARGET, TIME
from hyperplanes.methods import METHODS


def test_the_numbers_of_the_paper():
    # column sums, and single numbers, of tab:shapenet, tab:cross and tab:single_inference
    assert [sum(row[i] for row in SHAPENET.rows.values()) for i in range(3)] == pytest.approx([99.38, 117.84, 119.39])
    assert [sum(row[i] for row in CROSS.rows.values()) for i in range(4)] == pytest.approx(
        [208.04, 186.93, 211.0, 233.78]
    )
    assert [sum(row[i] for row in SINGLE.rows.values()) for i in range(5)] == pytest.approx(
        [150.08, 129.08, 166.91, 171.0, 174.09]
    )
    assert (TARGET.value("SSIM", "NeRF"), TARGET.deviation("SSIM", "NeRF")) == (0.881, 0.002)
    assert (TIME.value("seconds", "HyperPlanes-100"), TIME.deviation("seconds", "HyperPlanes-100")) == (41.3, 0.14)
    assert TIME.value("seconds", "MultiPlaneNeRF") is None
    assert SHAPENET.deviation("HyperPlanes", "Cars") is None


@pytest.mark.parametrize("experiment", EXPERIMENTS.values(), ids=EXPERIMENTS)
def test_every_cell_can_be_run_and_every_published_number_has_one(experiment):
    cells = {(cell.row, cell.column) for cell in experiment.cells}
    assert len(cells) == len(experiment.cells)
    for cell in experiment.cells:
        base = cell.method.rstrip("0123456789").removesuffix("_")
        assert base in METHODS
        assert cell.trained.method in TRAINABLE
    if experiment.published is not None:
        shown = {(row, column): experiment.published_value(row, column) for row, column in cells}
        named = {experiment.published_rows.get(row, row): row for row in experiment.rows}  # in the order of the paper:
        assert [row for row in named if row in experiment.published.rows] == list(experiment.published.rows)
        for row, numbers in experiment.published.rows.items():
            found = [shown[named[row], column] for column in experiment.published.columns]
            assert found == list(numbers)
        assert sum(value is not None for value in shown.values()) == sum(map(len, experiment.published.rows.values()))
        assert [c for c in experiment.columns if c in experiment.published.columns] == list(
            experiment.published.columns
        )


def test_the_numbers_of_tancik_et_al_stand_beside_one_view_and_those_of_hyperplanes_beside_25():
    # their notebook judges by one view, the paper shows HyperPlanes 25; four numbers of tab:shapenet, typed again
    shapenet = EXPERIMENTS["shapenet"]
    assert shapenet.published_value("Standard, 1 view", "Cars") == 11.45
    assert shapenet.published_value("MV Meta, 1 view", "Chairs") == 18.85
    assert shapenet.published_value("SV Meta, 1 view", "Chairs") == 16.54
    assert shapenet.published_value("HyperPlanes, 25 views", "Lamps") == 25.95
    for row in ("MV Meta, 25 views", "HyperPlanes, 1 view", "small, 25 views"):
        assert shapenet.published_value(row, "Cars") is None
    for cell in shapenet.cells:
        assert cell.row.endswith(f", {cell.views} view{'s' if cell.views > 1 else ''}")


def test_all_rows_of_a_column_are_judged_on_the_same_objects_and_views():
    for experiment in EXPERIMENTS.values():
        for part in ("Train", "Test", ""):
            for column in experiment.columns:
                found = [c for c in experiment.cells if c.column == column and c.row.startswith(part)]
                assert len({cell.split for cell in found if part}) <= 1
    shapenet = EXPERIMENTS["shapenet"]
    assert {(cell.column, cell.on, cell.trained.on) for cell in shapenet.cells} == {
        ("Chairs", "chair", "chair"),
        ("Cars", "car", "car"),
        ("Lamps", "lamp", "lamp"),
    }


def test_the_scale_of_the_paper_is_the_paper():
    for experiment in EXPERIMENTS.values():
        assert deviations(experiment, SCALES["paper"]) == [], experiment.name
        assert deviations(experiment, SCALES["small"]) != []
    cross = EXPERIMENTS["cross-class"]
    trained = next(each for each in cross.trainings if each.on == "plane")
    made = configuration(cross, trained, SCALES["paper"], objects=7, seed=3)
    assert (made.training.steps, made.training.seed) == (2460 * 7, 3)
    assert configuration(cross, trained, SCALES["small"], objects=7, seed=0).training.steps == SCALES["small"].steps


def test_changes_reach_the_entry_they_name_and_nothing_else():
    before = preset("quick")
    after = change(before, {"model.hypernetwork.views": 3, "training.rays": 7})
    assert (after.model.hypernetwork.views, after.training.rays) == (3, 7)
    assert after.model == replace(before.model, hypernetwork=replace(before.model.hypernetwork, views=3))
    plain = before.without_hypernetwork()
    assert change(plain, {"model.hypernetwork.views": 3}) == plain
    with pytest.raises(ValueError, match="expected an entry of ImageHyperNetworkConfig, got 'planets'"):
        change(before, {"model.hypernetwork.planets": 3})


def test_the_ablations_change_what_they_name():
    for name, entry in (("hyperplanes", "hypernetwork.views"), ("imageplanes", "network.planes")):
        experiment = EXPERIMENTS[name]
        models = [configuration(experiment, each, SCALES["small"], 10, 0).model for each in experiment.trainings]
        assert all(models[0].differences(other) == [entry] for other in models[1:])
        assert len({str(model) for model in models}) == len(experiment.rows)
    inputs = EXPERIMENTS["inputs"]
    first, *others = [configuration(inputs, each, SCALES["small"], 10, 0).model for each in inputs.trainings]
    weights, directions = "hypernetwork.see_weights", "hypernetwork.see_directions"
    assert [first.differences(other) for other in others] == [
        [weights],
        [directions],
        [directions, weights],
        ["target"],
    ]


def test_scales_make_things_smaller_and_say_so():
    smoke, small, paper = SCALES["smoke"], SCALES["small"], SCALES["paper"]
    assert [scale.method("hyperplanes_100") for scale in (smoke, small)] == ["hyperplanes_2", "hyperplanes_100"]
    assert [scale.planes(25) for scale in (smoke, small, paper)] == [4, 25, 25]
    iterations = EXPERIMENTS["iterations"]
    assert small.applied(iterations).columns == ["0", "100", "300", "1000"]
    assert {c.method for c in smoke.applied(iterations).cells} == {"hyperplanes", "nerf_scratch_3"}
    assert paper.applied(iterations) == iterations
    assert [small.seeds(EXPERIMENTS[name]) for name in ("shapenet", "cross-class", "target")] == [3, 3, 3]
    assert paper.seeds(EXPERIMENTS["cross-class"]) == 5
