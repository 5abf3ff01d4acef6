"""Source of truth: the same generation by local processes, byte for byte. The tests need ray, which is optional."""

import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest

from data_gen.datasets.generate import GenerationConfig, Procedural, generate

HERE = Path(__file__).parent
needs_ray = pytest.mark.skipif(find_spec("ray") is None, reason="ray is not installed")


def run(script, *arguments):
    """Run code in a separate process, since ray leaves threads and sockets open and warns about them."""
    code = f"import sys; sys.path[:0] = [{str(HERE.parents[2])!r}, {str(HERE)!r}]\n{script}"
    return subprocess.run([sys.executable, "-c", code, *arguments], capture_output=True, text=True, check=False)


@needs_ray
def test_a_cluster_writes_the_same_bytes(tmp_path):
    local, cluster = tmp_path / "local", tmp_path / "cluster"
    options = {"views": 4, "resolution": 16, "held_out": 1, "workers": 2}
    generate(Procedural("car", 3), local, GenerationConfig(**options))
    script = (
        "from data_gen.datasets.generate import *\n"
        f"print(generate(Procedural('car', 3), sys.argv[1], GenerationConfig(engine='ray', **{options!r})))"
    )
    done = run(script, str(cluster))
    assert done.returncode == 0, done.stderr
    files = {path.relative_to(local): path.read_bytes() for path in local.rglob("*") if path.is_file()}
    assert files == {path.relative_to(cluster): path.read_bytes() for path in cluster.rglob("*") if path.is_file()}


@needs_ray
def test_an_actor_that_dies_loses_one_item(tmp_path):
    script = (
        "from data_gen.datasets.ray_cluster import run_on_ray\n"
        "import os; os.environ['PYTHONPATH'] = os.pathsep.join([*sys.path[:2], os.environ.get('PYTHONPATH', '')])\n"
        "kinds = ['fine', 'crash', 'wrong', 'once', 'fine']\n"
        "items = [dict(name=str(i), kind=kind) for i, kind in enumerate(kinds)]\n"
        "for o in run_on_ray('faulty_worker:serve', dict(folder=sys.argv[1]), items, workers=2):\n"
        "    print(o.item['name'], o.reason)"
    )
    done = run(script, str(tmp_path))
    assert done.returncode == 0, done.stderr
    assert sorted(line for line in done.stdout.splitlines() if line[0].isdigit()) == [
        "0 None",
        "1 failed 2 times: its actor died",
        "2 nothing to draw in it",
        "3 None",
        "4 None",
    ]


@pytest.mark.skipif(find_spec("ray") is not None, reason="ray is installed")
def test_without_ray_one_line_says_what_to_do(tmp_path):
    with pytest.raises(
        ValueError, match="^engine: expected ray to be installed, found no such module; pip install ray$"
    ):
        generate(
            Procedural("car", 1), tmp_path / "out", GenerationConfig(held_out=0, views=2, resolution=16, engine="ray")
        )
