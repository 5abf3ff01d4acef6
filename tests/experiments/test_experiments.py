"""Sources of truth: the LaTeX source of the paper, from which sums of columns are typed here, and properties."""

import csv
import io
from dataclasses import replace

import pytest

from hyperplanes.adaptation.hyperplanes import HyperPlanes
from hyperplanes.configuration.presets import TRAINABLE, preset
from hyperplanes.evaluation import ObjectScore, Score, merge_seeds
from hyperplanes.experiments import EXPERIMENTS, SCALES, report
from hyperplanes.experiments.configurations import change, configuration, differences
from hyperplanes.experiments.engine import Outcome
from hyperplanes.experiments.paper.published import CROSS, SHAPENET, SINGLE, TARGET, TIME
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
def test_every_cell_can_be_run_and_every_published_number_has_a_cell(experiment):
    cells = {(cell.row, cell.column) for cell in experiment.cells}
    assert len(cells) == len(experiment.cells)
    for cell in experiment.cells:
        base = cell.method.rstrip("0123456789").removesuffix("_")
        assert base in METHODS
        assert cell.trained.method in TRAINABLE
    if experiment.published is not None:
        shown = {(row, column): experiment.published_value(row, column) for row, column in cells}
        named = {experiment.published_rows.get(row, row): row for row in experiment.rows}  # in the order of the paper
        assert [row for row in named if row in experiment.published.rows] == list(experiment.published.rows)
        for row, numbers in experiment.published.rows.items():
            found = [shown[named[row], column] for column in experiment.published.columns]
            assert found == list(numbers)
        assert sum(value is not None for value in shown.values()) == sum(map(len, experiment.published.rows.values()))
        assert [c for c in experiment.columns if c in experiment.published.columns] == list(
            experiment.published.columns
        )


def test_published_numbers_are_shown_for_their_number_of_views():
    # the notebook of Tancik et al. uses 1 support view, HyperPlanes 25; four numbers of tab:shapenet, typed again
    shapenet = EXPERIMENTS["shapenet"]
    assert shapenet.published_value("Standard, 1 view", "Cars") == 11.45
    assert shapenet.published_value("MV Meta, 1 view", "Chairs") == 18.85
    assert shapenet.published_value("SV Meta, 1 view", "Chairs") == 16.54
    assert shapenet.published_value("HyperPlanes, 25 views", "Lamps") == 25.95
    for row in ("MV Meta, 25 views", "HyperPlanes, 1 view", "small, 25 views"):
        assert shapenet.published_value(row, "Cars") is None
    for cell in shapenet.cells:
        assert cell.row.endswith(f", {cell.views} view{'s' if cell.views > 1 else ''}")


def test_all_rows_of_a_column_use_the_same_objects():
    """Property: rows named after training objects use these, and all other rows use test objects."""
    for experiment in EXPERIMENTS.values():
        for cell in experiment.cells:
            assert cell.split == ("train" if cell.row.startswith("Train ") else "test"), (experiment.name, cell)
    assert {row.split()[0] for row in EXPERIMENTS["single-class"].rows} == {"Train", "Test"}
    shapenet = EXPERIMENTS["shapenet"]
    assert {(cell.column, cell.on, cell.trained.on) for cell in shapenet.cells} == {
        ("Chairs", "chair", "chair"),
        ("Cars", "car", "car"),
        ("Lamps", "lamp", "lamp"),
    }


APPENDIX_B = {  # from the LaTeX source: the entries of both sizes, then those of each size
    0: {
        "model.network.depth": 8,
        "model.network.width": 256,
        "model.network.planes": 25,
        "model.sampling.coarse": 64,
        "model.sampling.fine": 128,
        "model.hypernetwork.width": 256,
        "model.hypernetwork.activation": "relu",
        "model.hypernetwork.layers": ("colour", "density"),
        "training.optimiser": "adam",
        "training.tasks": 1,
        "training.rays": 512,
        "training.learning_rate": 1e-4,
        "training.hypernetwork_learning_rate": 1e-4,
        "training.clip": 0.0,
        "training.warmup": 0,
        "training.final_rate_factor": 1.0,
    },
    128: {"hypernetwork.views": 5, "hypernetwork.depth": 3, "hypernetwork.encoder": "convnet"},
    200: {"hypernetwork.views": 25, "hypernetwork.depth": 10, "hypernetwork.encoder": "resnet101"},
}


