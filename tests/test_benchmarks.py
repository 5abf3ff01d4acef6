"""Tests of benchmarks. Source of truth: the same figures computed separately, and gradients of every weight."""

import importlib
import inspect
import json
import math
import os
import re
import subprocess
import sys
import threading
import time
import types
from contextlib import nullcontext
from dataclasses import replace

import pytest
import torch
from small_demo import demo_folder

from benchmarks import __main__ as benchmarks_main
from benchmarks import all as all_benchmarks
from benchmarks import gpu, image_based, steps, tables, views
from benchmarks.parts import load as machine_load
from benchmarks.parts import timing as _timing
from benchmarks.parts.load import OF_SPEED
from benchmarks.parts.reporting import write_rows
from benchmarks.training import step_parts
from hyperplanes.adaptation import HyperPlanes
from hyperplanes.adaptation.correction import stacking
from hyperplanes.fields import TARGETS, ImageBasedNeRF
from hyperplanes.rendering import RayMarching, renderer
from hyperplanes.training import Trainer, TrainingConfig
from hyperplanes.utilities.files.reading import DataError, read_json
from hyperplanes.utilities.machine.environment import usable_cores
from tests.reference_rendering import Balls
from tests.training.test_volume_loss import MODEL


@pytest.mark.parametrize("name", [*image_based.VARIANTS, *image_based.HYPERNETWORKS])
def test_every_weight_of_every_variant_is_trained(name):
    before = dict(TARGETS)
    with image_based.configured(name, 4, 0) as made:
        assert TARGETS == before | {name: image_based.VARIANTS.get(name, ImageBasedNeRF)}
        small = replace(made.model.network, depth=2, width=16, planes=3)
        model = HyperPlanes(replace(made.model, network=small, hull_resolution=16))
        training = replace(made.training, tasks=1, rays=48, views=(3, 5), episodes=4)
        trainer = Trainer(model, Balls(views=6, size=(24, 24)), training)
        for _ in range(3):  # outputs of a hypernetwork start at zero and pass no gradients in the first step
            trainer.take_step()
    assert TARGETS == before, "other benchmarks in this process do not know the variant"
    assert not {key for key, value in model.named_parameters() if value.grad is None or not value.grad.any()}
    assert any(key.startswith("hypernetwork") for key in model.state_dict()) == (name in image_based.HYPERNETWORKS)


def test_the_unstacked_field_of_a_model_without_stacking_is_that_of_the_model():
    model, task = HyperPlanes(MODEL), Balls(views=6, size=(24, 24)).task("train0")
    found = views.METHODS["unstacked"](model).adapt(task.support)  # the update is zero
    expected, cameras = model.adapt(task.support), task.query.cameras
    assert torch.equal(found.render(cameras).images, expected.render(cameras).images)


def test_an_ungated_model_has_one_weight_of_the_hull_per_object(monkeypatch):
    model, task = HyperPlanes(replace(MODEL, stacked=True, gated=True)), Balls(views=6, size=(24, 24)).task("train0")
    monkeypatch.setattr(stacking, "hull_share", lambda *_: 0.4)
    found = views.METHODS["ungated"](model).adapt(task.support).render(task.query.cameras).images
    assert not torch.equal(found, model.adapt(task.support).render(task.query.cameras).images)
    model.gate = None
    assert torch.equal(found, model.adapt(task.support).render(task.query.cameras).images)


@pytest.mark.parametrize(("method", "option"), [("one_ray", "antialias"), ("single_precision", "mixed_precision")])
def test_variants_of_rendering_pass_their_option_to_the_same_field(method, option):
    field = types.SimpleNamespace(render=lambda cameras, **options: (cameras, options))
    model = types.SimpleNamespace(adapt=lambda support: types.SimpleNamespace(without_residuals=lambda: field))
    assert views.METHODS[method](model).adapt("views").render("cameras") == ("cameras", {option: False})


