"""`python -m benchmarks all` makes every table and figure of the documentation."""

import re
import subprocess
import types

import pytest
import torch

from benchmarks import all as all_benchmarks
from benchmarks import tables


@pytest.fixture
def commands(monkeypatch):
    """The commands that `all` runs if all of its options are given."""
    ran = []
    run = types.SimpleNamespace(returncode=0)
    monkeypatch.setattr(subprocess, "run", lambda command, check, env: ran.append(command[3:]) or run)
    monkeypatch.setattr(tables, "main", lambda arguments: 0)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    assert all_benchmarks.main(["--root", "data", "--data", "cars", "--scene", "chair", "--meshes", "a.glb"]) == 0
    return ran


def test_all_makes_the_rows_of_every_table_and_every_figure_of_the_pages(commands):
    """Source of truth: the markers and links in README.md and docs."""
    pages = "".join(page.read_text(encoding="utf-8") for page in tables.PAGES)
    names = [name for _, name, _ in tables.MARKED.findall(pages)]
    wanted = {f"{each}.json" for name in names for each in tables.SOURCES.get(name, (name,))}
    wanted |= set(re.findall(r"\]\(\S*benchmarks/results/(\w+\.(?:png|json))\)", pages))
    made = {word.rpartition("/")[2] for words in commands for word in words if word.endswith((".json", ".png"))}
    assert "baked.json" in wanted
    assert "lookup.png" in wanted
    assert wanted <= made


def test_quick_benchmarks_do_not_replace_results(monkeypatch):
    """Property: with --quick, nothing is written to the folder of results."""
    ran = []
    run = types.SimpleNamespace(returncode=0)
    monkeypatch.setattr(subprocess, "run", lambda command, check, env: ran.append(command[3:]) or run)
    assert all_benchmarks.main(["--quick"]) == 0
    assert all("--quick" in words and "--json" not in words and "--plot" not in words for words in ran)