def entry(value, name):
    for part in name.split("."):
        value = getattr(value, part)
    return value


@pytest.mark.parametrize(("name", "size"), [("shapenet", 128), ("cross-class", 200)])
def test_the_scale_of_the_paper_has_the_settings_of_the_paper(name, size):
    experiment, scale = EXPERIMENTS[name], SCALES["paper"]
    assert experiment.size == size
    trained = next(each for each in experiment.trainings if each.method == "hyperplanes" and not each.packaged)
    made = configuration(experiment, trained, scale, objects=7, seed=3)
    for key, value in APPENDIX_B[0].items():
        assert entry(made, key) == value, key
    for key, value in APPENDIX_B[size].items():
        assert entry(made.model, key) == value, key
    assert made.training.seed == 3
    cross = EXPERIMENTS["cross-class"]
    plane = next(each for each in cross.trainings if each.on == "plane")
    assert configuration(cross, plane, scale, objects=7, seed=0).training.steps == 2460 * 7
    small = SCALES["small"]
    assert configuration(cross, plane, small, objects=7, seed=0).training.steps == small.steps


@pytest.mark.parametrize("scale", SCALES.values(), ids=SCALES)
def test_every_scale_configures_every_model(scale):
    for experiment in EXPERIMENTS.values():
        for trained in scale.applied(experiment).trainings:
            made = configuration(experiment, trained, scale, objects=3, seed=1)
            assert made.training.seed == 1
            assert made.training.steps > 0


def test_differences_from_the_paper_are_only_the_known_ones():
    # in Eq. 7 the hypernetwork reads theta; with the presets it reads the weights of the updated layers (docs/paper.md)
    for experiment in EXPERIMENTS.values():
        found = {
            each.entry for each in differences(experiment, SCALES["paper"]) if each.sources[0] not in ("-", each.here)
        }
        assert found <= {"model.hypernetwork.weights_seen"}, experiment.name
    # in learnit, the rate of Adam, of which there are two
    learned = [each for each in differences(EXPERIMENTS["shapenet"], SCALES["paper"]) if each.sources[2] != "-"]
    assert [each.entry for each in learned] == ["training.learning_rate"]
    assert len(differences(EXPERIMENTS["shapenet"], SCALES["small"])) > 20


def test_learned_initialisations_at_the_scale_of_the_paper_are_those_of_tancik_et_al():
    # from tancik/learnit, Experiments/shapenet.ipynb
    experiment = EXPERIMENTS["shapenet"]
    trained = next(each for each in experiment.trainings if each.method == "mv_meta")
    made = configuration(experiment, trained, SCALES["paper"], objects=700, seed=0)
    network = HyperPlanes(made.model).networks["fine"]
    shapes = [tuple(value.shape) for name, value in network.named_parameters() if name.endswith("weight")]
    assert sorted(shapes) == sorted([(256, 120), *[(256, 256)] * 4, (1, 256), (3, 256)])
    assert made.model.coarse_network is False
    assert (made.model.sampling.coarse, made.model.sampling.fine) == (128, 0)
    assert (made.training.steps, made.training.rays, made.training.tasks) == (100_000, 128, 1)
    learned = made.model.initialisation
    assert (learned.inner_steps, learned.inner_rate, learned.steps, learned.test_rays) == (32, 0.5, 2000, 64)
    descent = learned.descent()
    assert (descent.optimiser, descent.learning_rate, descent.final_rate_factor) == ("sgd", 0.5, 1.0)