def test_the_benchmark_of_views_fine_tunes_only_on_two_views_or_more(tmp_path):
    HyperPlanes(replace(MODEL, sampling=RayMarching(8), hull_resolution=16)).save(tmp_path / "model")
    options = ["--checkpoint", str(tmp_path / "model"), "--data", str(demo_folder() / "data"), "--objects", "1"]
    options += ["--query", "1", "--methods", "ungated", "uncorrected", "--counts", "1", "2", "--steps", "1", "--coarse"]
    found = []
    for seeds in ("1", "2"):
        assert views.main([*options, "--seeds", seeds, "--json", str(tmp_path / "rows.json")]) == 0
        found.append(json.loads((tmp_path / "rows.json").read_text())["rows"])
    for one, two in zip(*found, strict=True):  # rows with steps differ: one seed, and the mean of two
        tuned = "steps" in one["name"] or "scratch" in one["name"]
        assert two.get("seeds") == (2 if tuned else None)
        assert (one["psnr"] != two["psnr"]) == tuned
        if one["name"] == "1_steps":
            scratch = next(row for row in found[0] if row["name"] == "scratch_1")
            assert one["over_scratch_1"] == pytest.approx(one["psnr"] - scratch["psnr"])
    quality = {(row["views"], row["name"]): row["psnr"] for row in found[0]}
    for row in found[0]:  # the gain of residual correction
        if row["name"] in ("one_step", "1_steps"):
            uncorrected = "uncorrected" if row["name"] == "one_step" else "1_steps_uncorrected"
            assert row[f"over_{uncorrected}"] == pytest.approx(row["psnr"] - quality[row["views"], uncorrected])
    rows = [(row["views"], row["name"]) for row in found[0]]
    both, tuned = ["ungated", "one_step"], ["1_steps", "1_steps_ungated", "1_steps_coarse"]
    references = ["uncorrected", "1_steps_uncorrected", "scratch_1", "scratch_1_coarse"]
    expected = {1: ["uncorrected", *both], 2: [*references, *both, *tuned]}
    assert rows == [(count, name) for count, names in expected.items() for name in names]


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["captures", "--quick", "--meshes", "OUT/none"], "none: expected a folder of meshes, found nothing"),
        (["captures", "--quick", "--count", "0"], "--count: expected a whole number of at least 1, got '0'"),
        (["lookup", "--threads", "-1"], "--threads: expected a whole number of at least 1, got '-1'"),
        (["lookup", "--threads", "0"], "--threads: expected a whole number of at least 1, got '0'"),
        (["steps", "--threads", "0"], "--threads: expected a whole number of at least 1, got '0'"),
        (["all", "--workers", "0"], "--workers: expected a whole number of at least 1, got '0'"),
        (["small", "--sizes", "0"], "--sizes: expected a whole number of at least 1, got '0'"),
        (["splats", "--objects", "zebra"], "class: expected one of car, chair, plane, lamp, random, got 'zebra'"),
        (["views", "--data", "DATA", "--objects", "0"], "--objects: expected a whole number of at least 1, got '0'"),
        (["views", "--data", "DATA", "--query", "0"], "--query: expected a whole number of at least 1, got '0'"),
        (["views", "--data", "DATA", "--counts", "3", "0"], "--counts: expected a whole number of at least 1, got '0'"),
        (["views", "--data", "DATA", "--counts", "1", "--inputs", "1"], "--counts, --inputs: expected one of the two"),
        (["views", "--data", "DATA", "--counts", "100"], "data: expected 100 views to show, found 9; choose smaller"),
        (["views", "--data", "DATA", "--inputs", "99"], "expected inputs from 0 to 11, got 99; name other views"),
    ],
)
def test_wrong_input_is_reported_in_one_line(words, expected, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(benchmarks_main, "load_at_start", lambda: 0.0)
    places = {"DATA": str(demo_folder() / "data"), "OUT": str(tmp_path)}
    try:
        code = benchmarks_main.main([places.get(w, w.replace("OUT", places["OUT"])) for w in words])
    except SystemExit as ended:  # argparse exits after printing the usage
        code = ended.code
    assert code == 2
    assert expected in capsys.readouterr().err.splitlines()[-1]


def test_there_are_no_rows_for_more_views_than_objects_have(monkeypatch, capsys):
    """By hand: three of the 12 views of an object are query views, so at most nine can be support views."""
    monkeypatch.setattr(views, "adapters", lambda *_, **__: {})
    monkeypatch.setattr(views, "_measured", lambda *_: [{"name": "a method"}])
    monkeypatch.setattr(views, "_best_median_worst", lambda seen: [])
    assert views.main(["--data", str(demo_folder() / "data"), "--counts", "1", "9", "10"]) == 0
    shown = capsys.readouterr().out
    assert [f"'views': {count}," in shown for count in (1, 9, 10)] == [True, True, False]
    assert "data: no rows of 10 views, there are 9 to show" in shown


@pytest.mark.parametrize("threads", [1, 2])
def test_all_parts_of_a_step_in_the_table_are_measured(threads):
    trainer = Trainer(HyperPlanes(MODEL), Balls(), TrainingConfig(tasks=1, rays=16, views=(1, 3)))
    before = torch.get_num_threads()
    try:
        torch.set_num_threads(threads)
        found = {row["name"].removeprefix("part of a step, ours: "): row for row in step_parts("ours", trainer)}
        assert torch.get_num_threads() == threads
    finally:
        torch.set_num_threads(before)
    assert found.keys() >= tables.PARTS.keys()
    assert all(found[part]["seconds"] > 0 for part in tables.PARTS)


@pytest.mark.parametrize("option", ["--json=rows.json", "--js=rows.json", "--j"])
def test_all_spellings_of_the_option_json_are_recognised(option, monkeypatch, capsys):
    """Property: the check of the load recognises the spellings that argparse accepts as --json."""
    monkeypatch.setattr(benchmarks_main, "load_at_start", lambda: 1.4)
    assert benchmarks_main.main(["small", "--quick", option]) == 2
    assert "1.4 cores busy" in capsys.readouterr().err


@pytest.mark.parametrize("name", sorted(OF_SPEED))
def test_rows_of_speed_are_not_written_on_a_busy_machine(name, tmp_path, monkeypatch, capsys):
    """Property: with more than 0.3 busy cores, nothing is measured or written without --under-load."""
    ran = []
    benchmark = types.SimpleNamespace(main=lambda arguments: ran.append(arguments))
    monkeypatch.setattr(benchmarks_main, "import_module", lambda _: benchmark)
    given = [name, "--quick", "--json", str(tmp_path / "rows.json")]
    for load, told, times in ((1.4, [], 0), (1.4, ["--under-load"], 1), (0.2, [], 2)):
        monkeypatch.setattr(benchmarks_main, "load_at_start", lambda load=load: load)
        assert benchmarks_main.main([*told, *given]) == (0 if told or load < 0.3 else 2)
        assert ran == [given[1:]] * times
        assert ("1.4 cores busy" in capsys.readouterr().err) == (times == 0)


def test_all_runs_every_benchmark_and_says_what_needs_data(tmp_path, monkeypatch, capsys):
    """Property: `all` runs every benchmark, with options that the benchmark has, and passes --under-load on.

    `all`, `tables`, `gating` and `correction` make no rows themselves.
    """
    ran, without_rows = [], {"all", "tables", "gating", "correction"}
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    run = types.SimpleNamespace(returncode=0)
    monkeypatch.setattr(subprocess, "run", lambda command, check, env: ran.append(command[3:]) or run)
    assert all_benchmarks.main(["--out", str(tmp_path)]) == 0
    assert {name for name, *_ in ran} == set(benchmarks_main.NAMES) - {*without_rows, *all_benchmarks.OF_DATA}
    assert "without --data, views, " in capsys.readouterr().out
    ran.clear()
    assert all_benchmarks.main(["--out", str(tmp_path), "--data", "cars", "--under-load"]) == 0
    assert {words[1] for words in ran} == set(benchmarks_main.NAMES) - without_rows
    written = [words[words.index("--json") + 1] for words in ran]
    assert len(set(written)) == len(ran)
    for words in ran:
        assert words[0] == "--under-load"
        assert ("--data" in words) == (words[1] in {*all_benchmarks.OF_DATA, "steps", "gpu"})
        module = importlib.import_module(f"benchmarks.{words[1]}")
        options = {word for word in words[1:] if word.startswith("--")}
        assert options <= set(re.findall(r"--[\w-]+", "".join(map(inspect.getsource, (module, views, _timing)))))


@pytest.mark.parametrize("name", ["gpu", "lookup", "rendering", "training"])
def test_an_unavailable_device_is_reported_in_one_line(name, capsys):
    with pytest.raises(SystemExit) as ended:
        benchmarks_main.main([name, "--device", "cuda:7"])
    assert ended.value.code == 2
    assert "got 'cuda:7'" in capsys.readouterr().err.splitlines()[-1]


def test_all_measures_a_gpu_only_if_there_is_one(tmp_path, monkeypatch):
    ran = []
    run = types.SimpleNamespace(returncode=0)
    monkeypatch.setattr(subprocess, "run", lambda command, check, env: ran.append(command[3:]) or run)
    for here in (False, True):
        ran.clear()
        monkeypatch.setattr(torch.cuda, "is_available", lambda here=here: here)
        assert all_benchmarks.main(["--out", str(tmp_path)]) == 0
        assert ("gpu" in {words[0] for words in ran}) == here
        assert sum("cuda" in words for words in ran) == here  # lookups


def test_all_passes_the_scene_to_adapting_and_to_baked(tmp_path, monkeypatch):
    ran = {}
    run = types.SimpleNamespace(returncode=0)
    monkeypatch.setattr(subprocess, "run", lambda command, check, env: ran.setdefault(command[3], command[4:]) and run)
    assert all_benchmarks.main(["--out", str(tmp_path), "--data", "cars", "chairs", "--scene", "chair"]) == 0
    assert ran["adapting"][:2] == ["--views", "chair"]
    assert ran["baked"][:4] == ["--data", "cars", "chairs", "chair"]
    assert ran["steps"][:3] == ["--data", "cars", "--json"]  # only the first data set


def test_training_steps_are_measured_with_the_number_of_threads_of_the_option(monkeypatch, capsys):
    before = torch.get_num_threads()
    monkeypatch.setattr(steps, "_measured", lambda chosen: [{"name": "a step", "threads": torch.get_num_threads()}])
    for options, threads in (([], 1), (["--threads", "3"], 3)):
        assert steps.main(options) == 0
        assert f"threads {threads}" in capsys.readouterr().out
        assert torch.get_num_threads() == before


def test_the_table_of_the_image_based_field_names_every_variant():
    assert tables.VARIANTS.keys() == image_based.VARIANTS.keys()


def test_all_runs_benchmarks_of_speed_alone_and_of_quality_in_parallel(tmp_path, monkeypatch, capsys):
    running, beside, lock = [], {True: set(), False: set()}, threading.Lock()

    def run(command, check, env):
        name = command[3]
        with lock:
            running.append(name)
            beside[name in OF_SPEED].add(tuple(running))
            assert name in OF_SPEED or env["OMP_NUM_THREADS"] == str(max(1, usable_cores() // 2))
        time.sleep(0.01)
        with lock:
            running.remove(name)
        return types.SimpleNamespace(returncode=int(name in ("small", "views")))

    monkeypatch.setattr(subprocess, "run", run)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    assert all_benchmarks.main(["--out", str(tmp_path), "--data", "cars", "--workers", "2"]) == 1
    assert "failed: small; failed: views" in capsys.readouterr().out
    assert beside[True] == {(name,) for name in OF_SPEED}
    assert max(map(len, beside[False])) == 2
    assert not any(OF_SPEED & set(names) for names in beside[False])


def test_implementations_of_rendering_show_the_same_field(monkeypatch):
    """One of them renders without TF32, which a CPU does not have; whether it is asked for shows on all devices."""
    asked, allowed = [], {}
    monkeypatch.setattr(renderer, "allow_tf32", lambda device: asked.append(device) or nullcontext())
    model, task = HyperPlanes(MODEL), Balls(views=6, size=(24, 24)).task("train0")
    adapted, cameras = model.adapt(task.support), task.query.cameras
    expected = adapted.render(cameras, antialias=False, mixed_precision=False).images
    found = {}
    for name, draw in gpu._ways(adapted, torch.device("cpu")).items():
        asked.clear()
        found[name], allowed[name] = draw(cameras), bool(asked)
    assert [name for name in found if not allowed[name]] == ["no TF32"]
    assert not torch.equal(found.pop("layers in bfloat16"), expected)
    assert found.keys() == {"lookups by PyTorch", "no TF32", "field as a function"}
    for images in found.values():
        assert float((images - expected).square().mean()) < 1e-4


@pytest.mark.parametrize("page", tables.PAGES, ids=lambda page: page.name)
def test_tables_of_pages_match_the_measured_rows(page):
    """Another implementation: each page is filled again from the results, as by `python -m benchmarks tables`."""
    text = page.read_text(encoding="utf-8")
    assert tables.fill(text) == text
    assert len(tables.MARKED.findall(text)) == text.count("<!-- benchmarks ")


def test_a_table_has_the_numbers_of_its_rows_and_the_load_of_the_measurement(tmp_path):
    rows = [
        {"name": "lookup", "load": load, "policy": "passive", "threads": threads, "seconds": 0.5, "speedup": speedup}
        for load, threads, speedup in (("idle", 1, 1), ("idle", 2, 1.75), ("busy", 1, 1), ("busy", 2, 0.9))
    ]
    machine = {"benchmark": "busy", "processor": "a processor", "cores": 4, "threads": 2, "load": 0.25}
    machine["commit"] = "abc1234"
    (tmp_path / "busy.json").write_text(json.dumps({**machine, "rows": rows}))
    found = tables.fill("before\n<!-- benchmarks busy -->\nold\n<!-- end -->\nafter", tmp_path)
    assert found.startswith("before\n<!-- benchmarks busy -->\n")
    assert found.endswith("<!-- end -->\nafter")
    assert "| lookup (0.50 s by one thread) | 1.75 | 0.90 |" in found
    assert "*a processor, 4 cores, 2 threads; commit abc1234; load of other processes: 0.25 cores.*" in found
    assert "old" not in found
    for name, message in (("lookup", "run python -m benchmarks lookup"), ("walking", "correct its marker")):
        with pytest.raises(DataError, match=message):
            tables.fill(f"<!-- benchmarks {name} -->\n<!-- end -->", tmp_path)


def test_implementations_that_failed_have_empty_cells(tmp_path):
    drawn = {"milliseconds": 2.0, "psnr": 30.0, "peak_gib": 1.5}
    ways = ["one ray a pixel", "paper's protocol", "no TF32"]
    rows = [{"name": f"small, 200x200, {way}", **drawn} for way in ways]
    rows += [{"name": f"small, 200x200, {way}", "error": "RuntimeError"} for way in ("default", "one CUDA graph")]
    result = {"benchmark": "gpu", "device": "cuda", "gpu": "a GPU", "torch": "2", "commit": "abc1234", "rows": rows}
    (tmp_path / "gpu.json").write_text(json.dumps(result))
    found = {
        name: tables.fill(f"<!-- benchmarks {name} -->\n<!-- end -->", tmp_path)
        for name in ("gpu", "gpu_ways", "gpu_work")
    }
    assert "200x200 | - | 2 ms | 2 ms | 1.0 | - / 30.00 / 30.00 | - |" in found["gpu"]
    assert "| no TF32 | - | 2.0 ms, 30.00 dB |" in found["gpu_ways"]
    assert not any("CUDA graph" in text for text in found.values())


def test_rows_with_numbers_that_are_not_finite_are_valid_json(tmp_path):
    write_rows("captures", [{"name": "lost", "psnr": math.nan, "psnr_given": math.inf}], tmp_path / "rows.json")
    assert read_json(tmp_path / "rows.json")["rows"] == [{"name": "lost", "psnr": None, "psnr_given": None}]


def test_tables_of_views_take_the_rows_of_all_suites(tmp_path):
    """By hand: two suites have a data set of the same name; one number of views is measured in only one of them."""
    machine = {"benchmark": "views", "commit": "abc1234"}
    for suite, counts in (("procedural", (3, 5, 25)), ("cc0", (3, 5, 10, 25)), ("random", ()), ("posed", ())):
        rows = []
        for count in counts:
            row = {"suite": suite, "data": "cars", "views": count, "objects": 10}
            over = {"over_hull_blend": 2.5, "over_hull_blend_low": 2.04, "over_hull_blend_high": 2.96}
            rows.append({"name": "hull_blend", "psnr": 20.0 + count, **row})
            rows.append({"name": "one_step", "psnr": 22.5 + count, **row, **over})
        (tmp_path / f"views_{suite}.json").write_text(json.dumps({**machine, "rows": rows}))
    found = {
        name: tables.fill(f"<!-- benchmarks {name} -->\n<!-- end -->", tmp_path)
        for name in ("views", "views_over", "views_summary")
    }
    assert "| cars (10): **`small`** | 25.50 | 27.50 | - | 47.50 |" in found["views"]
    assert "| CC0 cars (10): `hull_blend` | 23.00 | 25.00 | 30.00 | 45.00 |" in found["views"]
    assert "| cars | +2.50 (+2.0 to +3.0) | +2.50 (+2.0 to +3.0) | - | +2.50 (+2.0 to +3.0) |" in found["views_over"]
    assert "| CC0 cars | 25.5 (23.0) | 27.5 (25.0) | 47.5 (45.0) |" in found["views_summary"]
    assert found["views"].count("*Commit abc1234.*") == 1
    (tmp_path / "views_posed.json").write_text(json.dumps({**machine, "commit": "def5678", "rows": []}))
    files = "views_procedural.json, views_cc0.json, views_random.json"
    found = tables.fill("<!-- benchmarks views -->\n<!-- end -->", tmp_path)
    assert f"*Commit abc1234 ({files}); Commit def5678 (views_posed.json).*" in found


def test_the_load_is_the_time_that_all_cores_were_busy(tmp_path, monkeypatch):
    """By hand: 30 busy ticks in half a second. Idle cores, and those that wait for a disk, do not count."""
    statistics = tmp_path / "stat"
    statistics.write_text("cpu  100 20 30 4000 500 6 7 8 0 0\ncpu0 50 10 15 2000 250 3 3 4 0 0\n")
    after = "cpu  110 25 35 4040 530 10 10 11 9 0\ncpu0 50 10 15 2000 250 3 3 4 0 0\n"
    clock = iter((10.0, 10.5))
    waiting = types.SimpleNamespace(perf_counter=lambda: next(clock), sleep=lambda _: statistics.write_text(after))
    monkeypatch.setattr(machine_load, "STATISTICS", statistics)
    monkeypatch.setattr(machine_load, "time", waiting)
    assert machine_load.measure_load(0.5) == pytest.approx(30 / os.sysconf("SC_CLK_TCK") / 0.5)
    statistics.unlink()
    monkeypatch.setattr(os, "getloadavg", lambda: (0.7, 0.8, 0.9))
    assert machine_load.measure_load() == 0.7


def test_a_busy_loop_in_another_process_raises_the_load():
    """Property: a busy loop in another process uses about one core, or less if the machine has other work."""
    before = machine_load.measure_load(0.2)
    with subprocess.Popen([sys.executable, "-c", "while True: pass"]) as other:
        time.sleep(0.3)
        during = machine_load.measure_load(0.5)
        other.kill()
    assert during > min(before + 0.3, 0.8)
