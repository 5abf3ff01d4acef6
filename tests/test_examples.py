"""Source of truth: the code in README.md and the other pages, which is run as it is."""

import dataclasses
import re
from pathlib import Path

from small_packaged import small_packaged

import hyperplanes

ROOT = Path(__file__).resolve().parent.parent
README = (ROOT / "README.md").read_text(encoding="utf-8")


def blocks(page):
    return re.findall(r"```python\n(.*?)```", page, re.DOTALL)


def test_the_readme_runs(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    here, first = {}, blocks(README)[0].replace("frames=48", "frames=2, size=24")
    assert first.count("  # 25 images for the model, 25 others to compare with\n") == 1
    few = "\nassert (len(task.support), len(task.query)) == (25, 25)"
    few += "\nimport dataclasses; task = dataclasses.replace(task, query=task.query[:2])\n"
    with small_packaged(residuals=False, learned_correction=False):
        exec(first.replace("  # 25 images for the model, 25 others to compare with\n", few), here)
    assert len(list((tmp_path / "new-views").glob("*.png"))) == len(here["task"].query)
    assert (tmp_path / "turntable.webp").exists()


def test_the_method_in_code_runs():
    here = {}
    exec(blocks((ROOT / "docs" / "how-it-works.md").read_text(encoding="utf-8"))[0], here)
    assert here["loss"].requires_grad


def test_files_that_the_readme_links_to_exist():
    paths = re.findall(r"\]\((?!https?:)([^)#]+)\)", README)
    assert {"docs/chair.webp", "docs/paper.md", "docs/tutorials/meshes.ipynb"} <= set(paths)
    for path in paths:
        assert (ROOT / path).exists(), path


def test_the_readme_names_verbs_that_exist():
    from hyperplanes.commands import find_verbs

    named = set(re.findall(r"^hyperplanes (\w+)", README, re.MULTILINE))
    assert {"render", "capture", "view"} <= named <= set(find_verbs())


def test_all_public_names_exist():
    for name in hyperplanes.__all__:
        assert getattr(hyperplanes, name) is not None
    assert {name for name in dir(hyperplanes) if not name.startswith("_")} == set(hyperplanes.__all__)
    assert hyperplanes.__version__


def test_the_template_of_a_package_adds_its_field_and_its_method(monkeypatch, tmp_path):
    """The entry points are read from its pyproject.toml. Property: its field is symmetric in x."""
    import tomllib
    from importlib.metadata import EntryPoint, EntryPoints

    import torch

    from hyperplanes.adaptation import FineTuning, HyperPlanes
    from hyperplanes.configuration.presets import PRESETS, preset
    from hyperplanes.methods import Request, describe_method, make_method
    from hyperplanes.utilities import entry_points
    from tests.reference_rendering import ball_views, ring, small_model

    named = tomllib.loads((ROOT / "examples/plugin/pyproject.toml").read_text())["project"]["entry-points"]
    found = {
        group: EntryPoints(EntryPoint(name, value, group) for name, value in entries.items())
        for group, entries in named.items()
    }
    monkeypatch.syspath_prepend(ROOT / "examples/plugin")
    monkeypatch.setattr(entry_points, "find_entries", lambda group: found.get(group, ()))
    monkeypatch.setitem(
        PRESETS, "quick", dataclasses.replace(PRESETS["quick"], model=small_model(hypernetwork=None).config)
    )

    assert describe_method("symmetric_scratch_3") == "a symmetric NeRF of one object from random weights, 3 steps"
    field = make_method(Request("symmetric_scratch_3", settings=FineTuning(rays=16))).adapt(ball_views(ring(4)))
    points = torch.rand(20, 3) - 0.5
    torch.testing.assert_close(field.density(points), field.density(points * torch.tensor([-1.0, 1.0, 1.0])))
    HyperPlanes(preset("quick").by_method("symmetric").model).save(tmp_path)
    assert HyperPlanes.from_pretrained(tmp_path).config.target == "symmetric"