def test_fine_tuning_at_the_scale_of_the_paper_is_that_of_the_authors_and_of_nerf():
    # run_hyperplanes_new_eval.py: Adam with rate 1e-4; NeRF, section 5.3: the rate decreases from 5e-4 to 5e-5
    scale = SCALES["paper"]
    tuning, scratch = scale.fine_tuning, scale.scratch
    assert (tuning.trainable, tuning.rays, tuning.optimiser, tuning.learning_rate) == (
        "hypernetwork",
        512,
        "adam",
        1e-4,
    )
    assert {tuning.schedule(step, 100) for step in (0, 50, 100)} == {1.0}
    assert (scratch.rays, scratch.optimiser, scratch.betas) == (4096, "adam", (0.9, 0.999))
    rates = [scratch.learning_rate * scratch.schedule(step, 100) for step in (0, 50, 100)]
    assert rates == pytest.approx([5e-4, 5e-4 * 0.1**0.5, 5e-5])


def test_changes_apply_only_to_the_named_entry():
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
    target = EXPERIMENTS["target"]
    nerf, *others = [configuration(target, each, SCALES["small"], 10, 0).model for each in target.trainings]
    assert [nerf.differences(other) for other in others] == [["target"], ["target"]]
    layers = EXPERIMENTS["layers"]
    last, full, low_rank = [configuration(layers, each, SCALES["small"], 10, 0).model for each in layers.trainings]
    assert last.differences(full) == ["hypernetwork.layers"]
    assert full.differences(low_rank) == ["hypernetwork.update"]
    assert (last.hypernetwork.layers, last.hypernetwork.update) == (("colour", "density"), "full")
    inputs = EXPERIMENTS["inputs"]
    first, *others = [configuration(inputs, each, SCALES["small"], 10, 0).model for each in inputs.trainings]
    weights, directions = "hypernetwork.see_weights", "hypernetwork.see_directions"
    assert [first.differences(other) for other in others] == [
        [weights],
        [directions],
        [directions, weights],
        ["target"],
    ]


def test_selecting_rows_and_columns_of_a_table():
    shapenet = EXPERIMENTS["shapenet"]
    assert shapenet.of(()) == shapenet
    one = shapenet.of(["Cars", "Standard, 1 view", "MV Meta, 1 view"])
    assert (one.rows, one.columns) == (["Standard, 1 view", "MV Meta, 1 view"], ["Cars"])
    assert [each.on for each in shapenet.of(["Lamps"]).trainings] == ["lamp"] * len(shapenet.of(["Lamps"]).trainings)
    with pytest.raises(ValueError, match="--only: expected headings of shapenet, .*'Cars', 'Lamps', got 'Boats'"):
        shapenet.of(["Boats"])
    with pytest.raises(ValueError, match="--only: expected headings with a common cell, got 'Cars: HyperPlanes', '3'"):
        SCALES["smoke"].applied(EXPERIMENTS["iterations"]).of(["Cars: HyperPlanes", "3"])


def test_sizes_of_the_scales():
    smoke, small, paper = SCALES["smoke"], SCALES["small"], SCALES["paper"]
    assert [scale.method("hyperplanes_100") for scale in (smoke, small)] == ["hyperplanes_2", "hyperplanes_100"]
    assert [scale.planes(25) for scale in (smoke, small, paper)] == [4, 25, 25]
    # docs/paper.md, "at which size"
    assert (small.resolution, small.objects - small.held_out, small.steps, small.evaluated) == (32, 40, 200, 10)
    assert (smoke.resolution, smoke.steps, smoke.evaluated, smoke.most_seeds) == (16, 2, 1, 1)
    assert (SCALES["gpu"].steps, SCALES["gpu"].evaluated, paper.steps, paper.evaluated) == (5000, 5, None, None)
    iterations = EXPERIMENTS["iterations"]
    assert small.applied(iterations).columns == ["0", "100", "300", "1000"]
    assert {c.method for c in smoke.applied(iterations).cells} == {"hyperplanes", "nerf_scratch_3"}
    assert paper.applied(iterations) == iterations
    assert [small.seeds(EXPERIMENTS[name]) for name in ("shapenet", "cross-class", "target")] == [3, 3, 3]
    # "averaged over 3 runs", "over 5 runs"; tab:shapenet and tab:time do not state the number of runs
    stated = {name: each.runs for name, each in EXPERIMENTS.items() if each.runs != 5}
    assert stated == {"shapenet": None, "time": None, "iterations": 3}
    assert [paper.seeds(EXPERIMENTS[name]) for name in ("cross-class", "iterations", "time")] == [5, 3, 1]


