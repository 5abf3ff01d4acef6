"""Source of truth: the notebooks in docs/tutorials, whose cells are run as they are."""

import json
import shlex
from pathlib import Path

import pytest
from rendered_here import rendered_here
from small_packaged import small_packaged

from hyperplanes.cli import main

TUTORIALS = sorted((Path(__file__).resolve().parent.parent / "docs" / "tutorials").glob("*.ipynb"))


def cells(path):
    for cell in json.loads(path.read_text(encoding="utf-8"))["cells"]:
        if cell["cell_type"] == "code":
            yield "".join(cell["source"])


@pytest.mark.parametrize("path", TUTORIALS, ids=lambda path: path.stem)
def test_the_tutorial_runs(path, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    names = {}
    with rendered_here(), small_packaged(residuals=False, learned_correction=False):
        for cell in cells(path):
            code, _, command = cell.partition("!hyperplanes ")  # a notebook runs the rest in the shell
            exec(code, names)
            if command:
                assert main(shlex.split(command.format(**names))) == 0, cell


def test_notebooks_contain_no_output():
    for path in TUTORIALS:
        document = json.loads(path.read_text(encoding="utf-8"))
        assert not any(cell.get("outputs") for cell in document["cells"]), path
