"""Source of truth: the stated order of renderers, with replacements of the subprocess that tries each of them."""

import subprocess
import sys

import pytest

from data_gen.rendering import renderers
from data_gen.rendering.renderers import ProbeResult, RendererError, RendererInfo


@pytest.fixture
def fresh(monkeypatch):
    """Clear the cache of outcomes."""
    monkeypatch.setattr(renderers, "_cache", {})
    return monkeypatch


@pytest.fixture
def pretend(fresh):
    """Make only some renderers work. Returns the list of those that were tried."""
    tried = []

    def arrange(*working):
        def attempt(name):
            tried.append(name)
            works = name in working
            return ProbeResult(
                name, works, "fine" if works else "no library", "" if works else renderers.REMEDIES[name]
            )

        fresh.setattr(renderers, "_run_probe", attempt)
        return tried

    return arrange


def test_embree_works_in_a_real_subprocess():
    outcome = renderers.probe("embree")
    assert outcome.works, outcome
    assert "Embree" in outcome.message
    assert outcome.remedy == ""
    assert renderers.probe("embree") is outcome


@pytest.mark.parametrize("name", renderers.RENDERERS)
def test_the_outcome_has_all_values(name):
    outcome = renderers.probe(name)
    assert outcome.works == (outcome.remedy == "")
    assert outcome.message
    assert "\n" not in outcome.message


def test_the_order_is_egl_osmesa_embree(pretend):
    tried = pretend("embree")
    renderer = renderers.find_renderer()
    assert tried == ["pyrender-egl", "pyrender-osmesa", "embree"]
    assert renderer.name == "embree"
    assert len(renderer.advice) == 2
    assert "apt-get install -y libegl1 libgl1" in renderer.advice[0]


def test_a_better_renderer_is_recommended_if_there_is_one(pretend):
    pretend("pyrender-osmesa", "embree")
    (advice,) = renderers.find_renderer().advice
    assert advice.startswith("pyrender-egl does not work here")


def test_the_best_is_used_without_trying_the_others(pretend):
    tried = pretend("pyrender-egl", "embree")
    assert renderers.find_renderer() == RendererInfo("pyrender-egl", "fine")
    assert tried == ["pyrender-egl"]


def test_the_chosen_renderer_has_to_work(pretend):
    pretend("embree")
    with pytest.raises(RendererError, match="'pyrender-osmesa': .* no library. Remedy: apt-get install -y libosmesa6"):
        renderers.find_renderer("pyrender-osmesa")


def test_that_no_renderer_works_is_an_error(pretend):
    pretend()
    with pytest.raises(RendererError, match="no renderer works here .* apt-get install -y libegl1 libgl1"):
        renderers.find_renderer()


def test_each_renderer_is_tried_once(pretend):
    tried = pretend("embree")
    first = renderers.find_renderer()
    assert renderers.find_renderer() == first
    assert renderers.find_renderer("embree").name == "embree"
    assert len(tried) == 3


def test_an_unknown_name_is_refused():
    with pytest.raises(ValueError, match="pyrender-egl, pyrender-osmesa, embree, got 'vulkan'"):
        renderers.find_renderer("vulkan")
    with pytest.raises(ValueError, match="got 'vulkan'"):
        renderers.probe("vulkan")


@pytest.mark.parametrize(
    ("code", "message"),
    [
        ("import os, signal; os.kill(os.getpid(), signal.SIGSEGV)", "crashed with signal 11"),
        ("import sys; print('long story', file=sys.stderr); sys.exit('last word')", "last word"),
        ("import sys; sys.stderr.buffer.write(b'caf\\xe9'); sys.exit(1)", "caf\ufffd"),
        ("import sys; sys.exit(3)", "exit code 3"),
        ("pass", "exit code 0"),
    ],
)
def test_errors_of_the_subprocess_are_one_line(fresh, code, message):
    real = subprocess.run
    fresh.setattr(renderers.subprocess, "run", lambda command, **options: real([sys.executable, "-c", code], **options))
    outcome = renderers.probe("embree")
    assert (outcome.works, outcome.message, outcome.remedy) == (False, message, "pip install embreex")


def test_a_hanging_renderer_is_ended(fresh):
    real = subprocess.run
    sleep = [sys.executable, "-c", "import time; time.sleep(60)"]
    fresh.setattr(renderers, "_PROBE_SECONDS", 0.5)
    fresh.setattr(renderers.subprocess, "run", lambda command, **options: real(sleep, **options))
    assert renderers.probe("embree").message == "no picture within 0.5 s"


def test_importing_rigs_and_backends_loads_little():
    code = (
        "import sys, data_gen, data_gen.rigs, data_gen.rendering.renderers, data_gen.rendering.lighting;"
        "sys.exit(','.join({'pyrender', 'OpenGL', 'trimesh', 'torch', 'embreex', 'scipy'} & set(sys.modules)) or 0)"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
