"""Source of truth: the page, parsed as HTML, and its decoded pictures, compared with the inputs."""

import base64
import io
import re
from dataclasses import replace
from functools import cache
from html.parser import HTMLParser
from xml.etree import ElementTree

import numpy as np
import pytest
import torch
from PIL import Image
from small_demo import demo_folder
from small_packaged import small_packaged

from hyperplanes.adaptation import HyperPlanes
from hyperplanes.adaptation.checkpoints import packaged_folder
from hyperplanes.data.support import FarthestSupport
from hyperplanes.experiments.data_sets import DataSets
from hyperplanes.experiments.demonstration.settings import DemoSettings
from hyperplanes.experiments.demonstration.steps import Demonstration
from hyperplanes.experiments.engine import Runner
from hyperplanes.experiments.page import Exhibit, QueryView, Report, Row, render_page
from hyperplanes.experiments.page.charts import line_chart
from hyperplanes.experiments.page.pictures import ERROR_SCALE, colour_scale, error_map
from hyperplanes.export.images import orbit_cameras, to_pixels
from hyperplanes.utilities.files.checkpoints import CheckpointError
from hyperplanes.utilities.machine.environment import find_commit
from tests.reference_rendering import Balls

VOID = {"meta", "img", "input", "br", "hr", "link"}


class Balance(HTMLParser):
    def __init__(self):
        super().__init__()
        self.open, self.sources, self.ids = [], [], []

    def handle_starttag(self, tag, attrs):
        attributes = dict(attrs)
        self.ids.append(attributes.get("id"))
        if tag == "img":
            self.sources.append(attributes["src"])
            assert attributes["alt"]
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attrs):
        """Such a tag is closed already."""

    def handle_endtag(self, tag):
        assert self.open.pop() == tag


class NamedBalls(Balls):
    """Balls whose views have file names, in one split."""

    def names(self, split):
        return super().names("test")

    def task(self, name):
        task = super().task(name)
        return replace(task, query=replace(task.query, names=tuple(f"{index}.png" for index in range(self.views))))


def report(title="A <title> & more"):
    generator = np.random.default_rng(0)
    look = QueryView(
        *(generator.integers(0, 256, (8, 8, 3), np.uint8),), {"hyperplanes": np.zeros((8, 8, 3), np.uint8)}
    )
    exhibit = Exhibit("car", generator.integers(0, 256, (4, 8, 8, 3), np.uint8), [2, 0], [look], {"hyperplanes": 20.0})
    row = Row("hyperplanes", "one step", 20.0, 1.5, 17.25, 0.5, "1 s", "2 s")
    curve = [{"step": 25, "loss": 0.1}, {"step": 50, "loss": 0.01, "psnr": 20.0}]
    return Report(
        title,
        "lead",
        [("1", "thing")],
        "hyperplanes",
        [exhibit],
        [row],
        {"hyperplanes": curve},
        {"scratch": [(1.0, 15.0), (10.0, 18.0)]},
        "they differ",
        [],
        [],
    )


@cache
def whole_page():
    """The page of `report()`."""
    return render_page(report())


def checked(page):
    parser = Balance()
    parser.feed(page)
    assert parser.open == []
    names = [name for name in parser.ids if name]
    assert len(names) == len(set(names))
    return parser


def test_the_page_is_valid_and_loads_no_other_files():
    page = whole_page()
    parser = checked(page)
    assert all(source.startswith("data:image/") for source in parser.sources)
    assert not re.search(r"(src|href)=[\"']?(https?:)?//|url\(|@import|<script", page)
    assert "A &lt;title&gt; &amp; more" in page


def test_the_pictures_of_the_page_are_the_inputs():
    content = report()
    found = [
        np.asarray(Image.open(io.BytesIO(base64.b64decode(source.partition(",")[2]))))
        for source in checked(whole_page()).sources
        if not source.startswith("data:image/svg")
    ]
    (exhibit,) = content.exhibits
    np.testing.assert_array_equal(np.stack(found[:4]), exhibit.support[[2, 0, 1, 3]])
    np.testing.assert_array_equal(found[4], exhibit.views[0].truth)


def test_a_method_without_pictures_is_refused():
    content = report()
    with pytest.raises(ValueError, match="expected exhibits that show other"):
        render_page(Report(**{**vars(content), "method": "other"}))


def test_colours_of_errors_are_on_the_scale():
    truth = np.zeros((1, 3, 3), np.uint8)
    prediction = np.array([[[0] * 3, [round(255 * ERROR_SCALE)] * 3, [255] * 3]], np.uint8)
    seen = error_map(prediction, truth)
    np.testing.assert_array_equal(seen[0, 0], colour_scale(np.array(0.0)))
    np.testing.assert_array_equal(seen[0, 2], colour_scale(np.array(1.0)))
    assert np.abs(seen[0, 1].astype(int) - seen[0, 2]).max() <= 2
    with pytest.raises(ValueError, match="shape"):
        error_map(prediction, truth[:, :2])


def test_the_lightness_of_the_scale_is_monotonic():
    lightness = colour_scale(np.linspace(0, 1, 100)) @ np.array([0.299, 0.587, 0.114])
    assert (np.diff(lightness) < 0).all()