def outcome_of(experiment, seeds, **about):
    """An outcome with two objects in each cell, and `seeds` seeds, or one for packaged models."""
    row = Score("", (ObjectScore("a", 20.0, 0.9, 1.0, 1.0, 19.0), ObjectScore("b", 22.0, 0.9, 1.0, 1.0, 21.0)))
    scores = {(c.row, c.column): row if c.trained.packaged else merge_seeds([row] * seeds) for c in experiment.cells}
    return Outcome(experiment, SCALES["small"], scores, {}, seeds, **about)


def test_a_table_of_packaged_models_on_given_data_states_this():
    """By hand: nothing is generated or trained, and two of the ten objects of the scale are evaluated once."""
    packaged = EXPERIMENTS["shapenet"].of(["small, 1 view", "Cars"])
    outcome = outcome_of(packaged, 1, objects={}, given=["car"])
    assert report.what_differs(outcome)[:3] == [
        "Data: given data sets of cars. Paper: ShapeNet at 128x128, 25 and 25 views.",
        "Evaluated on 2 objects a class. Paper: all test objects.",
        "Seeds: packaged models are evaluated once. Paper: not stated.",
    ]
    assert "states another value" not in report.as_markdown(outcome, "")


def test_numbers_of_objects_and_runs_of_the_paper_are_stated():
    """Source of truth: the paper: "two objects from the car and chair classes", and "averaged over 3 runs"."""
    names = "iterations", "target"
    found = {name: report.what_differs(outcome_of(EXPERIMENTS[name], 3, objects={})) for name in names}
    judged = {name: [line for line in lines if line.startswith("Evaluated on")] for name, lines in found.items()}
    assert judged == {"iterations": [], "target": ["Evaluated on 2 objects a class. Paper: all test objects."]}
    assert [line.rpartition(". ")[2] for line in found["iterations"] if line.startswith("Seeds")] == ["Paper: 3."]


def test_a_table_states_data_training_and_seeds():
    both = EXPERIMENTS["shapenet"].of(["small, 1 view", "HyperPlanes, 1 view", "Cars", "Chairs"])
    outcome = outcome_of(both, 3, objects={"car": 40, "chair": 7}, given=["chair"])
    data, training, _, seeds, *_ = report.what_differs(outcome)
    assert data.startswith(
        "Data: procedural objects of 32x32 pixels, 25 support and 25 query views; given data sets of chairs; "
        "trained on 40 cars, 7 chairs. Paper: "
    )
    assert training.startswith("Training: 200 steps of each model. Paper: ")
    assert seeds.startswith("Seeds: 3, each that of a training")
    assert "packaged models are evaluated once" in seeds
    lines = csv.DictReader(io.StringIO(report.as_csv(outcome)))
    assert {line["row"]: line["seeds"] for line in lines} == {"small, 1 view": "1", "HyperPlanes, 1 view": "3"}
    learned = EXPERIMENTS["shapenet"].of(["MV Meta, 1 view", "Cars"])
    outcome = replace(outcome, experiment=learned, scale=SCALES["gpu"])
    assert report.what_differs(outcome)[1].startswith("Training: 2,000 steps of learned initialisations. Paper")