def drawn(source):
    kind, _, content = source.partition(",")
    assert kind == "data:image/svg+xml;base64"
    return ElementTree.fromstring(base64.b64decode(content))


def test_a_line_of_a_chart_goes_through_its_points():
    root = drawn(line_chart({"first": [(0, 1.0), (50, 3.0), (100, 2.0)], "none": []}, "dB"))
    lines = [each for each in root.iter("{http://www.w3.org/2000/svg}path") if "#b4450e" in each.get("style", "")]
    found = [re.findall(r"[ML] (\S+) (\S+)", line.get("d")) for line in lines]
    points = max(found, key=lambda each: float(each[-1][0]) - float(each[0][0]))  # the other line is in the legend
    (x0, y0), (x1, y1), (x2, y2) = (tuple(map(float, pair)) for pair in points)
    assert x1 - x0 == pytest.approx(x2 - x1, abs=0.2)
    assert y1 < y2 < y0
    assert y0 - y2 == pytest.approx(y2 - y1, abs=0.2)
    words = {each.text for each in root.iter("{http://www.w3.org/2000/svg}text")}
    assert {"first", "dB", "steps"} <= words
    assert "none" not in words
    assert line_chart({"a": []}, "dB") == ""


def test_each_number_of_steps_has_a_tick():
    root = drawn(line_chart({"a": [(0, 1.0), (1, 3.0), (300, 2.0)]}, "dB", counts=True))
    words = [each.text for each in root.iter("{http://www.w3.org/2000/svg}text")]
    assert [word for word in words if word.isdigit()][:3] == ["0", "1", "300"]


def test_the_table_has_spread_and_foreground():
    page = whole_page()
    assert "20.00 &plusmn; 1.50 dB" in page
    assert "17.25 dB" in page
    empty = replace(report(), curves={"hyperplanes": []}, tuning={})
    plain = replace(empty, table=[replace(empty.table[0], foreground=None)])
    assert [each.count("nothing was recorded") for each in (page, render_page(empty))] == [0, 3]
    assert "17.25" not in render_page(plain)


def test_the_page_of_a_demonstration():
    page = (demo_folder() / "report.html").read_text(encoding="utf-8")
    parser = checked(page)
    assert any(source.startswith("data:image/webp") for source in parser.sources)
    for name in ("nearest_view", "hull_blend", "hull_blend:chair", "point_multiplane", "hyperplanes", "hyperplanes_1"):
        assert f"<small>{name}</small>" in page
    assert "nan" not in re.findall(r"[a-z]+", page[page.index("<table") :].split("</table>")[0])  # rows of one object
    assert "arXiv 2402.01524" in page
    assert find_commit() in page


def test_the_first_page_uses_the_packaged_model_even_if_a_folder_has_its_name(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "small").mkdir()
    with pytest.raises(CheckpointError, match="small"):
        HyperPlanes.from_pretrained("small")  # for a given name, a folder of that name has precedence
    shown, balls = [], NamedBalls(train=0, test=1, views=6, size=(24, 24))
    monkeypatch.setattr(DataSets, "tasks", lambda data, class_name: balls)
    monkeypatch.setattr(DataSets, "folder", lambda data, class_name: tmp_path)
    settings = replace(DemoSettings.quick_check(), first=("car",), first_counts=(3,), frames=4)
    cpu = torch.device("cpu")

    def make_runner(workspace, scale):
        return Runner(workspace, DataSets(workspace, scale, generate=None, device=cpu), train=None, device=cpu)

    with small_packaged():
        Demonstration(settings, tmp_path, make_runner, lambda: None, shown.append, None).show_packaged()
        model = HyperPlanes.from_pretrained(packaged_folder("small"))
    assert (tmp_path / "first.html").exists()
    rows = [line.partition(":")[0] for line in shown]
    baselines = ["the nearest support view, copied (3 views)", "support views blended on the visual hull (3 views)"]
    assert rows == [*baselines, "3 views", "the first page"]
    frames = sorted((tmp_path / "first/pictures/car/views_3/test0/orbit").iterdir())
    support = FarthestSupport(balls, 3, 2).task("test0").support
    found = to_pixels(model.adapt(support).render(orbit_cameras(support, 2)).images)
    read = np.stack([np.asarray(Image.open(frame).convert("RGB")) for frame in frames])
    assert np.abs(read.astype(int) - found).max() <= 1


def test_the_first_page_is_made_again_when_the_mesh_files_change(tmp_path, monkeypatch):
    """Property: an added mesh changes the result; files that the demonstration itself writes there do not."""
    made, cpu = [], torch.device("cpu")
    monkeypatch.setattr(Demonstration, "_show_packaged", lambda self, page: made.append(page.write_bytes(b"")))
    out = tmp_path / "out"
    out.mkdir()

    def make_runner(workspace, scale):
        return Runner(workspace, DataSets(workspace, scale, generate=None, device=cpu), train=None, device=cpu)

    def show():
        settings = replace(DemoSettings.quick_check(), meshes=tmp_path)
        demonstration = Demonstration(settings, out, make_runner, lambda: None, print, None)
        demonstration.show_packaged()
        return demonstration.packaged.data.name("meshes")

    first = show()
    assert (show(), len(made)) == (first, 1)
    (tmp_path / "chair.obj").write_bytes(b"")
    assert show() != first
    assert len(made) == 2
